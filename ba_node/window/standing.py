# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask whether most of what is seen stands by a solution, where much moves.

What moves is told from what stands by the motion that keyframes begin with, and where most of it moves a solution may
have followed that, or lie between the two, and explain what it was made of well. So tracks are looked at as they are,
those that solves left out too, a few keyframes at a time: in these a body knows its motion well, and what moves leaves
its place. A track of three keyframes at least stands if all of its views agree on a place within 3 sigmas. If not, it
moves, but for mismatches, which are far off it all at once: where a view is 8 sigmas off, the errors e of a camera's
views have to go on as they began, ``sum |e_(k-1) - 2 e_k + e_(k+1)|^2 < sum |e_k|^2 / 2``; of a track that jumps from
one point to another both are the same, of one that is anywhere the left side is six times the right one. With n that
stand and m that move ``s = n / (n + m)`` is the share that stands, by the solution and by the front-end's steps alone.

Where nothing moves s is 0.9 and more by good poses, and with half of the tracks on objects 0.48 to 0.57, 0.7 to 0.9
with one camera, to which what moves along its rays stands. What less than 0.475 bears out is borne out by no majority,
less than 0.6 with one camera. Where the front-end's steps explain nearly as many tracks as the solution does, they are
about as good as it, and what it can be worse by is more than what it can be better by: then 0.54 is asked for, and
0.75 with one camera.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray, changed
from ba_node.config import Config
from ba_node.core import consensus, geometry, native_kernels, triangulation
from ba_node.core.objective import reprojection_errors
from ba_node.core.problem import Problem, State
from ba_node.scene.scene import Scene
from ba_node.window import depths
from ba_node.window.problems import problem_of, some_observations

# Keyframes that are looked at together, after how many it is done again, and by how many of these a track is seen.
_KEYFRAMES, _NEXT, _LEAST_VIEWS = 5, 2, 3
# Views that stand agree within so many sigmas, and with measured depths.
_GATE = 3.0
# A track with a view so many sigmas off has mismatches, unless its errors bend by less than this share of them.
_WILD, _BENT = 8.0, 0.5
# Fewer tracks tell nothing, nor do they if less than this share stand or move.
_LEAST_TRACKS, _LEAST_TOLD = 50, 0.3
# Shares that have to stand, beside poor steps of the front-end and beside good ones, with one camera and with others.
# Steps are good where they explain this share of the tracks that the solution explains.
_LEAST, _GOOD = ((0.6, 0.75), (0.475, 0.54)), 0.6
# Median of the length of two standard normal numbers.
_MEDIAN_LENGTH = 1.177
CAUSE = "most tracks move against the static world that the odometry describes"

# Rotation (n_kf, 3, 3) and translation (n_kf, 3) m of body from world.
Poses = tuple[FloatArray, FloatArray]


class Shares(NamedTuple):
    """Which shares of the tracks stand."""

    by_front_end: float
    by_solution: float

    def too_few(self, has_scale: bool) -> bool:
        """Return True if too few stand by the solution for it to be taken; ``has_scale``: images tell lengths."""
        good = min(self.by_front_end / max(_GOOD * self.by_solution, 1e-9), 1.0)
        beside_poor, beside_good = _LEAST[has_scale]
        return self.by_solution < beside_poor + (beside_good - beside_poor) * good

    def __str__(self) -> str:
        """Return them in words."""
        return (
            f"{100 * self.by_solution:.0f} % of the tracks stand by it and {100 * self.by_front_end:.0f} % by the"
            f" front-end's steps, over {_KEYFRAMES} keyframes each"
        )


def shares(
    problem: Problem, refined: BoolArray, inlier: BoolArray, poses: tuple[Poses, Poses], kernels: str = "auto"
) -> Shares | None:
    """Return which shares of the tracks of a problem stand by two sets of poses; None if that is not told.

    ``poses`` are the front-end's and a solution's, looked at where all keyframes are ``refined``, (n_kf,); ``inlier``
    (n_obs,) observations tell how much larger than stated noise is.
    """
    rows, point = _parts(problem, refined)
    n = int(point.max(initial=-1)) + 1
    if n < _LEAST_TRACKS:
        return None
    observations = changed(problem.observations.take(rows), point=point)
    by_front_end, by_solution = (
        Problem(State(*two, np.zeros((n, 3)), np.empty((0, 3))), problem.fixed, problem.cameras, observations)
        for two in poses
    )
    noise = _noise(some_observations(by_solution, np.flatnonzero(inlier.take(rows))), kernels)
    stand = _share(by_solution, noise, kernels)
    # By steps that are far off most tracks seem to be mismatches.
    return None if stand is None else Shares(_share(by_front_end, noise, kernels) or 0.0, stand)


