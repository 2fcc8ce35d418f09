# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels in C++ where all that is shared are f, k1 and k2 of cameras with one focal length (see bordered.py).

Those kernels know f, k1, k2 of each keyframe, 9 unknowns. Keyframes of one camera take the same step ``z`` of them, and
what is not refined takes none::

    p9 = T p,    p = [pc z],    (T' S T + mu Dz) p = T' rhs

with T of ones: the system is summed after the points are eliminated, and nothing else differs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import SolverOptions
from ba_node.core import cameras, native_kernels, numpy_kernels, scaling
from ba_node.core.bordered import Shared, SharedState, exact_solver, require, solve_shared
from ba_node.core.kernels import LinearSolver, StepResult, System, length2
from ba_node.core.linear import cholesky
from ba_node.core.native_kernels import NativeKernels, NativeSystem
from ba_node.core.problem import Problem, State
from ba_node.core.result import Iteration, Result
from ba_node.core.solver import solve

# Columns of ``Cameras.params``, and their place in ``State.intrinsics``.
_OWN = {(cameras.FX, cameras.FY): 0, (4,): 1, (5,): 2}


def solve_cameras(
    problem: Problem,
    shared: Shared,
    options: SolverOptions,
    *,
    clock: Callable[[], float],
    on_iteration: Callable[[Iteration], bool] | None,
) -> tuple[Result, SharedState]:
    """Minimise as :func:`ba_node.core.bordered.solve_shared` does, with these kernels where they apply."""
    if not applies(problem, shared, options):
        return solve_shared(problem, shared, options, clock=clock, on_iteration=on_iteration)
    require(problem, replace(options, kernels="auto"))
    problem.check()
    kernels = FocalKernels(problem, options, shared)
    result = solve(kernels.problem, options, clock=clock, on_iteration=on_iteration, kernels=kernels)
    end = kernels.with_cameras(result.state)
    return replace(result, state=end), end


def applies(problem: Problem, shared: Shared, options: SolverOptions) -> bool:
    """Return True if a problem is one of these: each keyframe sees through one camera, of one focal length."""
    if options.kernels == "numpy" or native_kernels.missing(options) or problem.fixed.any():
        return False
    if shared.basis is not None or shared.prior is not None or shared.flow is not None:
        return False
    obs, params = problem.observations, problem.cameras.params
    alone = (_camera_of(problem)[obs.keyframe] == obs.camera).all()
    square = (params[:, cameras.FX] == params[:, cameras.FY]).all()
    return bool(alone and square) and all(unknown.columns in _OWN for unknown in shared.unknowns)


def _camera_of(problem: Problem) -> IntArray:
    """Return a camera that each keyframe sees through, (n_kf,); 0 if it sees nothing."""
    camera = np.zeros(problem.n_keyframes, dtype=np.intp)
    camera[problem.observations.keyframe] = problem.observations.camera
    return camera


class FocalKernels(NativeKernels):
    """The kernels; ``problem`` is the one that they solve, with f, k1, k2 of each keyframe."""

    def __init__(self, problem: Problem, options: SolverOptions, shared: Shared) -> None:
        camera, params = _camera_of(problem), problem.cameras.params.copy()
        start = replace(problem.start, intrinsics=params[camera][:, [cameras.FX, 4, 5]])
        params[:, [cameras.FX, cameras.FY]], params[:, 4:6] = 1.0, 0.0
        self.problem = replace(problem, start=start, cameras=replace(problem.cameras, params=params))
        super().__init__(self.problem, options)
        n, n_z = problem.n_keyframes, len(shared.unknowns)
        places = {(unknown.camera, _OWN[unknown.columns]): z for z, unknown in enumerate(shared.unknowns)}
        z = np.array([places.get((c, i), -1) for c in camera.tolist() for i in range(3)], dtype=np.intp)
        moves = np.flatnonzero(z >= 0)
        rows = np.concatenate([(9 * np.arange(n)[:, None] + np.arange(6)).ravel(), 9 * (moves // 3) + 6 + moves % 3])
        columns = np.concatenate([np.arange(6 * n), 6 * n + z[moves]])
        self._spread = scipy.sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (9 * n, 6 * n + n_z))
        self._given, self._unknowns, self._damping_z = problem, shared.unknowns, np.zeros(n_z)

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        value = super().linearise(state)
        own = self.gradient().ravel()
        of_points = max(self.gradient_norm**2 - float(own @ own), 0.0)
        self.gradient_norm = float(np.sqrt(of_points + np.sum((self._spread.T @ own) ** 2)))
        return value

    def damp(self, kind: str, mu: float) -> NativeSystem:
        """Add mu D, with D a choice of damping, to the diagonals and eliminate the points."""
        own, of_points = self.diagonals()
        summed = self._spread.T @ own.ravel()
        poses = summed[: 6 * self.n_free].reshape(-1, 6)
        d_c, d_p = scaling.diagonals(kind, (poses, of_points))
        self._damping_z = mu * scaling.diagonals(kind, (summed[None, poses.size :], of_points[:0]))[0][0]
        system = self.reduce(np.pad(mu * d_c, ((0, 0), (0, 3))), mu * d_p)
        return _SummedSystem(system, self._spread, self._damping_z)

    def step(self, state: State, system: System, x: FloatArray, inner_iterations: int) -> StepResult:
        """Take the step whose part in the system is x, and the inner iterations after it."""
        stepped = super().step(state, system, self._spread @ x, inner_iterations)
        z = x[len(x) - len(self._damping_z) :]
        return stepped._replace(damping=stepped.damping + 0.5 * float(self._damping_z @ (z * z)))

    def with_cameras(self, state: State) -> SharedState:
        """Return a state with the cameras that belong to it."""
        cams, observations = self._given.cameras, self._given.observations
        seen, params = np.unique(observations.keyframe), cams.params.copy()
        camera = _camera_of(self._given)[seen]
        for column, own in ((cameras.FX, 0), (cameras.FY, 0), (4, 1), (5, 2)):
            params[camera, column] = state.intrinsics[seen, own]
        z = np.array([(params - cams.params)[unknown.camera, unknown.columns[0]] for unknown in self._unknowns])
        plain = (state.rotation, state.translation, state.points, np.empty((0, 3)))
        return SharedState(*plain, replace(cams, params=params), z, observations.uv)


class _SummedSystem(NativeSystem):
    """``T' S T + mu Dz``, which is solved exactly."""

    length2 = length2

    def __init__(self, system: NativeSystem, spread: scipy.sparse.csr_matrix, damping_z: FloatArray) -> None:
        self._of, self._spread = system, spread
        self._rhs, self._has_rhs = np.asarray(spread.T @ system.rhs), True
        self.unknowns = len(self._rhs)
        self._damping = np.concatenate([np.zeros(self.unknowns - len(damping_z)), damping_z])

    def dense(self) -> FloatArray:
        """Return the summed system, (n, n)."""
        turned = self._spread.T.tocsr()
        summed = np.asarray(turned @ np.ascontiguousarray((turned @ self._of.dense()).T))
        summed[np.diag_indices(len(summed))] += self._damping
        return summed

    def sparse(self) -> scipy.sparse.csr_matrix:
        """Return the summed system, sparse."""
        return self._spread.T @ self._of.sparse() @ self._spread + scipy.sparse.diags(self._damping)

    def choose(self, asked: str) -> LinearSolver:
        """Return how to solve systems like this one."""
        return exact_solver(asked, self.unknowns)

    def pcg_tries(self) -> int:
        """Try no steps of PCG."""
        return 0

    def solve_dense(self) -> FloatArray | None:
        """Return the solution by dense Cholesky; None if the system is not positive definite."""
        return cholesky(self.dense(), self.rhs).x

    def solve_sparse(self) -> FloatArray | None:
        """Return the solution by a sparse factorisation; None if the system is not positive definite."""
        return numpy_kernels.solve_factored(self.sparse(), self.rhs)
