# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep of a problem what determines something."""

from __future__ import annotations

import numpy as np

from ba_node.arrays import BoolArray, IntArray
from ba_node.core.problem import Problem

# A keyframe with fewer observations (two residuals each, six unknowns) is not refined: nothing would check them.
MIN_OBSERVATIONS = 4
# Of the tracks that a keyframe shares with others this share has to have a place. If only few have, nothing shows
# parallax, and they are mismatches or worse.
_LEAST_PLACED = 0.3


def determined(
    problem: Problem, usable: BoolArray, moves: BoolArray, max_landmarks: int, min_points: int
) -> tuple[IntArray, BoolArray, BoolArray]:
    """Return which observations, keyframes and points are left without all that does not determine anything.

    ``usable`` (n_obs,) observations may take part; points that ``moves`` (n_pt,) marks do not count, as they move;
    points without a place are NaN. ``max_landmarks`` are kept, and a keyframe has to see ``min_points``.

    Returns:
        Rows of the observations, (n_kf,) and (n_pt,) True for what is kept.
    """
    obs, n_kf, n_pt = problem.observations, problem.n_keyframes, problem.n_points
    placed = ~np.isnan(problem.start.points[:, 0])
    keep_pt = placed.copy()
    if np.count_nonzero(keep_pt) > max_landmarks:
        keep_pt = _most_seen(keep_pt, np.bincount(obs.point[usable], minlength=n_pt), max_landmarks)
    # Views of a point by several cameras of a keyframe are neighbours, and count once.
    first = np.ones(len(obs), bool)
    first[1:] = (obs.point[1:] != obs.point[:-1]) | (obs.keyframe[1:] != obs.keyframe[:-1])
    static = ~moves.take(obs.point)
    views = np.bincount(obs.point[first], minlength=n_pt)
    shared = np.bincount(obs.keyframe[first & (views > 1).take(obs.point)], minlength=n_kf)
    known = np.bincount(obs.keyframe[first & usable & placed.take(obs.point)], minlength=n_kf)
    mostly = known >= _LEAST_PLACED * shared
    while True:
        used = usable & keep_pt.take(obs.point)
        keep_kf = mostly & (np.bincount(obs.keyframe, used & static, n_kf) >= MIN_OBSERVATIONS)
        keep_kf &= np.bincount(obs.keyframe[used & static & first], minlength=n_kf) >= min_points
        used &= keep_kf.take(obs.keyframe)
        seen_enough = np.bincount(obs.point, used, n_pt) >= 2
        if len(obs.depth_m):
            seen_enough |= np.bincount(obs.point, used & np.isfinite(obs.depth_m), n_pt) > 0
        before, keep_pt = keep_pt, keep_pt & seen_enough
        if np.array_equal(keep_pt, before):
            break
    return np.flatnonzero(keep_pt.take(obs.point) & keep_kf.take(obs.keyframe)), keep_kf, keep_pt


def _most_seen(known: BoolArray, views: IntArray, limit: int) -> BoolArray:
    """Return which of the known points to keep: ``limit`` of them, those with most views, ties by track id."""
    keep = np.zeros(len(known), bool)
    keep[np.argsort(np.where(known, -views, 1), kind="stable")[:limit]] = True
    return keep
