# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Relative pose error: how far the motion over an interval is off that of the reference.

With poses ``Q`` of the reference and ``P`` of the estimate (fixed frame from body), for each pair i, j of poses that
are an interval apart (Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, IROS 2012, eq. 1)::

    E_ij = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)

The error in translation is the length of that of E, the error in rotation its angle. The alignment matters only by its
scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core.geometry import so3_log
from ba_node.evaluation.alignment import EvaluationError
from ba_node.evaluation.metrics import Errors, Paired

# How far the way between two poses may be off the interval, as a share of it, where all pairs are taken.
_TOLERANCE = 0.1


@dataclass(frozen=True)
class Interval:
    """Which pairs of poses are compared."""

    length: float = 1.0  # in ``unit``
    unit: Literal["frames", "m"] = "frames"  # poses, or metres of the way that the estimate goes
    all_pairs: bool = False  # begin at every pose; else each pair begins where the one before ends

    def __str__(self) -> str:
        return f"{self.length:g} {self.unit}"


@dataclass(frozen=True)
class RelativeError(Errors):
    """Relative error of a trajectory, of each pair of poses."""

    pairs: IntArray  # (n, 2) rows of the paired poses


def relative_error(paired: Paired, interval: Interval = Interval()) -> RelativeError:
    """Return the relative error over an interval.

    Raises:
        EvaluationError: the interval is none, or no two poses are so far apart.
    """
    if not (interval.length > 0.0 and np.isfinite(interval.length)) or (
        interval.unit == "frames" and interval.length != int(interval.length)
    ):
        raise EvaluationError(f"interval {interval}: expected a whole number of frames, or metres, above 0")
    pairs = _pairs(paired.position[0], interval)
    if not len(pairs):
        way = float(_way(paired.position[0])[-1])
        raise EvaluationError(
            f"interval {interval}: no two of the {len(paired.stamp_ns)} poses, over {way:.3g} m, are so far apart;"
            " choose a shorter one"
        )
    first, second = pairs.T
    ours, theirs = (
        _motion(position, rotation, first, second)
        for position, rotation in zip(paired.position, paired.rotation, strict=True)
    )
    back = np.swapaxes(theirs[0], -1, -2)
    translation = np.linalg.norm((back @ (ours[1] - theirs[1])[..., None])[..., 0], axis=1)
    rotation = np.degrees(np.linalg.norm(so3_log(back @ ours[0]), axis=1))
    return RelativeError(translation, rotation, pairs)


def _motion(
    position: FloatArray, rotation: FloatArray, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return rotation (n, 3, 3) and translation (n, 3) m of the second poses in the bodies of the first."""
    back = np.swapaxes(rotation[first], -1, -2)
    return back @ rotation[second], (back @ (position[second] - position[first])[..., None])[..., 0]


def _way(position: FloatArray) -> FloatArray:
    """Return how far it is to each pose along the way, m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])


def _pairs(position: FloatArray, interval: Interval) -> IntArray:
    """Return the rows (n, 2) of poses that are an interval apart."""
    n = len(position)
    if interval.unit == "frames":
        step = int(interval.length)
        first = np.arange(0, max(n - step, 0), 1 if interval.all_pairs else step)
        return np.stack([first, first + step], axis=1)
    way = _way(position)
    return _all_pairs(way, interval.length) if interval.all_pairs else _chain(way, interval.length)


def _chain(way: FloatArray, length: float) -> IntArray:
    """Return pairs each of which begins where the one before ends."""
    ends, begin = [0], 0.0
    for row, here in enumerate(way.tolist()):
        if row and here - begin >= length:
            ends.append(row)
            begin = here
    return np.stack([ends[:-1], ends[1:]], axis=1)


def _all_pairs(way: FloatArray, length: float) -> IntArray:
    """Return for each pose the later one that is nearest to an interval away, if the way is about that long."""
    first = np.arange(len(way) - 1)
    after = np.clip(np.searchsorted(way, way[:-1] + length), first + 1, len(way) - 1)
    before = np.maximum(after - 1, first + 1)
    off_after, off_before = (np.abs(way[end] - way[:-1] - length) for end in (after, before))
    second = np.where(off_before <= off_after, before, after)
    good = np.minimum(off_before, off_after) <= _TOLERANCE * length
    return np.stack([first[good], second[good]], axis=1)
