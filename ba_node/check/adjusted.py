# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Adjust some keyframes freely, with given cameras or along with them, to see how well these explain the tracks."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.check.relations import Relation, spread
from ba_node.check.tracks import Tracks
from ba_node.config import SolverOptions
from ba_node.core import bordered, cameras, geometry, methods, native_kernels, solver, triangulation
from ba_node.core.cameras import CX, CY, FX, FY
from ba_node.core.problem import Observations, Problem, State

_KEYFRAMES = 14
_OBSERVATIONS = 2400
_MIN_POINTS = 30
_MIN_VIEWS = 3
_MAX_STRIDE = 3
_MIN_KEYFRAMES = 8
# A wide loss first, as the front-end's steps may be far off; the sum that counts is that of the narrow one.
_WIDE, _NARROW = (
    dataclasses.replace(
        methods.options("auto"),
        loss="cauchy",
        loss_scale_px=scale,
        max_iterations=iterations,
        function_tolerance=1e-3,
    )
    for scale, iterations in ((8.0, 10), (1.0, 12))
)
_PATIENT = dataclasses.replace(_NARROW, max_iterations=60, function_tolerance=1e-5)
# Cameras are adjusted along by numpy's kernels, which know no trust region.
ALONG = dataclasses.replace(_PATIENT, trust_region="none", schur="points", annealing="none", kernels="numpy")
# Of each unknown, relative, so that what the tracks do not tell at all has a large standard deviation.
DAMPING = 1e-9
# Where a step of focal length and principal point and its standard deviations come to less, in focal lengths, the
# given ones stand, and no more steps are taken. A third of what is named, see intrinsics.py.
_AT_ONCE = 0.007
# Distance of a point that has none, in diameters of the path.
_FAR = 20.0
# Residuals beyond this many of the usual ones with the given model are mismatches.
_MISMATCH = 5.0
# Residuals beyond this many sigmas, and points behind a camera, all count the same.
_CAP = 10.0
# Usual residual, in sigmas, from which on it is more than noise, and cameras far from the given ones are tried too.
LARGE = 1.5


