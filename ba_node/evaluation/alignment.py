# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Align two point sets in the least-squares sense.

S. Umeyama, *Least-squares estimation of transformation parameters between two point patterns*, PAMI 13(4), 1991.
With the means removed, ``Sigma = 1/n sum y x' = U D V'`` and ``S = diag(1, 1, det(U) det(V))``::

    R = U S V'                      (40)
    s = tr(D S) / (1/n sum |x|^2)   (42), or 1 for a rigid alignment
    t = mean(y) - s R mean(x)       (41)

minimise ``sum |y - (s R x + t)|^2``. R is unique when Sigma has rank 2 or more, that is when neither
set lies on one line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ba_node.arrays import FloatArray

Kind = Literal["none", "se3", "sim3"]

# A set whose second singular value is below this share of the first is a line as far as float64 can tell.
_LINE = 1e-9
# Beyond this float64 tells no tenth of a millimetre, and far beyond it LAPACK never ends.
_FAR_M = 1e12


class EvaluationError(ValueError):
    """Trajectories that cannot be compared or aligned."""


@dataclass(frozen=True)
class Alignment:
    """``x -> scale * rotation @ x + translation``, from the frame of the estimate to that of the reference."""

    rotation: FloatArray  # (3, 3)
    translation: FloatArray  # (3,) m
    scale: float  # 1 unless the alignment was sim3

    def apply(self, points: FloatArray) -> FloatArray:
        """Return points (n, 3) in the frame of the reference."""
        return self.scale * points @ self.rotation.T + self.translation


def align(estimate: FloatArray, reference: FloatArray, kind: Kind) -> Alignment:
    """Return the transform that brings an estimate closest to a reference, row by row the same places: (n, 3) m each.

    ``kind`` is none (identity), se3 (rotation and translation) or sim3 (and scale).

    Raises:
        EvaluationError: unknown kind, shapes that differ, numbers that are not finite or beyond 1e12 m, fewer than
            3 points, or points on one line or in one place, for which the rotation is not determined.
    """
    if kind not in get_args(Kind):
        raise EvaluationError(f"alignment {kind!r}: choose one of {', '.join(get_args(Kind))}")
    _check(estimate, reference)
    if kind == "none":
        return Alignment(np.eye(3), np.zeros(3), 1.0)
    if len(estimate) < 3:
        raise EvaluationError(
            f"{len(estimate)} points cannot be aligned by {kind}: give 3 or more, or choose the alignment none"
        )
    mean_x, mean_y = estimate.mean(axis=0), reference.mean(axis=0)
    x, y = estimate - mean_x, reference - mean_y
    _check_spread(x, kind, "estimate")
    _check_spread(y, kind, "reference")
    u, d, vt = np.linalg.svd(y.T @ x / len(x))
    if d[1] <= _LINE * d[0]:
        raise EvaluationError(f"the two trajectories share no plane: {kind} has no unique rotation; choose none")
    signs = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
    rotation = (u * signs) @ vt
    scale = float(d @ signs / np.mean(np.sum(x * x, axis=1))) if kind == "sim3" else 1.0
    return Alignment(rotation, mean_y - scale * rotation @ mean_x, scale)


def _check(estimate: FloatArray, reference: FloatArray) -> None:
    for name, points in (("estimate", estimate), ("reference", reference)):
        if points.ndim != 2 or points.shape[1] != 3 or points.shape != estimate.shape:
            raise EvaluationError(
                f"{name} has shape {points.shape}: expected ({len(estimate)}, 3), as many points in both"
            )
        bad = np.flatnonzero(~(np.abs(points) <= _FAR_M).all(axis=1))
        if len(bad):
            raise EvaluationError(f"point {bad[0]} of the {name} is not finite or beyond 1e12 m: {points[bad[0]]}")


def _check_spread(centred: FloatArray, kind: Kind, name: str) -> None:
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[1] <= _LINE * spread[0]:
        where = "in one place" if spread[0] == 0.0 else "on one straight line"
        raise EvaluationError(
            f"the {len(centred)} points of the {name} lie {where}: {kind} has no unique rotation; choose none"
        )
