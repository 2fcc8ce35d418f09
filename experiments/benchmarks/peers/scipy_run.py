# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run scipy.optimize.least_squares (trf, lsmr) with our analytic sparse Jacobian."""

from __future__ import annotations

import numpy as np
import scipy
import scipy.optimize
import scipy.sparse
from numpy.typing import NDArray

from ba_node.config import SolverOptions
from ba_node.core.geometry import so3_log
from ba_node.core.objective import Objective
from ba_node.core.problem import State
from experiments.benchmarks.problem_file import Case, case_problem, write_state
from experiments.benchmarks.trace import Recorder, arguments

FloatArray = NDArray[np.float64]


class _Functions:
    """Residuals and Jacobian by the step from the start (local).

    Huber's loss acts on the norm of a residual, scipy's on each component; so residuals are scaled to
    ``sqrt(Psi(|r|)) r / |r|``, whose half square is the objective, and the Jacobian by the derivative of that.
    """

    def __init__(self, case: Case, huber: float | None) -> None:
        self.problem = case_problem(case)
        self.huber = huber
        self.objective = Objective(self.problem, SolverOptions(cheirality="keep"))
        self.size = case.size
        self.free = np.flatnonzero(~self.problem.fixed)
        obs = self.problem.observations
        column = np.full(self.problem.n_keyframes, -1)
        column[self.free] = np.arange(len(self.free))
        own = column[obs.keyframe]
        n_c = len(self.free) * self.size
        self.n = n_c + 3 * self.problem.n_points
        self.is_free = own >= 0
        camera = np.maximum(own, 0)[:, None] * self.size + np.arange(self.size)
        self.columns = np.hstack([camera, n_c + 3 * obs.point[:, None] + np.arange(3)])
        self.base, self.moved = self.problem.start, np.zeros(self.n)

    def state(self, x: FloatArray) -> State:
        """Return the state at a step from the start."""
        n_c = len(self.free) * self.size
        step = np.zeros((self.problem.n_keyframes, self.size))
        step[self.free] = x[:n_c].reshape(-1, self.size)
        return self.objective.retract(self.base, step, x[n_c:].reshape(-1, 3))

    def residuals(self, x: FloatArray) -> FloatArray:
        r = self.objective.linearise(self.state(x)).residual
        return (r * self._scale(r)[0][:, None]).ravel()

    def jacobian(self, x: FloatArray) -> scipy.sparse.csr_matrix:
        """Return the Jacobian; rotations take the derivative by the local step, right to first order in it."""
        row = self.objective.linearise(self.state(x))
        blocks = np.concatenate([row.d_keyframe * self.is_free[:, None, None], row.d_point], axis=2)
        scale, slope = self._scale(row.residual)
        norm = np.maximum(np.linalg.norm(row.residual, axis=1), 1e-300)
        unit = row.residual / norm[:, None]
        along = unit[:, None, :] @ blocks
        blocks = scale[:, None, None] * blocks + (slope - scale)[:, None, None] * unit[:, :, None] * along
        rows = np.repeat(np.arange(2 * len(unit)), blocks.shape[2])
        columns = np.repeat(self.columns, 2, axis=0).ravel()
        return scipy.sparse.csr_matrix((blocks.ravel(), (rows, columns)), shape=(2 * len(unit), self.n))

    def _scale(self, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return phi(n) / n and phi'(n) of phi = sqrt(Psi), n = |r|."""
        n = np.linalg.norm(r, axis=1)
        if self.huber is None:
            return np.ones_like(n), np.ones_like(n)
        k = self.huber
        phi = np.sqrt(2.0 * k * np.maximum(n, k) - k * k)
        inside = n <= k
        return np.where(inside, 1.0, phi / np.where(inside, 1.0, n)), np.where(inside, 1.0, k / phi)


def main() -> None:
    """Solve."""
    args, case = arguments(__doc__ or "")
    recorder = Recorder()
    functions = _Functions(case, args.scale if args.loss == "huber" else None)
    x0 = np.zeros(functions.n)
    recorder.add(0.5 * float(np.sum(functions.residuals(x0) ** 2)))

    def note(intermediate_result: scipy.optimize.OptimizeResult) -> None:
        recorder.add(intermediate_result.cost)

    result = scipy.optimize.least_squares(
        functions.residuals,
        x0,
        functions.jacobian,
        x_scale="jac",
        ftol=args.tolerance,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=args.iterations,
        callback=note,
    )
    recorder.write(args.trace, scipy.__version__, result.message)
    state = functions.state(result.x)
    intrinsics = state.intrinsics if len(state.intrinsics) else case.bal.cameras[:, 6:]
    write_state(args.state, np.hstack([so3_log(state.rotation), state.translation, intrinsics]), state.points)


if __name__ == "__main__":
    main()
