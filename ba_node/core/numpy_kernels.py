# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels in numpy and scipy: the oracle and the fallback, with every choice."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from ba_node.config import SolverOptions
from ba_node.core import columns, inner_iterations, linear, parameterisation, scaling
from ba_node.core.blocks import condition
from ba_node.core.kernels import DENSE_LIMIT, Moved, System
from ba_node.core.linear_costs import MAX_BYTES, Factor
from ba_node.core.objective import Linearisation, Objective
from ba_node.core.problem import Problem, State
from ba_node.core.schur import NormalEquations, ReducedSystem, Structure, normal_equations
from ba_node.core.schur_cameras import CameraReduction, FullSystem

FloatArray = NDArray[np.float64]
Reduction = ReducedSystem | CameraReduction | FullSystem

# A sparse matrix fuller than this share is factored as a dense one, if there is the memory.
_DENSE_SHARE = 0.1
_SIDES: dict[str, type[ReducedSystem] | type[CameraReduction] | type[FullSystem]] = {
    "points": ReducedSystem,
    "cameras": CameraReduction,
    "none": FullSystem,
}


class NumpyKernels:
    """The kernels in numpy and scipy."""

    def __init__(self, problem: Problem, options: SolverOptions) -> None:
        """Sort the observations once."""
        columns.keep_memory()
        self._structure = Structure(problem)
        self._objective = Objective(problem, options)
        self._options = options
        self._free = np.flatnonzero(~problem.fixed)
        self.n_free, self.size = self._structure.n_free, self._structure.size
        self.gradient_norm = np.inf
        self._linearisation: Linearisation
        self._equations: NormalEquations
        self._damping: tuple[FloatArray, FloatArray]
        # The rows at the last state that points were polished at: if the step is taken they are asked for again.
        self._polished: inner_iterations.Polished | None = None

    def graduate(self, graduation: float) -> None:
        """Let a surrogate stand in for a truncated quadratic; infinite for the loss itself."""
        self._objective.graduation, self._polished = graduation, None

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        known = self._polished.rows if self._polished is not None and self._polished.state is state else None
        self._linearisation = self._objective.linearise(state, known)
        self._equations = normal_equations(self._structure, self._linearisation)
        self.gradient_norm = self._equations.gradient_norm
        return self._linearisation.objective

    def diagonals(self) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) (n_free, d) and diag(C) (n_points, 3)."""
        return self._equations.diagonals()

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> System:
        """Add damping to the diagonals and eliminate."""
        side, factor = self._options.schur, 1.0
        if side == "adaptive":
            side, factor = self._adapt(damping_c, damping_p)
        reduction = _SIDES[side](self._structure, self._equations, damping_c, damping_p)
        system = _NumpySystem(reduction, self._structure, self._equations, self._linearisation)
        system.radius_factor = factor
        return system

    def damp(self, kind: str, mu: float) -> System:
        """Add mu D, with D a choice of damping, to the diagonals and eliminate."""
        d_c, d_p = scaling.diagonals(kind, self.diagonals())
        self._damping = mu * d_c, mu * d_p
        return self.reduce(*self._damping)

    def move(self, state: State, system: System, x: FloatArray, polish_steps: int) -> Moved:
        """Take the step whose part in ``system`` is x, and polish the points after it."""
        step_c, step_p, predicted = system.back_substitute(x)
        d_c, d_p = self._damping
        damping = 0.5 * float(np.sum(d_c * step_c**2) + np.sum(d_p * step_p**2))
        moved = self._retract(state, step_c, step_p)
        if not moved.is_finite():
            return Moved(moved, predicted, damping, np.nan, np.nan)
        if not polish_steps:
            value = self.objective(moved)
            return Moved(moved, predicted, damping, value, value)
        found = self._polished = inner_iterations.polish_points(self._objective, self._structure, moved, polish_steps)
        return Moved(found.state, predicted, damping, found.before, found.after)

    def _retract(self, state: State, step_c: FloatArray, step_p: FloatArray) -> State:
        """Return the state after a step (n_free, d) and (n_points, 3)."""
        free = self._free
        rotation, translation = state.rotation.copy(), state.translation.copy()
        rotation[free], translation[free] = parameterisation.retract(
            self._options.parameterisation, rotation[free], translation[free], step_c[:, :6]
        )
        intrinsics = state.intrinsics
        if len(intrinsics):
            intrinsics = intrinsics.copy()
            intrinsics[free] += step_c[:, 6:]
        return State(rotation, translation, state.points + step_p, intrinsics)

    def _adapt(self, damping_c: FloatArray, damping_p: FloatArray) -> tuple[str, float]:
        """Return the side to eliminate and what the radius becomes there (Algorithm 10).

        The conditions are those of the damped diagonal blocks as they stand in H, since those blocks are what is
        inverted. The worst block of C grows from 6e3 to above 1e8 on Ladybug-49 as mu falls, and overtakes that of B
        after some 30 iterations. Those of B and C as whole matrices compare the units of unlike parameters.
        """
        if self.n_free == 0 or self._equations.pairs is not None:
            return "points", 1.0
        equations, size = self._equations, self.size
        b = columns.plus_diagonal(equations.b, damping_c)
        c = columns.plus_diagonal(equations.c, damping_p)
        if condition(c) < condition(b):
            return "points", 1.0
        return "cameras", 3.0 * self._structure.n_points / (size * self.n_free)

    def objective(self, state: State) -> float:
        """Return the robust objective."""
        return self._objective.value(state)

    def polish_points(self, state: State, steps: int) -> tuple[float, State]:
        """Improve every point alone by up to ``steps`` damped Newton steps; return the objective and the state."""
        found = inner_iterations.polish_points(self._objective, self._structure, state, steps)
        return found.after, found.state


class _NumpySystem:
    """A reduction that also knows the full model."""

    radius_factor = 1.0

    def __init__(
        self, reduction: Reduction, structure: Structure, equations: NormalEquations, linearisation: Linearisation
    ) -> None:
        self._reduction, self._structure, self._equations = reduction, structure, equations
        self._linearisation = linearisation
        self.rhs: FloatArray = reduction.rhs
        self.side = reduction.side
        self.dense, self.sparse, self.gather = reduction.dense, reduction.sparse, reduction.gather
        self.diagonal_blocks, self.own_blocks = reduction.diagonal_blocks, reduction.own_blocks
        self._matrix: scipy.sparse.bsr_matrix | None = None
        if self.side == "points" and structure.form_schur and len(self.rhs) > DENSE_LIMIT:
            self._matrix = reduction.sparse()

    def solve_dense(self) -> FloatArray | None:
        """Return the solution by dense Cholesky; None if S is not positive definite."""
        return linear.cholesky(self.dense(), self.rhs).x

    def pcg(self, _kind: str, _scale: FloatArray, _limits: linear.PcgLimits, *, formed: bool) -> None:
        """Leave PCG to linear.py."""

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x, by S itself where forming it pays."""
        return np.asarray(self._matrix @ x) if self._matrix is not None else self._reduction.product(x)

    def sizes(self) -> None:
        """Return nothing: dense up to DENSE_LIMIT unknowns, then whatever is asked for."""

    def factor_size(self, _max_blocks: int, _max_products: float) -> Factor:
        """Refuse to count: scipy finds its own order."""
        return Factor(0, 0.0, complete=False)

    def solve_sparse(self) -> FloatArray | None:
        """Return the solution by scipy's sparse factorisation; None if S is not positive definite."""
        matrix = self.sparse()
        n = len(self.rhs)
        if matrix.nnz > _DENSE_SHARE * n * n and 8.0 * n * n <= MAX_BYTES:
            return linear.cholesky(np.asarray(matrix.toarray()), self.rhs).x
        return linear.cholesky(matrix, self.rhs).x

    def back_substitute(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return both steps and the reduction of the undamped model, by J p itself."""
        step_c, step_p = self._reduction.expand(x)
        moved = self._structure.jacobian_product(self._linearisation, step_c, step_p)
        slope = np.sum(self._equations.gradient_c * step_c) + np.sum(self._equations.gradient_p * step_p)
        curvature = float(np.sum(moved * moved))
        if self._linearisation.factors is not None:
            curvature += self._linearisation.factors.curvature(step_c)
        return step_c, step_p, -float(slope) - 0.5 * curvature
