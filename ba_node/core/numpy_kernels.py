# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels in numpy and scipy: the oracle and the fallback, with every choice."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ba_node.core import polish
from ba_node.core.kernels import DENSE_LIMIT, System
from ba_node.core.objective import Linearisation, Objective, Rules
from ba_node.core.problem import Problem, State
from ba_node.core.schur import NormalEquations, ReducedSystem, Structure, normal_equations

FloatArray = NDArray[np.float64]


class NumpyKernels:
    """The kernels in numpy and scipy."""

    def __init__(self, problem: Problem, rules: Rules) -> None:
        """Sort the observations once."""
        self._structure = Structure(problem)
        self._objective = Objective(problem, rules)
        self.n_free, self.size = self._structure.n_free, self._structure.size
        self.gradient_norm = np.inf
        self._linearisation: Linearisation
        self._equations: NormalEquations

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        self._linearisation = self._objective.linearise(state)
        self._equations = normal_equations(self._structure, self._linearisation)
        self.gradient_norm = self._equations.gradient_norm
        return self._linearisation.objective

    def diagonals(self) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) (n_free, d) and diag(C) (n_points, 3)."""
        return self._equations.diagonals()

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> System:
        """Add damping to the diagonals and eliminate the points."""
        system = ReducedSystem(self._structure, self._equations, damping_c, damping_p)
        return _NumpySystem(system, self._structure, self._equations, self._linearisation, self._objective.problem)

    def objective(self, state: State) -> float:
        """Return the robust objective."""
        return self._objective.value(state)

    def polish_points(self, state: State, steps: int) -> tuple[float, State]:
        """Improve every point alone by up to ``steps`` damped Newton steps; return the objective and the state."""
        return polish.polish_points(self._objective, self._structure, state, steps)


class _NumpySystem:
    """A ReducedSystem that also knows the full model."""

    def __init__(
        self,
        system: ReducedSystem,
        structure: Structure,
        equations: NormalEquations,
        linearisation: Linearisation,
        problem: Problem,
    ) -> None:
        self._system, self._structure, self._equations = system, structure, equations
        self._linearisation, self._problem = linearisation, problem
        self.rhs = system.rhs
        self.dense, self.sparse, self.diagonal_blocks = system.dense, system.sparse, system.diagonal_blocks
        self._matrix: scipy.sparse.bsr_matrix | None = None
        if structure.form_schur and len(self.rhs) > DENSE_LIMIT:
            self._matrix = system.sparse()

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x, by S itself where forming it pays."""
        return np.asarray(self._matrix @ x) if self._matrix is not None else self._system.product(x)

    def back_substitute(self, step_c: FloatArray) -> tuple[FloatArray, float]:
        """Return the points' step and the reduction of the undamped model, by J p itself."""
        step_p = self._system.back_substitute(step_c)
        blocks = step_c.reshape(-1, self._structure.size)
        full = np.zeros((self._problem.n_keyframes, self._structure.size))
        full[self._structure.free] = blocks
        obs, lin = self._problem.observations, self._linearisation
        moved = (lin.d_keyframe @ full[obs.keyframe][:, :, None])[..., 0]
        moved += (lin.d_point @ step_p[obs.point][:, :, None])[..., 0]
        slope = np.sum(self._equations.gradient_c * blocks) + np.sum(self._equations.gradient_p * step_p)
        return step_p, -float(slope) - 0.5 * float(np.sum(moved * moved))
