# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Self-calibration: cameras that several keyframes share are refined along with poses and points.

With theta for the free numbers of all cameras (intrinsics, places in the rig), ``J = [Jc Jp Jt]``. The points are
eliminated as in schur.py; theta borders the reduced system::

    [S   W ] [pc]   [rhs_c]      W     = Jc'Jt - E C^-1 Jp'Jt
    [W'  V ] [pt] = [rhs_t]      V     = Jt'Jt - Jt'Jp C^-1 Jp'Jt
                                 rhs_t = -Jt'r + Jt'Jp C^-1 gp

``Jt`` has few columns and is sparse where each image has a camera of its own. The loop is that of solver.py, the
kernels are numpy's; the bordered system is solved by Cholesky, dense or sparse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import ConfigError, SolverOptions
from ba_node.core import cameras, columns, geometry, linear_costs, scaling
from ba_node.core.inner_iterations import iterate_points
from ba_node.core.kernels import DENSE_LIMIT, LinearSolver, StepResult, System
from ba_node.core.numpy_kernels import NumpyKernels, NumpySystem
from ba_node.core.objective import Linearisation, Objective
from ba_node.core.problem import Cameras, Problem, State
from ba_node.core.result import Iteration, Result
from ba_node.core.schur import NormalEquations, ReducedSystem, Structure, block_diagonal, inverse_cholesky3
from ba_node.core.solver import solve

# Columns of Jt that belong to the place of a camera on the body: dphi, dt with Rc <- Exp(dphi) Rc, tc <- tc + dt.
_PLACE = range(cameras.N_PARAMS, cameras.N_PARAMS + 6)


@dataclass(frozen=True)
class Unknown:
    """One free number of a camera: the columns of its parameters that change alike, or one of its place."""

    camera: int
    columns: tuple[int, ...]  # of ``Cameras.params``; one of 12 to 17 for the place: rotation (rad), translation (m)


@dataclass(frozen=True)
class CalibratedState(State):
    """Poses and points, with the cameras that belong to them."""

    cameras: Cameras

    def is_finite(self) -> bool:
        """Return True if no number is NaN or infinite."""
        arrays = (self.rotation, self.translation, self.points, self.cameras.params, self.cameras.translation)
        return all(bool(np.isfinite(array).all()) for array in arrays)


def place_of(camera: int) -> list[Unknown]:
    """Return the six unknowns of the place of a camera on the body."""
    return [Unknown(camera, (column,)) for column in _PLACE]


def calibrate(
    problem: Problem,
    unknowns: Sequence[Unknown],
    options: SolverOptions,
    *,
    clock: Callable[[], float] = lambda: 0.0,
    on_iteration: Callable[[Iteration], bool] | None = None,
) -> tuple[Result, Cameras]:
    """Minimise the robust objective over poses, points and the unknowns of the cameras.

    Arguments as of :func:`ba_node.core.solver.solve`.

    Returns:
        The result, and the cameras that belong to its state.

    Raises:
        ProblemError: the problem is not well formed.
        ConfigError: options that cannot be had here: a trust region, PCG, another elimination, f, k1, k2 of each
            keyframe.
    """
    _require(problem, options)
    problem.check()
    at = problem.start
    start = CalibratedState(at.rotation, at.translation, at.points, at.intrinsics, problem.cameras)
    problem = replace(problem, start=start)
    with np.errstate(all="ignore"):
        kernels = CalibrationKernels(problem, options, unknowns)
    result = solve(problem, options, clock=clock, on_iteration=on_iteration, kernels=kernels)
    assert isinstance(result.state, CalibratedState)
    return result, result.state.cameras


def _require(problem: Problem, options: SolverOptions) -> None:
    for name, has, needs in (
        ("trust_region", options.trust_region, "none"),
        ("schur", options.schur, "points"),
        ("annealing", options.annealing, "none"),
    ):
        if has != needs:
            raise ConfigError(f"{name} = {has}: cameras are refined with {name} = {needs} alone: set it so")
    if options.linear_solver == "pcg" or options.kernels == "native":
        raise ConfigError(
            "cameras are refined by Cholesky and the numpy kernels: take linear_solver and kernels = auto"
        )
    if problem.free_intrinsics or len(problem.observations.depth_m):
        raise ConfigError("cameras are not refined in problems with depths, nor where each keyframe has f, k1, k2")


class CalibrationKernels(NumpyKernels):
    """Kernels of a problem whose cameras are free as ``unknowns`` say."""

    def __init__(self, problem: Problem, options: SolverOptions, unknowns: Sequence[Unknown]) -> None:
        super().__init__(problem, options)
        self._problem, self._unknowns = problem, tuple(unknowns)
        self._cameras = problem.cameras
        self._border: Border
        self._damping_theta: FloatArray

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        self._look_through(state)
        value = super().linearise(state)
        d_theta = theta_jacobian(self._objective, state, self._unknowns)
        self._border = border(self._problem, self._linearisation, d_theta)
        self.gradient_norm = float(np.hypot(self.gradient_norm, np.linalg.norm(self._border.gradient)))
        return value

    def damp(self, kind: str, mu: float) -> NumpySystem:
        """Add mu D to the diagonals and eliminate the points."""
        d_c, d_p = scaling.diagonals(kind, self.diagonals())
        d_theta = scaling.diagonals(kind, (self._border.v.diagonal()[None], np.empty((0, 3))))[0][0]
        self._damping, self._damping_theta = (mu * d_c, mu * d_p), mu * d_theta
        reduced = BorderedReduction(self._structure, self._equations, self._damping, self._border, mu * d_theta)
        return BorderedSystem(reduced, self._structure, self._equations, self._linearisation)

    def step(self, state: State, system: System, x: FloatArray, inner_iterations: int) -> StepResult:
        """Take a step of poses, points and cameras, and the inner iterations after it."""
        assert isinstance(state, CalibratedState)
        step_c, step_p, predicted = system.back_substitute(x)
        theta = x[step_c.size :]
        (d_c, d_p), d_theta = self._damping, self._damping_theta
        damping = 0.5 * float(np.sum(d_c * step_c**2) + np.sum(d_p * step_p**2) + np.sum(d_theta * theta**2))
        moved = self._objective.retract(state, step_c, step_p, self._free)
        stepped = CalibratedState(**vars(moved), cameras=moved_cameras(state.cameras, self._unknowns, theta))
        if not stepped.is_finite() or stepped.cameras.params[:, :2].min() <= 0.0:
            return StepResult(stepped, predicted, damping, np.nan, np.nan)
        self._look_through(stepped)
        if not inner_iterations:
            value = self._objective.value(stepped)
            return StepResult(stepped, predicted, damping, value, value)
        found = iterate_points(self._objective, self._structure, stepped, inner_iterations)
        return StepResult(found.state, predicted, damping, found.before, found.after)

    def _look_through(self, state: State) -> None:
        """Let the objective be that of the cameras of a state."""
        assert isinstance(state, CalibratedState)
        if state.cameras is not self._cameras:
            self._cameras, self._objective = state.cameras, self._objective.through(state.cameras)


@dataclass(frozen=True)
class Border:
    """What theta adds to the normal equations."""

    d_theta: scipy.sparse.csr_matrix  # (2 n_obs, n_theta) Jt
    gradient: FloatArray  # (n_theta,) Jt'r
    v: scipy.sparse.csr_matrix  # (n_theta, n_theta) Jt'Jt
    w_c: scipy.sparse.csr_matrix  # (6 n_free, n_theta) Jc'Jt
    w_p: scipy.sparse.csr_matrix  # (3 n_points, n_theta) Jp'Jt


def border(problem: Problem, lin: Linearisation, d_theta: scipy.sparse.csr_matrix) -> Border:
    """Return the border of the normal equations."""
    obs = problem.observations
    column = np.where(problem.fixed, -1, np.cumsum(~problem.fixed) - 1)[obs.keyframe]
    d_c = _blocks(lin.d_keyframe, column, int(np.count_nonzero(~problem.fixed)))
    d_p = _blocks(lin.d_point, obs.point, problem.n_points)
    turned = d_theta.T.tocsr()
    gradient = np.asarray(turned @ lin.residual.ravel())
    return Border(d_theta, gradient, turned @ d_theta, d_c.T @ d_theta, d_p.T @ d_theta)


def _blocks(blocks: FloatArray, column: IntArray, n: int) -> scipy.sparse.csr_matrix:
    """Return rows of blocks (n_obs, 2, d), each in its block column of n, none where that is -1, as a sparse matrix."""
    rows, _, d = np.flatnonzero(column >= 0), 2, blocks.shape[2]
    data = np.ascontiguousarray(blocks[rows])
    bounds = np.searchsorted(rows, np.arange(len(blocks) + 1))
    return scipy.sparse.bsr_matrix((data, column[rows], bounds), shape=(2 * len(blocks), d * n)).tocsr()


class BorderedReduction(ReducedSystem):
    """The damped system after elimination of the points, with theta last."""

    def __init__(
        self,
        structure: Structure,
        equations: NormalEquations,
        damping: tuple[FloatArray, FloatArray],
        around: Border,
        damping_theta: FloatArray,
    ) -> None:
        """Eliminate; damping (n_free, 6), (n_points, 3) and (n_theta,) adds to the diagonals."""
        super().__init__(structure, equations, *damping)
        self.border, self._n_c = around, len(self.rhs)
        root = inverse_cholesky3(columns.plus_diagonal(equations.c, damping[1]))
        inverse = block_diagonal(np.ascontiguousarray(np.swapaxes(root, 1, 2) @ root))
        self._eliminated = (inverse @ around.w_p).tocsr()  # C^-1 Jp'Jt
        self._w = around.w_c - structure.edge_matrix(equations.e) @ self._eliminated
        self._v = around.v + scipy.sparse.diags(damping_theta) - around.w_p.T @ self._eliminated
        rhs = np.asarray(self._eliminated.T @ equations.gradient_p.ravel()) - around.gradient
        self.rhs = np.concatenate([self.rhs, rhs])

    def dense(self) -> FloatArray:
        """Return the bordered system as a dense matrix."""
        w = self._w.toarray()
        return np.block([[super().dense(), w], [w.T, self._v.toarray()]])

    def sparse(self) -> scipy.sparse.spmatrix:
        """Return the bordered system as a sparse matrix."""
        return scipy.sparse.bmat([[super().sparse(), self._w], [self._w.T, self._v]], format="csc")

    def expand(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps of keyframes (n_free, 6) and points (n_points, 3) that belong to a solution."""
        step_c, step_p = super().expand(x[: self._n_c])
        return step_c, step_p - np.reshape(self._eliminated @ x[self._n_c :], step_p.shape)


class BorderedSystem(NumpySystem):
    """A bordered reduction that also knows the full model."""

    def choose(self, asked: str) -> LinearSolver:
        """Return how to solve systems like this one: dense while it is small."""
        kind = asked if asked in ("dense", "sparse") else "dense" if len(self.rhs) <= DENSE_LIMIT else "sparse"
        return LinearSolver(kind, linear_costs.describe(kind, len(self.rhs), None, None))

    def back_substitute(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return both steps and the reduction of the undamped model, by J p itself."""
        assert isinstance(self._reduction, BorderedReduction)
        step_c, step_p = self._reduction.expand(x)
        around, theta = self._reduction.border, x[step_c.size :]
        moved = self._structure.jacobian_product(self._linearisation, step_c, step_p)
        moved = moved + np.reshape(around.d_theta @ theta, moved.shape)
        slope = np.sum(self._equations.gradient_c * step_c) + np.sum(self._equations.gradient_p * step_p)
        curvature = float(np.sum(moved * moved))
        if self._linearisation.factors is not None:
            curvature += self._linearisation.factors.curvature(step_c)
        return step_c, step_p, -float(slope + around.gradient @ theta) - 0.5 * curvature


def moved_cameras(cams: Cameras, unknowns: Sequence[Unknown], theta: FloatArray) -> Cameras:
    """Return cameras after a step theta, (n_theta,)."""
    params, place = cams.params.copy(), np.zeros((len(cams.model), 6))
    for unknown, step in zip(unknowns, theta, strict=True):
        if unknown.columns[0] in _PLACE:
            place[unknown.camera, unknown.columns[0] - _PLACE.start] = step
        else:
            params[unknown.camera, list(unknown.columns)] += step
    rotation = geometry.so3_exp(place[:, :3]) @ cams.rotation
    return replace(cams, params=params, rotation=rotation, translation=cams.translation + place[:, 3:])


def theta_jacobian(objective: Objective, state: State, unknowns: Sequence[Unknown]) -> scipy.sparse.csr_matrix:
    """Return Jt, (2 n_obs, n_theta), weighted, at a state whose cameras are those of the objective."""
    cams, camera = objective.problem.cameras, objective.problem.observations.camera
    x_cam, masked, scale = objective.camera_rows(state)
    scale = np.array(scale)
    scale[masked] = 0.0
    by_camera = np.argsort(camera, kind="stable")
    bounds = np.searchsorted(camera[by_camera], np.arange(len(cams.model) + 1))
    data, rows, places = [], [], []
    for number in dict.fromkeys(unknown.camera for unknown in unknowns):
        seen = by_camera[bounds[number] : bounds[number + 1]]
        by_number = scale[seen, None, None] * _by_camera(x_cam[seen], cams, number)
        for place, unknown in enumerate(unknowns):
            if unknown.camera == number:
                data.append(by_number[:, :, list(unknown.columns)].sum(axis=2).ravel())
                rows.append((2 * seen[:, None] + [0, 1]).ravel())
                places.append(np.full(2 * len(seen), place))
    shape = (2 * len(camera), len(unknowns))
    if not data:
        return scipy.sparse.csr_matrix(shape)
    return scipy.sparse.csr_matrix((np.concatenate(data), (np.concatenate(rows), np.concatenate(places))), shape=shape)


def _by_camera(x_cam: FloatArray, cams: Cameras, number: int) -> FloatArray:
    """Return the derivatives of pixels by the parameters and the place of one camera, (n, 2, 18)."""
    model, params = cams.model[number : number + 1], cams.params[number : number + 1]
    out = np.zeros((len(x_cam), 2, _PLACE.stop))
    out[:, :, : cameras.N_PARAMS] = params_jacobian(x_cam, int(model[0]), params[0])
    _, by_x, _ = cameras.project_jacobian(x_cam, np.repeat(model, len(x_cam)), params, intrinsics=False)
    turned = x_cam - cams.translation[number]
    out[:, :, _PLACE.start : _PLACE.start + 3] = np.cross(turned[:, None, :], by_x)
    out[:, :, _PLACE.start + 3 :] = by_x
    return out


def params_jacobian(x_cam: FloatArray, model: int, params: FloatArray) -> FloatArray:
    """Return the derivatives of pixels by the twelve parameters of a camera, (n, 2, 12), equations of cameras.py."""
    out = np.zeros((len(x_cam), 2, cameras.N_PARAMS))
    straight = params.copy()
    straight[:4] = 1.0, 1.0, 0.0, 0.0
    bent = cameras.project(x_cam, np.full(len(x_cam), model, np.uint8), straight[None])
    out[:, 0, cameras.FX], out[:, 1, cameras.FY] = bent[:, 0], bent[:, 1]
    out[:, 0, cameras.CX] = out[:, 1, cameras.CY] = 1.0
    by_k = out[:, :, cameras.DISTORTION]
    if model == cameras.Model.EQUIDISTANT:
        across = np.linalg.norm(x_cam[:, :2], axis=1)
        angle = np.arctan2(across, x_cam[:, 2])
        direction = x_cam[:, :2] / np.where(across > 0.0, across, 1.0)[:, None]
        for i in range(4):
            by_k[:, :, i] = (angle ** (2 * i + 3))[:, None] * direction
    else:
        ray = x_cam[:, :2] / x_cam[:, 2:]
        a, b = ray.T
        s = a * a + b * b
        k4, k5, k6 = params[9:12]
        over = 1.0 / (1.0 + s * (k4 + s * (k5 + s * k6)))
        k1, k2, k3 = params[[4, 5, 8]]
        g = (1.0 + s * (k1 + s * (k2 + s * k3))) * over
        for column, by_g in zip((0, 1, 4, 5, 6, 7), (s, s**2, s**3, -g * s, -g * s**2, -g * s**3), strict=True):
            by_k[:, :, column] = (by_g * over)[:, None] * ray
        by_k[:, 0, 2], by_k[:, 1, 2] = 2 * a * b, s + 2 * b * b
        by_k[:, 0, 3], by_k[:, 1, 3] = s + 2 * a * a, 2 * a * b
    by_k *= params[:2, None]
    return out
