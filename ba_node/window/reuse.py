# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find tracks whose id went over to another point, and part the views of the one from those of the other.

A tracker that uses ids as slots gives the next point the id of one that it lost. The views of such a track agree in
two runs, one after the other: those before a keyframe on one place, those from it on another, far off in the image.
The run that the point does not stand for has to be seen in two keyframes and to agree within itself; so a moving
point, which leaves its place little by little, is none, nor are single mismatches.
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import consensus, triangulation
from ba_node.core.problem import Problem
from ba_node.scene.scene import Scene
from ba_node.window.problems import some_observations
from ba_node.window.selection import Selection

# Views of either run: two may agree by chance, but where ids are known to be used again that is the better explanation.
_LEAST_VIEWS = 3
_LEAST_VIEWS_OF_SLOTS = 2
# Keyframes of the run that the point does not stand for, and the share of all views on the wrong side of the cut.
_LEAST_KEYFRAMES = 2
_MISPLACED = 0.15
# How many gates off the other point is where the track goes over to it.
_JUMP = 4.0
# The share of a run that has to agree within itself, and of its views that do not fit the point.
_AGREEING = 0.75
# So many, and such a share of all tracks, are no accident of matching.
_WARN_COUNT = 20
_WARN_SHARE = 0.05


def part_reused(
    scene: Scene, selection: Selection, whole: Problem, norm: FloatArray, gate: float, kernels: str = "auto"
) -> int:
    """Give the older views of tracks whose id was used again a landmark of their own; return how many.

    ``whole`` has all observations of what was solved, at the solution; ``norm`` (n_all,) are the sizes of its
    residuals, ``gate`` is that of outliers, both in sigmas.
    """
    obs, n = whole.observations, whole.n_points
    outlier = norm > gate
    least = _LEAST_VIEWS_OF_SLOTS if "ids_reused" in scene.log.warnings else _LEAST_VIEWS
    some = np.bincount(obs.point, outlier, n) >= least
    rows = np.flatnonzero(some.take(obs.point))
    if not len(rows):
        return 0
    cut, other = _cut(whole, rows, norm, (gate, least))
    if not len(cut):
        return 0
    other = other[_agrees(whole, other, gate, kernels).take(obs.point[other])]
    points = np.unique(obs.point[other])
    cut = cut[np.isin(obs.point[cut], points)]
    if not len(cut):
        return 0
    landmarks = selection.landmarks[obs.point[cut]]
    since = scene.places()[selection.keyframes[obs.keyframe[cut]]]
    stays = outlier[cut]
    kept = scene.landmarks.position[landmarks].copy(), scene.landmarks.has_position[landmarks].copy()
    added = scene.split(landmarks, since)
    # Where the point stands for the newer views it is theirs.
    newer = ~stays
    scene.landmarks.position[landmarks[newer]] = kept[0][newer]
    scene.landmarks.has_position[landmarks[newer]] = kept[1][newer]
    scene.landmarks.has_position[added[newer]] = False
    scene.landmarks.changed(np.concatenate([landmarks, added]))
    scene.observations.outlier[selection.rows[other]] = False
    return len(landmarks)


def _cut(whole: Problem, rows: IntArray, norm: FloatArray, limits: tuple[float, int]) -> tuple[IntArray, IntArray]:
    """Return the first row after the cut of each track that has one, and all rows of the runs that do not fit.

    Rows are sorted by point and keyframe; ``rows`` are those of tracks with outliers. ``norm`` (n_all,) are the sizes
    of the residuals, ``limits`` the gate of outliers, and the fewest views of a run.
    """
    gate, least = limits
    obs = whole.observations
    point, wrong = obs.point[rows], norm[rows] > gate
    begin = np.flatnonzero(np.concatenate([[True], point[1:] != point[:-1]]))
    size = np.diff(np.append(begin, len(rows)))
    track = np.repeat(np.arange(len(begin)), size)
    rank = np.arange(len(rows)) - begin[track]
    before: IntArray = np.cumsum(wrong) - wrong
    before -= before[begin][track]
    total = np.bincount(track, wrong)[track]
    # As if the run before the row were right and that from it on wrong; and the other way round.
    misplaced = before + (size[track] - rank) - (total - before)
    n_views = size[track]
    fewest = np.minimum(misplaced, n_views - misplaced)
    fresh = np.concatenate([[False], obs.keyframe[rows[1:]] != obs.keyframe[rows[:-1]]])
    fresh &= (rank >= least) & (n_views - rank >= least)
    fewest = np.where(fresh, fewest, n_views)
    best = np.lexsort((fewest, track))[begin]
    good = fewest[best] <= _MISPLACED * size
    later_wrong = misplaced[best] <= size - misplaced[best]
    # At the cut the residual is that of another point, not of one that has moved on a little.
    last_wrong = np.where(later_wrong, best, best - 1)
    good &= norm[rows[last_wrong]] > _JUMP * gate
    in_later = rank >= (best - begin)[track]
    other = good[track] & (in_later == later_wrong[track])
    keyframes = _keyframes_of(track[other], obs.keyframe[rows[other]], len(begin))
    good &= keyframes >= _LEAST_KEYFRAMES
    # One mismatch among few views that fit is no other point.
    views, unfit = (np.bincount(track, one, len(begin)) for one in (other, other & wrong))
    good &= unfit >= _AGREEING * views
    return rows[best[good]], rows[other & good[track]]


def _keyframes_of(track: IntArray, keyframe: IntArray, n: int) -> IntArray:
    """Return how many different keyframes each of n tracks has, rows being sorted by both."""
    fresh = np.ones(len(track), bool)
    fresh[1:] = (track[1:] != track[:-1]) | (keyframe[1:] != keyframe[:-1])
    return np.bincount(track[fresh], minlength=n)


def _agrees(whole: Problem, rows: IntArray, gate: float, kernels: str) -> BoolArray:
    """Return for each point whether most of some of its views agree with each other."""
    rays = triangulation.rays_of(some_observations(whole, rows), kernels)
    agree = consensus.agreeing(rays, whole.n_points, gate, kernels)
    views = np.bincount(whole.observations.point[rows], minlength=whole.n_points)
    return np.asarray(np.bincount(rays.point, agree, whole.n_points) >= _AGREEING * views)


def note_reuse(scene: Scene, count: int) -> None:
    """Count tracks whose id was used again, and say so where it is the tracker's habit."""
    scene.log.notice("ids_reused", count)
    total = scene.log.notices["ids_reused"]
    if total >= _WARN_COUNT and total >= _WARN_SHARE * len(scene.landmarks):
        scene.log.warn(
            "ids_reused",
            f"{total} track ids were used again for another point: give every track an id of its own, one that no track"
            " had before (count up, instead of taking the number of a free slot)",
        )
