# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn observations of a scene into a problem, and take parts of a problem.

All observations of a problem are sorted by point, keyframe, camera. A part keeps the order, so it need not be sorted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray, changed
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.core.problem import Observations, Problem, State
from ba_node.scene.scene import Scene


def problem_of(
    scene: Scene,
    rows: IntArray,
    keyframes: IntArray,
    landmarks: IntArray,
    origin: FloatArray,
    positions: FloatArray,
    config: Config,
) -> tuple[Problem, IntArray]:
    """Return the problem of observations by some keyframes, all poses fixed, and the row in the scene of each.

    They are sorted by point, keyframe, camera. Keyframes and landmarks are rows in the order of the problem, ``rows``
    are observations of these landmarks. ``origin`` (3,) is that of the problem in the map, m; ``positions`` (n_pt, 3)
    are in the problem.
    """
    cameras = scene.cameras
    assert cameras is not None
    found = scene.gather(rows, keyframes, landmarks, config.solver.kernels)
    rows, keyframe, camera, point, uv, sigma_px, depth = found
    observations = Observations(keyframe, camera, point, uv, sigma_px, depth, config.tracks.depth_sigma_ratio * depth)
    poses = geometry.inverse(scene.keyframes.rotation[keyframes], scene.keyframes.position[keyframes] - origin)
    start = State(*poses, positions, np.empty((0, 3)))
    return Problem(start, np.ones(len(keyframes), bool), cameras, observations), rows


def some_observations(problem: Problem, rows: IntArray) -> Problem:
    """Return a problem with some of the observations of another, and all its keyframes and points."""
    return changed(problem, observations=_taken(problem.observations, rows))


def part_of(problem: Problem, rows: IntArray, points: BoolArray, keyframes: BoolArray | None = None) -> Problem:
    """Return a problem with some observations, points and keyframes (None: all) of another.

    ``rows`` of observations are ascending, all of kept points (n_pt,) and keyframes (n_kf,).
    """
    start, kept = problem.start, slice(None) if keyframes is None else keyframes
    of_keyframe = None if keyframes is None else np.cumsum(keyframes) - 1
    return Problem(
        State(start.rotation[kept], start.translation[kept], start.points[points], start.intrinsics),
        problem.fixed[kept],
        problem.cameras,
        _taken(problem.observations, rows, np.cumsum(points) - 1, of_keyframe),
    )


def _taken(
    obs: Observations, rows: IntArray, of_point: IntArray | None = None, of_keyframe: IntArray | None = None
) -> Observations:
    """Return some observations; (n_pt,) and (n_kf,) are the new numbers of points and keyframes, None for the old."""
    if native.kernels is not None:
        every = np.empty(0, np.intp)
        numbers = (every if of is None else of for of in (of_point, of_keyframe))
        return Observations(*native.kernels.take(obs, rows, *numbers))
    some = obs.take(rows)
    return changed(
        some,
        keyframe=some.keyframe if of_keyframe is None else of_keyframe.take(some.keyframe),
        point=some.point if of_point is None else of_point.take(some.point),
    )


def joined_observations(inlier: BoolArray, part: Observations, rest: Observations) -> Observations:
    """Return the observations of which ``part`` has those that ``inlier`` (n,) marks, and ``rest`` all others."""

    def join(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
        if len(one) + len(other) < len(inlier):
            return one  # none has a depth
        out = np.empty((len(inlier), *one.shape[1:]), one.dtype)
        out[inlier], out[~inlier] = one, other
        return out

    return Observations(*map(join, vars(part).values(), vars(rest).values()))


# A keyframe with fewer observations (two residuals each, six unknowns) is not refined: nothing would check them.
MIN_OBSERVATIONS = 4


@dataclass(frozen=True)
class Least:
    """What keyframes of a problem have to see."""

    points: IntArray  # (n_kf,) so many points that do not move
    # (n_kf,) of the tracks that it shares with others, so large a share has to have a place where one camera sees them
    placed: FloatArray


def determined(
    problem: Problem, usable: BoolArray, moves: BoolArray, max_landmarks: int, least: Least
) -> tuple[IntArray, BoolArray, BoolArray]:
    """Return which observations, keyframes and points are left without all that does not determine anything.

    ``usable`` (n_obs,) observations may take part; points that ``moves`` (n_pt,) marks do not count, as they move;
    points without a place are NaN. ``max_landmarks`` are kept, and a keyframe has to see the ``least``.

    Returns:
        Rows of the observations, (n_kf,) and (n_pt,) True for what is kept.
    """
    obs, n_kf, n_pt = problem.observations, problem.n_keyframes, problem.n_points
    placed = ~np.isnan(problem.start.points[:, 0])
    keep_pt = placed.copy()
    if np.count_nonzero(keep_pt) > max_landmarks:
        keep_pt = _most_seen(keep_pt, np.bincount(obs.point[usable], minlength=n_pt), max_landmarks)
    mostly = np.full(n_kf, True)
    # Several cameras, or depths, place points where nothing moves: if they place few, that is for the guard to say.
    if len(problem.cameras.model) == 1 and not np.isfinite(obs.depth_m).any():
        first = _first_of_pair(obs)
        views = np.bincount(obs.point[first], minlength=n_pt)
        shared = np.bincount(obs.keyframe[first & (views > 1).take(obs.point)], minlength=n_kf)
        known = np.bincount(obs.keyframe[first & placed.take(obs.point)], minlength=n_kf)
        mostly = known >= least.placed * shared
    if native.kernels is not None:
        enough = mostly, least.points, MIN_OBSERVATIONS
        found: tuple[IntArray, BoolArray, BoolArray] = native.kernels.determined(obs, usable, enough, (keep_pt, ~moves))
        return found
    first, static = _first_of_pair(obs), ~moves.take(obs.point)
    while True:
        used = usable & keep_pt.take(obs.point)
        counted = used & static
        keep_kf = mostly & (np.bincount(obs.keyframe[counted], minlength=n_kf) >= MIN_OBSERVATIONS)
        keep_kf &= np.bincount(obs.keyframe[counted & first], minlength=n_kf) >= least.points
        used &= keep_kf.take(obs.keyframe)
        seen_enough = np.bincount(obs.point[used], minlength=n_pt) >= 2
        if len(obs.depth_m):
            seen_enough |= np.bincount(obs.point[used & np.isfinite(obs.depth_m)], minlength=n_pt) > 0
        before, keep_pt = keep_pt, keep_pt & seen_enough
        if np.array_equal(keep_pt, before):
            break
    return np.flatnonzero(keep_pt.take(obs.point) & keep_kf.take(obs.keyframe)), keep_kf, keep_pt


def _first_of_pair(obs: Observations) -> BoolArray:
    """Return which observations count: views of a point by several cameras of a keyframe are neighbours, as one."""
    first = np.ones(len(obs), bool)
    first[1:] = (obs.point[1:] != obs.point[:-1]) | (obs.keyframe[1:] != obs.keyframe[:-1])
    return first


def _most_seen(known: BoolArray, views: IntArray, limit: int) -> BoolArray:
    """Return which of the known points to keep: ``limit`` of them, those with most views, ties by track id."""
    keep = np.zeros(len(known), bool)
    keep[np.argsort(np.where(known, -views, 1), kind="stable")[:limit]] = True
    return keep
