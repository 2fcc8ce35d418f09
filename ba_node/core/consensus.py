# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the views of each point that agree on a place, however many do not.

Where two rays meet is a candidate, so is the end of a ray with a measured distance, and so is each ray's direction, for
a point far away. A candidate costs ``sum min(r^2, gate^2)`` over all rays of the point (MSAC: Torr & Zisserman,
*MLESAC*, CVIU 2000), r being the angle between ray and candidate in sigmas; behind the camera it costs the gate. The
cheapest wins, directions before places and earlier before later. All pairs of rays are tried up to 45, that is of 10
rays; of more rays 45 pairs that are spread over them, the same at every call. Two rays place a point less well than all
that agree with them, so these triangulate it, and then all rays are classified once more.
"""

from __future__ import annotations

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import triangulation
from ba_node.core.triangulation import Rays, Triangulation

_MAX_PAIRS = 45
_MAX_SINGLES = 8
# Squared sine below which two rays do not meet.
_LEAST_SINE2 = 1e-12


def triangulate(rays: Rays, n_points: int, gate: float, kernels: str = "auto") -> tuple[Triangulation, BoolArray]:
    """Return the points as those of their rays see them that agree, and which these are, (n,).

    Args: as of :func:`agreeing`.
    """
    agrees = agreeing(rays, n_points, gate, kernels)
    found = triangulation.triangulate(rays.part(agrees), n_points, kernels)
    near = triangulation.errors(rays, found.points) <= gate
    if np.array_equal(near, agrees):
        return found, agrees
    # A point that lost views by it keeps those it had.
    fewer = np.bincount(rays.point, near, n_points) < np.bincount(rays.point, agrees, n_points)
    agrees = np.where(fewer.take(rays.point), agrees, near)
    return triangulation.triangulate(rays.part(agrees), n_points, kernels), agrees


def agreeing(rays: Rays, n_points: int, gate: float, kernels: str = "auto") -> BoolArray:
    """Return which rays agree with the place that most rays of their point agree on, (n,).

    ``gate`` is the largest angle between a ray and the place, sigmas. The C++ kernels do it where they are built,
    unless ``kernels`` is numpy.
    """
    if kernels != "numpy" and native.kernels is not None:
        found: BoolArray = native.kernels.agreeing(rays, n_points, gate)
        return found
    agrees = np.zeros(len(rays.point), bool)
    order = np.argsort(rays.point, kind="stable")
    begin = np.searchsorted(rays.point[order], np.arange(n_points + 1))
    for p in np.flatnonzero(np.diff(begin)):
        rows = order[begin[p] : begin[p + 1]]
        agrees[rows] = _best(rays, rows, gate * gate) < gate * gate
    return agrees


def _best(rays: Rays, rows: IntArray, gate2: float) -> FloatArray:
    """Return the squared errors of a point's rays against its best candidate."""
    centre, direction = rays.centre[rows], rays.direction[rows]
    n = len(rows)
    single = np.arange(min(n, _MAX_SINGLES)) * n // min(n, _MAX_SINGLES)
    measured = single[np.isfinite(rays.distance_m[rows[single]])]
    ends = centre[measured] + rays.distance_m[rows[measured], None] * direction[measured]
    places = np.concatenate([ends, _meetings(centre, direction)])
    away = np.concatenate([np.tile(direction[single, None], (1, n, 1)), places[:, None] - centre])
    dot = (away * direction).sum(axis=2)
    across = np.cross(direction, away)
    with np.errstate(divide="ignore", invalid="ignore"):
        error2 = rays.px_per_rad[rows] ** 2 * (across * across).sum(axis=2) / (away * away).sum(axis=2)
    error2 = np.where(dot > 0.0, np.minimum(error2, gate2), gate2)
    return np.asarray(error2[np.argmin(error2.sum(axis=1))])


def _meetings(centre: FloatArray, direction: FloatArray) -> FloatArray:
    """Return where pairs of rays are nearest to each other, by their angles, if it is in front of both; (m, 3)."""
    i, j = _pairs(len(centre))
    a, b, between = direction[i], direction[j], centre[j] - centre[i]
    cosine, along_a, along_b = (a * b).sum(axis=1), (between * a).sum(axis=1), (between * b).sum(axis=1)
    sine2 = 1.0 - cosine * cosine
    apart = sine2 > _LEAST_SINE2
    safe = np.where(apart, sine2, 1.0)
    s, t = (along_a - cosine * along_b) / safe, (cosine * along_a - along_b) / safe
    good = apart & (s > 0.0) & (t > 0.0)
    i, j, a, b, s, t = (values[good] for values in (i, j, a, b, s, t))
    share = (s * s / (s * s + t * t))[:, None]
    return np.asarray((1.0 - share) * (centre[i] + s[:, None] * a) + share * (centre[j] + t[:, None] * b))


def _pairs(n: int) -> tuple[IntArray, IntArray]:
    if n * (n - 1) // 2 <= _MAX_PAIRS:
        i, j = np.triu_indices(n, k=1)
        return i, j
    k = np.arange(_MAX_PAIRS)
    i = k * n // _MAX_PAIRS
    # Multiples of the golden ratio are spread evenly, however many there are.
    return i, (i + 1 + (k * 2654435761 % 2**32) * (n - 1) // 2**32) % n