def problem_of(tracks: Tracks, relations: list[Relation], part: int) -> Problem | None:
    """Return the adjustment of a dozen keyframes that turn most, every other of their tracks, the first pose fixed.

    The second part has the other tracks, and keyframes of the other end of the recording.
    """
    usable = [one for one in relations if one.has_direction]
    if len(usable) < 3:
        return None
    stride = int(np.clip(np.median([one.b[0] - one.a[0] for one in usable]) // 2, 1, _MAX_STRIDE))
    turning = max(usable, key=lambda one: float(np.trace(np.eye(3) - one.pose.rotation)))
    reach = stride * (_KEYFRAMES - 1)
    first = max(0, min(turning.a[0] - reach // 2, len(tracks) - 1 - reach))
    first = max(0, len(tracks) - 1 - reach - first) if part else first
    keyframes = np.arange(first, len(tracks))[::stride][:_KEYFRAMES]
    if len(keyframes) < _MIN_KEYFRAMES:
        return None
    return _problem(tracks, keyframes, (part, 2), _OBSERVATIONS)


def problem_of_all(tracks: Tracks, keyframes: IntArray, most: int, least_views: int = _MIN_VIEWS) -> Problem | None:
    """Return the adjustment of some keyframes, of tracks with about so many observations, the first fixed."""
    return _problem(tracks, keyframes, (0, 1), most, least_views)


def _problem(
    tracks: Tracks, keyframes: IntArray, part: tuple[int, int], most: int, least_views: int = _MIN_VIEWS
) -> Problem | None:
    """Return the adjustment of some keyframes; every so many of the tracks, from one on; None where they are few."""
    first, (begin, stride) = keyframes[0], part
    place = np.full(len(tracks), -1)
    place[keyframes] = np.arange(len(keyframes))
    rows = np.flatnonzero((place[tracks.keyframe] >= 0) & np.isfinite(tracks.ray[:, 0]))
    image = np.unique(tracks.track[rows] * len(tracks) + tracks.keyframe[rows])
    views = np.bincount(image // len(tracks))
    # Tracks are numbered as they begin: so some of each keyframe.
    longest = np.flatnonzero(views >= least_views)[begin::stride]
    count = np.bincount(tracks.track[rows])[longest].sum()
    longest = longest[spread(len(longest), int(len(longest) * most / max(count, 1)))]
    if len(longest) < _MIN_POINTS:
        return None
    number = np.full(len(views), -1)
    number[longest] = np.arange(len(longest))
    rows = rows[number[tracks.track[rows]] >= 0]
    rows = rows[np.lexsort((tracks.camera[rows], tracks.keyframe[rows], tracks.track[rows]))]
    empty = np.empty(0)
    observations = Observations(
        place[tracks.keyframe[rows]],
        tracks.camera[rows],
        number[tracks.track[rows]],
        tracks.uv[rows],
        tracks.sigma_px[rows],
        empty,
        empty,
    )
    poses = geometry.inverse(tracks.rotation[keyframes], tracks.position[keyframes] - tracks.position[first])
    start = State(*poses, np.zeros((len(longest), 3)), np.empty((0, 3)))
    fixed = np.arange(len(keyframes)) == 0
    return Problem(start, fixed, tracks.cameras, observations)


class Fit(Protocol):
    """What an adjustment left."""

    @property
    def norms(self) -> FloatArray:
        """Return the sizes of the residuals, sigmas."""


class Measure:
    """How well an adjustment explains the observations that are no mismatches, as the given model has them.

    The loss is in units of the usual residual: that of real images is seldom what sigma_px says.
    """

    def __init__(self, norms: FloatArray, noise: float | None = None) -> None:
        usual = float(np.median(norms))
        # Where most residuals are large, the given model is in doubt, and they are not for it to judge.
        self._rows = (norms < _MISMATCH * max(usual, 1.0)) | (usual > LARGE)
        # usual residual with the given model, sigmas, if it is not said
        self.noise = max(float(np.median(norms[self._rows])), 1e-3) if noise is None else noise

    def __len__(self) -> int:
        return int(np.count_nonzero(self._rows))

    def __call__(self, adjusted: Fit) -> float:
        """Return the mean Cauchy loss of a residual; beyond a limit, and behind a camera, all count the same."""
        norms = np.minimum(adjusted.norms[self._rows], _CAP) / self.noise
        return float(np.log1p(norms * norms).mean())


class Adjusted:
    """An adjustment with given intrinsics.

    Attributes:
        problem: what was adjusted.
        state: where it ended.
        norms: sizes of the residuals there, sigmas.
    """

    def __init__(self, problem: Problem, params: FloatArray, lens: cameras.Model | None = None) -> None:
        model = problem.cameras.model if lens is None else np.full_like(problem.cameras.model, lens)
        rig = dataclasses.replace(problem.cameras, params=params, model=model)
        self.problem = dataclasses.replace(problem, cameras=rig)
        self.state = solver.solve(placed(self.problem), _WIDE).state
        self._finish(_NARROW)

    def thorough(self, state: State, measure: Measure) -> float:
        """Return the mean loss after as many iterations as it takes, from here or from other poses: the lower one."""
        self._finish(_PATIENT)
        costs = [measure(self)]
        for wide in (False, True):
            self.state = state
            if wide:
                self.state = solver.solve(placed(dataclasses.replace(self.problem, start=state)), _WIDE).state
            self._finish(_PATIENT)
            costs.append(measure(self))
        return min(costs)

    def _finish(self, options: SolverOptions) -> None:
        self.state = solver.solve(placed(dataclasses.replace(self.problem, start=self.state)), options).state
        self.norms = native_kernels.residual_norms(self.problem, self.state)


class Freed:
    """An adjustment that goes on from another one with focal length and principal point free, for all cameras alike.

    Attributes:
        params: (n_cam, 12) of the cameras.
        state: where it ended.
        norms: sizes of the residuals there, sigmas.
        sigma: (3,) standard deviations of focal length and principal point, focal lengths.
    """

    def __init__(self, start: Adjusted) -> None:
        rig = start.problem.cameras
        n, focal = len(rig.model), rig.params[:, FX]
        unknowns = [bordered.Unknown(c, columns) for c in range(n) for columns in ((FX, FY), (CX,), (CY,))]
        basis = (focal[:, None, None] * np.eye(3)).reshape(3 * n, 3)
        shared = bordered.Shared(tuple(unknowns), basis)
        problem = placed(dataclasses.replace(start.problem, start=start.state))
        self.params, self.state, self.norms = rig.params, start.state, start.norms
        with np.errstate(all="ignore"):
            step, self.sigma = self._told(problem, shared)
            if not (np.abs(step) + self.sigma).max() < _AT_ONCE:
                _, end = bordered.solve_shared(problem, shared, ALONG)
                at = dataclasses.replace(problem, start=end, cameras=end.cameras)
                self.params = end.cameras.params
                self.state = State(end.rotation, end.translation, end.points, end.intrinsics)
                self.norms = native_kernels.residual_norms(at, self.state)
                _, self.sigma = self._told(at, shared)

    def _told(self, problem: Problem, shared: bordered.Shared) -> tuple[FloatArray, FloatArray]:
        """Return a Gauss-Newton step of what is free, and its standard deviations, (3,) focal lengths each."""
        kernels = bordered.SharedKernels(problem, ALONG, shared)
        kernels.linearise(kernels.start)
        system = kernels.damp("diag", DAMPING)
        assert isinstance(system, bordered.BorderedSystem)
        values, vectors = np.linalg.eigh(system.of_border()[0])
        sigma = np.median(self.norms) * np.sqrt((vectors**2) @ (1.0 / np.maximum(values, 1e-12)))
        step = system.solve_dense()
        return np.full(3, np.inf) if step is None else step[-3:], sigma


def placed(problem: Problem) -> Problem:
    """Return a problem with its points where the rays of its poses meet; far away where they meet behind a camera."""
    rays, n = triangulation.rays_of(problem), problem.n_points
    if not len(rays.point):
        return problem
    points = triangulation.triangulate(rays, n).points
    ahead = ((points[rays.point] - rays.centre) * rays.direction).sum(axis=1)
    behind = np.bincount(rays.point, ~(ahead > 0.0), n) > 0
    reach = _FAR * float(np.linalg.norm(np.ptp(rays.centre, axis=0)))
    # The last row of a point wins; any of its rays will do.
    points[rays.point[behind[rays.point]]] = (rays.centre + reach * rays.direction)[behind[rays.point]]
    points[~np.isfinite(points).all(axis=1)] = 0.0
    return dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points))
