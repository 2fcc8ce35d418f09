# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of problems whose keyframes share unknowns: numbers of the cameras that they see through.

With theta for these numbers (intrinsics, places in the rig, offsets of clocks), ``J = [Jc Jp Jt]``. They move along the
columns of a basis T, ``theta = theta_0 + T z``, under a prior ``1/2 |z_0 + z|^2``, or freely, T = I. The points are
eliminated as in schur.py; z borders the reduced system::

    [S   W ] [pc]   [rhs_c]      W     = Jc'Jz - E C^-1 Jp'Jz,    Jz = Jt T
    [W'  V ] [pz] = [rhs_z]      V     = Jz'Jz + P - Jz'Jp C^-1 Jp'Jz
                                 rhs_z = -Jz'r - P (z_0 + z) + Jz'Jp C^-1 gp,    P = I with a prior, else 0

``Jt`` has few columns and is sparse where each image has a camera of its own. The loop is that of solver.py, the
kernels are numpy's; the bordered system is solved by Cholesky, dense or sparse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ba_node.arrays import FloatArray
from ba_node.config import ConfigError, SolverOptions
from ba_node.core import cameras, columns, linear_costs, parameterisation, scaling
from ba_node.core.inner_iterations import iterate_points
from ba_node.core.kernels import DENSE_LIMIT, LinearSolver, StepResult, System
from ba_node.core.numpy_kernels import NumpyKernels, NumpySystem
from ba_node.core.objective import Linearisation, Objective
from ba_node.core.problem import Cameras, Problem, State
from ba_node.core.result import Iteration, Result
from ba_node.core.rows import sparse_blocks
from ba_node.core.schur import NormalEquations, ReducedSystem, Structure, block_diagonal, inverse_cholesky3
from ba_node.core.solver import solve

# Columns of Jt beside those of ``Cameras.params``: the place of a camera on the body, as a local step, rotation (rad)
# before translation (m), and how much later than its stamp it sees (s).
PLACE = range(cameras.N_PARAMS, cameras.N_PARAMS + 6)
TIME = PLACE.stop
# Steps of the differences by intrinsics; pixels are linear in all but the last three.
_STEPS = np.repeat([1.0, 1e-4], [4, 8])


@dataclass(frozen=True)
class Unknown:
    """One shared number: the columns, as above, that change alike."""

    camera: int  # of the first camera the clock is that of all
    columns: tuple[int, ...]


@dataclass(frozen=True)
class Shared:
    """Which numbers are shared, and how they may move."""

    unknowns: tuple[Unknown, ...]
    basis: FloatArray | None = None  # (n_theta, n_z) T; None for I
    prior: FloatArray | None = None  # (n_z,) z_0; None for no prior
    flow: FloatArray | None = None  # (n_obs, 2) px/s, how the pixels move; None where no clock is unknown


@dataclass(frozen=True)
class SharedState(State):
    """Poses and points, with the cameras that belong to them."""

    cameras: Cameras
    z: FloatArray  # (n_z,) since the start
    uv: FloatArray  # (n_obs, 2) px at the time of the stamps

    def is_finite(self) -> bool:
        """Return True if no number is NaN or infinite, and focal lengths are positive."""
        arrays = (self.rotation, self.translation, self.points, self.cameras.params, self.cameras.translation, self.z)
        return all(bool(np.isfinite(array).all()) for array in arrays) and self.cameras.params[:, :2].min() > 0.0


def place_of(camera: int) -> list[Unknown]:
    """Return the six unknowns of the place of a camera on the body."""
    return [Unknown(camera, (column,)) for column in PLACE]


def solve_shared(
    problem: Problem,
    shared: Shared,
    options: SolverOptions,
    *,
    clock: Callable[[], float] = lambda: 0.0,
    on_iteration: Callable[[Iteration], bool] | None = None,
) -> tuple[Result, SharedState]:
    """Minimise the robust objective over poses, points and what is shared.

    Arguments as of :func:`ba_node.core.solver.solve`; the problem has no priors of points.

    Returns:
        The result, and its state with the cameras that belong to it.

    Raises:
        ProblemError: the problem is not well formed.
        ConfigError: options that cannot be had here: a trust region, PCG, another elimination, f, k1, k2 of each
            keyframe.
    """
    require(problem, options)
    problem.check()
    kernels = SharedKernels(problem, options, shared)
    problem = replace(problem, start=kernels.start)
    result = solve(problem, options, clock=clock, on_iteration=on_iteration, kernels=kernels)
    assert isinstance(result.state, SharedState)
    return result, result.state


def require(problem: Problem, options: SolverOptions) -> None:
    """Raise ConfigError for options with which cameras are not refined."""
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
    if problem.free_intrinsics:
        raise ConfigError("cameras are not refined where each keyframe has f, k1, k2")


class SharedKernels(NumpyKernels):
    """Kernels of a problem with shared unknowns; ``start`` is the state to begin from."""

    def __init__(self, problem: Problem, options: SolverOptions, shared: Shared) -> None:
        with np.errstate(all="ignore"):
            super().__init__(problem, options)
        n = len(shared.unknowns) if shared.basis is None else shared.basis.shape[1]
        at, uv = problem.start, problem.observations.uv
        intrinsics = at.intrinsics
        self.start = SharedState(at.rotation, at.translation, at.points, intrinsics, problem.cameras, np.zeros(n), uv)
        self._problem, self._shared, self._at = problem, shared, self.start
        self._basis = np.eye(n) if shared.basis is None else shared.basis
        self._border: Border
        self._damping_z: FloatArray

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        assert isinstance(state, SharedState)
        self._look_through(state)
        value = super().linearise(state)
        d_z = shared_jacobian(self._objective, state, self._shared) @ scipy.sparse.csr_matrix(self._basis)
        prior = None if self._shared.prior is None else self._shared.prior + state.z
        self._border = border(self._problem, self._linearisation, d_z, prior)
        self.gradient_norm = float(np.hypot(self.gradient_norm, np.linalg.norm(self._border.gradient)))
        return value + self._of_prior(state)

    def damp(self, kind: str, mu: float) -> NumpySystem:
        """Add mu D to the diagonals and eliminate the points."""
        d_c, d_p = scaling.diagonals(kind, self.diagonals())
        d_z = scaling.diagonals(kind, (self._border.v.diagonal()[None], np.empty((0, 3))))[0][0]
        self._damping, self._damping_z = (mu * d_c, mu * d_p), mu * d_z
        reduced = BorderedReduction(self._structure, self._equations, self._damping, self._border, mu * d_z)
        return BorderedSystem(reduced, self._structure, self._equations, self._linearisation)

    def step(self, state: State, system: System, x: FloatArray, inner_iterations: int) -> StepResult:
        """Take a step of poses, points and what is shared, and the inner iterations after it."""
        assert isinstance(state, SharedState)
        step_c, step_p, predicted = system.back_substitute(x)
        z = x[step_c.size :]
        (d_c, d_p), d_z = self._damping, self._damping_z
        damping = 0.5 * float(np.sum(d_c * step_c**2) + np.sum(d_p * step_p**2) + np.sum(d_z * z**2))
        moved = self._objective.retract(state, step_c, step_p, self._free)
        stepped = self._with_shared(moved, state, z)
        if not stepped.is_finite():
            return StepResult(stepped, predicted, damping, np.nan, np.nan)
        self._look_through(stepped)
        prior = self._of_prior(stepped)
        if not inner_iterations:
            value = self._objective.value(stepped) + prior
            return StepResult(stepped, predicted, damping, value, value)
        found = iterate_points(self._objective, self._structure, stepped, inner_iterations)
        return StepResult(found.state, predicted, damping, found.before + prior, found.after + prior)

    def _with_shared(self, moved: State, before: SharedState, z: FloatArray) -> SharedState:
        """Return poses and points with what is shared a step (n_z,) further than before."""
        theta, uv = self._basis @ z, before.uv
        late = offsets(self._shared.unknowns, theta, len(before.cameras.model))
        if self._shared.flow is not None:
            uv = uv - self._shared.flow * late[self._problem.observations.camera, None]
        return SharedState(
            **vars(moved), cameras=moved_cameras(before.cameras, self._shared.unknowns, theta), z=before.z + z, uv=uv
        )

    def _of_prior(self, state: SharedState) -> float:
        return 0.0 if self._shared.prior is None else 0.5 * float(np.sum((self._shared.prior + state.z) ** 2))

    def _look_through(self, state: SharedState) -> None:
        """Let the objective be that of the cameras of a state."""
        if state.cameras is not self._at.cameras:
            self._at, self._objective = state, self._objective.through(state.cameras, state.uv)


@dataclass(frozen=True)
class Border:
    """What z adds to the normal equations."""

    d_z: scipy.sparse.csr_matrix  # (d n_obs, n_z) Jz
    gradient: FloatArray  # (n_z,) Jz'r, with the prior's
    v: scipy.sparse.csr_matrix  # (n_z, n_z) Jz'Jz + P
    w_c: scipy.sparse.csr_matrix  # (6 n_free, n_z) Jc'Jz
    w_p: scipy.sparse.csr_matrix  # (3 n_points, n_z) Jp'Jz
    precision: float  # diagonal of P


def border(problem: Problem, lin: Linearisation, d_z: scipy.sparse.csr_matrix, prior: FloatArray | None) -> Border:
    """Return the border of the normal equations; ``prior`` (n_z,) is z_0 + z, None without one."""
    obs = problem.observations
    column = np.where(problem.fixed, -1, np.cumsum(~problem.fixed) - 1)[obs.keyframe]
    d_c = sparse_blocks(lin.d_keyframe, column, int(np.count_nonzero(~problem.fixed)))
    d_p = sparse_blocks(lin.d_point, obs.point, problem.n_points)
    turned = d_z.T.tocsr()
    gradient, v, precision = np.asarray(turned @ lin.residual.ravel()), turned @ d_z, 0.0
    if prior is not None:
        gradient, v, precision = gradient + prior, v + scipy.sparse.identity(len(prior)), 1.0
    return Border(d_z, gradient, v, d_c.T @ d_z, d_p.T @ d_z, precision)


class BorderedReduction(ReducedSystem):
    """The damped system after elimination of the points, with z last."""

    def __init__(
        self,
        structure: Structure,
        equations: NormalEquations,
        damping: tuple[FloatArray, FloatArray],
        around: Border,
        damping_z: FloatArray,
    ) -> None:
        """Eliminate; damping (n_free, 6), (n_points, 3) and (n_z,) adds to the diagonals."""
        super().__init__(structure, equations, *damping)
        self.border, self._n_c = around, len(self.rhs)
        root = inverse_cholesky3(columns.plus_diagonal(equations.c, damping[1]))
        inverse = block_diagonal(np.ascontiguousarray(np.swapaxes(root, 1, 2) @ root))
        self._eliminated = (inverse @ around.w_p).tocsr()  # C^-1 Jp'Jz
        self._w = around.w_c - structure.edge_matrix(equations.e) @ self._eliminated
        self._v = around.v + scipy.sparse.diags(damping_z) - around.w_p.T @ self._eliminated
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

    def of_border(self) -> tuple[FloatArray, FloatArray]:
        """Return what is left once the keyframes are eliminated too: matrix (n_z, n_z) and right-hand side (n_z,)."""
        s, n = self.dense(), self._n_c
        s[range(n), range(n)] *= 1.0 + 1e-12
        right = np.column_stack([s[:, n:], self.rhs])
        left = right[n:] - s[n:, :n] @ np.linalg.solve(s[:n, :n], right[:n])
        return left[:, :-1], left[:, -1]


class BorderedSystem(NumpySystem):
    """A bordered reduction that also knows the full model."""

    def of_border(self) -> tuple[FloatArray, FloatArray]:
        """Return what is left once the keyframes are eliminated too: matrix (n_z, n_z) and right-hand side (n_z,)."""
        assert isinstance(self._reduction, BorderedReduction)
        return self._reduction.of_border()

    def choose(self, asked: str) -> LinearSolver:
        """Return how to solve systems like this one."""
        return exact_solver(asked, len(self.rhs))

    def back_substitute(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return both steps and the reduction of the undamped model, by J p itself."""
        assert isinstance(self._reduction, BorderedReduction)
        step_c, step_p = self._reduction.expand(x)
        around, z = self._reduction.border, x[step_c.size :]
        moved = self._structure.jacobian_product(self._linearisation, step_c, step_p)
        moved = moved + np.reshape(around.d_z @ z, moved.shape)
        slope = np.sum(self._equations.gradient_c * step_c) + np.sum(self._equations.gradient_p * step_p)
        curvature = float(np.sum(moved * moved)) + around.precision * float(z @ z)
        if self._linearisation.factors is not None:
            curvature += self._linearisation.factors.curvature(step_c)
        return step_c, step_p, -float(slope + around.gradient @ z) - 0.5 * curvature


def exact_solver(asked: str, n: int) -> LinearSolver:
    """Return how to solve a bordered system of n unknowns: dense while it is small."""
    kind = asked if asked in ("dense", "sparse") else "dense" if n <= DENSE_LIMIT else "sparse"
    return LinearSolver(kind, linear_costs.describe(kind, n, None, None))


def moved_cameras(cams: Cameras, unknowns: Sequence[Unknown], theta: FloatArray) -> Cameras:
    """Return cameras after a step theta, (n_theta,)."""
    params, place = cams.params.copy(), np.zeros((len(cams.model), 6))
    for unknown, step in zip(unknowns, theta, strict=True):
        if unknown.columns[0] in PLACE:
            place[unknown.camera, unknown.columns[0] - PLACE.start] += step
        elif unknown.columns[0] != TIME:
            params[unknown.camera, list(unknown.columns)] += step
    rotation, translation = parameterisation.retract("local", cams.rotation, cams.translation, place)
    return replace(cams, params=params, rotation=rotation, translation=translation)


def offsets(unknowns: Sequence[Unknown], theta: FloatArray, n_cameras: int) -> FloatArray:
    """Return how much later than their stamps cameras see by theta, (n_cam,) s."""
    late = np.zeros(n_cameras)
    for unknown, step in zip(unknowns, theta, strict=True):
        if unknown.columns[0] == TIME:
            late[unknown.camera or slice(None)] += step
    return late


def shared_jacobian(objective: Objective, state: State, shared: Shared) -> scipy.sparse.csr_matrix:
    """Return Jt, (d n_obs, n_theta), weighted, at a state whose cameras are those of the objective."""
    cams, camera = objective.problem.cameras, objective.problem.observations.camera
    x_cam, masked, scale = objective.camera_rows(state)
    scale = np.array(scale)
    scale[masked] = 0.0
    n, d = scale.shape
    by_camera = np.argsort(camera, kind="stable")
    bounds = np.searchsorted(camera[by_camera], np.arange(len(cams.model) + 1))
    data, rows, places = [], [], []
    for number in dict.fromkeys(unknown.camera for unknown in shared.unknowns):
        seen = by_camera[bounds[number] : bounds[number + 1]]
        own = [(place, unknown.columns) for place, unknown in enumerate(shared.unknowns) if unknown.camera == number]
        wanted = sorted({column for _, of in own for column in of if column != TIME})
        by_number = scale[seen, :, None] * _by_camera(x_cam[seen], cams, number, (wanted, d))
        for place, of in own:
            which, by_one = seen, by_number[:, :, list(of)].sum(axis=2) if of[0] != TIME else np.empty(0)
            if of[0] == TIME:
                assert shared.flow is not None
                which = seen if number else np.arange(n)
                by_one = np.zeros((len(which), d))
                by_one[:, :2] = scale[which, :2] * shared.flow[which]  # a depth is not moved to the time of the stamp
            data.append(by_one.ravel())
            rows.append((d * which[:, None] + np.arange(d)).ravel())
            places.append(np.full(d * len(which), place))
    shape = (d * n, len(shared.unknowns))
    if not data:
        return scipy.sparse.csr_matrix(shape)
    return scipy.sparse.csr_matrix((np.concatenate(data), (np.concatenate(rows), np.concatenate(places))), shape=shape)


def _by_camera(x_cam: FloatArray, cams: Cameras, number: int, which: tuple[list[int], int]) -> FloatArray:
    """Return the derivatives of pixels, and depths (d = 3), by some columns of one camera, (n, d, 18).

    ``which`` are the columns, ascending; the others are left 0. And d.
    """
    wanted, d = which
    model, params = np.repeat(cams.model[number : number + 1], len(x_cam)), cams.params[number : number + 1]
    out = np.zeros((len(x_cam), d, TIME))
    for column in (column for column in wanted if column < PLACE.start):
        step = np.zeros((1, cameras.N_PARAMS))
        step[0, column] = _STEPS[column]
        ends = [cameras.project(x_cam, model, params + sign * step) for sign in (1.0, -1.0)]
        out[:, :2, column] = (ends[0] - ends[1]) / (2.0 * _STEPS[column])
    if wanted and wanted[-1] in PLACE:
        _, by_x, _ = cameras.project_jacobian(x_cam, model, params, intrinsics=False)
        by_x = np.concatenate([by_x, np.tile([0.0, 0.0, 1.0], (len(x_cam), d - 2, 1))], axis=1)
        turned = x_cam - cams.translation[number]
        out[:, :, PLACE.start : PLACE.start + 3] = np.cross(turned[:, None, :], by_x) @ cams.rotation[number]
        out[:, :, PLACE.start + 3 :] = by_x @ cams.rotation[number]
    return out