def of_map(scene: Scene, config: Config) -> Shares | None:
    """Return which shares of the tracks of a map stand by it and by the front-end's poses; None if that is not told."""
    landmarks = np.flatnonzero(scene.landmarks.views >= _LEAST_VIEWS)
    rows, table, order = scene.views_of(landmarks), scene.keyframes, scene.order
    if scene.cameras is None or not len(rows):
        return None
    origin = table.position[order[0]]
    positions = scene.landmarks.position[landmarks] - origin
    problem, rows = problem_of(scene, rows, order, landmarks, origin, positions, config)
    front_end = geometry.inverse(table.input_rotation[order], table.input_position[order] - origin)
    poses = front_end, (problem.start.rotation, problem.start.translation)
    return shares(problem, table.refined[order], ~scene.observations.outlier[rows], poses, config.solver.kernels)


def _parts(problem: Problem, refined: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the observations by some refined keyframes in a row each, and which track each is of, from 0."""
    obs, n_kf = problem.observations, problem.n_keyframes
    found, points = [(np.empty(0, np.intp), np.empty(0, np.intp))], 0
    for k in range(0, n_kf - _KEYFRAMES + 1, _NEXT):
        if not refined[k : k + _KEYFRAMES].all():
            continue
        rows = np.flatnonzero((obs.keyframe >= k) & (obs.keyframe < k + _KEYFRAMES))
        point, keyframe = obs.point.take(rows), obs.keyframe.take(rows)
        begins = np.append(True, (np.diff(point) != 0) | (np.diff(keyframe) != 0)) if len(rows) else rows
        views = np.bincount(point[begins], minlength=problem.n_points)
        kept = views >= _LEAST_VIEWS
        rows = rows[kept.take(point)]
        found.append((rows, points + (np.cumsum(kept) - 1).take(obs.point.take(rows))))
        points += int(np.count_nonzero(kept))
    rows, point = (np.concatenate(part) for part in zip(*found, strict=True))
    return rows, point


def _noise(problem: Problem, kernels: str) -> float:
    """Return how many times as large as stated the noise of observations is, none of which is wrong; 1 at least."""
    places = triangulation.triangulate(triangulation.rays_of(problem, kernels), problem.n_points, kernels)
    norms = _norms(problem, places.points, kernels)[1]
    return max(1.0, float(np.median(norms)) / _MEDIAN_LENGTH) if len(norms) else 1.0


def _norms(problem: Problem, points: FloatArray, kernels: str) -> tuple[State, FloatArray]:
    """Return a state with other points, NaN for unknown ones, and its residuals, (n_obs,) sigmas."""
    state = changed(problem.start, points=np.where(np.isnan(points), 0.0, points))
    return state, native_kernels.residual_norms(problem, state, kernels)


def _share(problem: Problem, noise: float, kernels: str) -> float | None:
    """Return which share of the tracks of a problem stands by its poses; None if that is not told."""
    obs, n = problem.observations, problem.n_points
    places, _ = consensus.triangulate(triangulation.rays_of(problem, kernels), n, _GATE * noise, kernels)
    state, norms = _norms(problem, places.points, kernels)
    off = norms > _GATE * noise
    measured = np.flatnonzero(np.isfinite(obs.depth_m))
    depth_m = depths.expected(problem, state, measured)
    off[measured] |= np.abs(depth_m - obs.depth_m[measured]) > _GATE * obs.depth_sigma_m[measured]
    stands = np.bincount(obs.point, off, n) == 0
    wild = np.bincount(obs.point[norms > _WILD * noise], minlength=n) > 0
    moves = ~stands & (~wild | _goes_on(problem, state, wild, noise))
    n_stand, n_move = int(np.count_nonzero(stands)), int(np.count_nonzero(moves))
    told = n_stand + n_move
    return n_stand / told if told >= max(_LEAST_TRACKS, _LEAST_TOLD * n) else None


def _goes_on(problem: Problem, state: State, which: BoolArray, noise: float) -> BoolArray:
    """Return of which points (n_pt,), of those asked for, the errors go on from view to view as they began."""
    n_cam, n = len(problem.cameras.model), problem.n_points
    rows = np.flatnonzero(which.take(problem.observations.point))
    track = problem.observations.point.take(rows) * n_cam + problem.observations.camera.take(rows)
    rows = rows[np.argsort(track, kind="stable")]
    some = problem.observations.take(rows)
    error, track = reprojection_errors(changed(problem, observations=some), state), np.sort(track)
    inside = track[2:] == track[:-2]
    bend = np.sum((error[:-2] - 2.0 * error[1:-1] + error[2:])[inside] ** 2, axis=1)
    bend -= 12.0 * some.sigma_px[1:-1][inside] ** 2 * noise**2
    bent = np.bincount(some.point[1:-1][inside], bend, n)
    size = np.bincount(some.point, np.sum(error**2, axis=1), n)
    # NaN is behind a camera.
    return np.asarray(bent < _BENT * size) & (np.bincount(some.point[1:-1][inside], minlength=n) > 0)
