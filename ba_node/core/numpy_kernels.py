# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels in numpy and scipy: the oracle and the fallback, with every choice."""

from __future__ import annotations

import itertools
from typing import Protocol

import numpy as np
import scipy

from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import blocks, columns, linear, linear_costs, scaling
from ba_node.core.inner_iterations import InnerIterations, iterate_points
from ba_node.core.kernels import DENSE_LIMIT, LinearSolver, StepResult, System, length2
from ba_node.core.objective import Linearisation, Objective
from ba_node.core.problem import Problem, State
from ba_node.core.schur import NormalEquations, ReducedSystem, Structure, normal_equations
from ba_node.core.schur_cameras import CameraReduction, FullSystem
from ba_node.core.two_level import TwoLevel

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
        # Where the last inner iterations ended: if the step is taken the rows there are asked for again.
        self._ended: InnerIterations | None = None
        self._two_level = TwoLevel(self._free)

    def graduate(self, graduation: float) -> None:
        """Let a surrogate stand in for a truncated quadratic; infinite for the loss itself."""
        self._objective.graduation, self._ended = graduation, None

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        self._two_level.state = state
        known = self._ended.rows if self._ended is not None and self._ended.state is state else None
        self._linearisation = self._objective.linearise(state, known)
        self._equations = normal_equations(self._structure, self._linearisation)
        self.gradient_norm = self._equations.gradient_norm
        return self._linearisation.objective

    def gradient(self) -> FloatArray:
        """Return the keyframes' part of the gradient, (n_free, d)."""
        return self._equations.gradient_c

    def diagonals(self, *, of_points: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) (n_free, d) and diag(C) (n_points, 3), or (0, 3) unless that is wanted too."""
        d_c, d_p = self._equations.diagonals()
        return d_c, d_p if of_points else d_p[:0]

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> NumpySystem:
        """Add damping to the diagonals and eliminate."""
        self._damping = damping_c, damping_p
        side, factor = self._options.schur, 1.0
        if side.startswith("adaptive"):
            side, factor = self._adapt(damping_c, damping_p)
        reduction = _SIDES[side](self._structure, self._equations, damping_c, damping_p)
        system = NumpySystem(reduction, self._structure, self._equations, self._linearisation)
        system.radius_factor, system.two_level = factor, self._two_level
        return system

    def damp(self, kind: str, mu: float) -> NumpySystem:
        """Add mu D, with D a choice of damping, to the diagonals and eliminate."""
        d_c, d_p = scaling.diagonals(kind, self.diagonals())
        return self.reduce(mu * d_c, mu * d_p)

    def step(self, state: State, system: System, x: FloatArray, inner_iterations: int) -> StepResult:
        """Take the step whose part in ``system`` is x, and the inner iterations after it."""
        step_c, step_p, predicted = system.back_substitute(x)
        d_c, d_p = self._damping
        damping = 0.5 * float(np.sum(d_c * step_c**2) + np.sum(d_p * step_p**2))
        stepped = self._objective.retract(state, step_c, step_p, self._free)
        if not stepped.is_finite():
            return StepResult(stepped, predicted, damping, np.nan, np.nan)
        if not inner_iterations:
            value = self.objective(stepped)
            return StepResult(stepped, predicted, damping, value, value)
        found = self._ended = iterate_points(self._objective, self._structure, stepped, inner_iterations)
        return StepResult(found.state, predicted, damping, found.before, found.after)

    def _adapt(self, damping_c: FloatArray, damping_p: FloatArray) -> tuple[str, float]:
        """Return the side to eliminate and what the radius becomes there (Algorithm 10).

        The conditions are the worst of the damped diagonal blocks, those of B and C as whole matrices comparing the
        units of unlike parameters. On Ladybug-49 that of C grows from 6e3 to above 1e8 as mu falls. As they stand in H
        that of B is 6e8, and C overtakes it after some 30 iterations; ``adaptive_scaled``: in the scaled space it is
        2e4, the thesis's 1e4, and C overtakes it at once.
        """
        if self.n_free == 0 or self._equations.pairs is not None:
            return "points", 1.0
        equations, size = self._equations, self.size
        b = columns.plus_diagonal(equations.b, damping_c)
        c = columns.plus_diagonal(equations.c, damping_p)
        if self._options.schur == "adaptive_scaled":
            d_c, d_p = scaling.scaled_space(self._options.scaled_space, self.diagonals())
            b = b / (d_c[:, :, None] * d_c[:, None, :])
            c = c / (d_p[:, :, None] * d_p[:, None, :])
        if blocks.condition(c) < blocks.condition(b):
            return "points", 1.0
        return "cameras", 3.0 * self._structure.n_points / (size * self.n_free)

    def objective(self, state: State) -> float:
        """Return the robust objective."""
        return self._objective.value(state)

    def iterate_points(self, state: State, iterations: int) -> tuple[float, State]:
        """Improve every point alone by up to so many damped Newton steps; return the objective and the state."""
        found = iterate_points(self._objective, self._structure, state, iterations)
        return found.after, found.state


class NumpySystem:
    """A reduction that also knows the full model."""

    radius_factor = 1.0
    length2 = length2

    def __init__(
        self, reduction: Reduction, structure: Structure, equations: NormalEquations, linearisation: Linearisation
    ) -> None:
        self._reduction, self._structure, self._equations = reduction, structure, equations
        self._linearisation = linearisation
        self.two_level: TwoLevel
        self.rhs: FloatArray = reduction.rhs
        self.unknowns = len(self.rhs)
        self.side = reduction.side
        self.dense, self.gather = reduction.dense, reduction.gather
        self.diagonal_blocks, self.own_blocks = reduction.diagonal_blocks, reduction.own_blocks
        self._matrix: scipy.sparse.bsr_matrix | None = None
        if self.side == "points" and structure.form_schur and len(self.rhs) > DENSE_LIMIT:
            self._matrix = reduction.sparse()

    def sparse(self) -> scipy.sparse.bsr_matrix:
        """Return S, block-sparse."""
        return self._matrix if self._matrix is not None else self._reduction.sparse()

    def solve_dense(self) -> FloatArray | None:
        """Return the solution by dense Cholesky; None if S is not positive definite."""
        return linear.cholesky(self.dense(), self.rhs).x

    def solve_pcg(self, kind: str, scale: FloatArray, limits: linear.PcgLimits, *, formed: bool) -> linear.Solution:
        """Return the solution by PCG in the space scaled by 1 / ``scale``."""
        if kind == "two_level":
            return self.two_level.solve(self.sparse(), self.rhs, scale, limits)
        return solve_pcg(kind, self, scale, limits, formed=formed)

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x, by S itself where forming it pays."""
        return np.asarray(self._matrix @ x) if self._matrix is not None else self._reduction.product(x)

    def choose(self, asked: str) -> LinearSolver:
        """Return how to solve systems like this one: dense while S is small, as scipy counts nothing beforehand."""
        n = len(self.rhs)
        if asked in ("auto", "cholesky"):
            asked = "dense" if n <= DENSE_LIMIT else "pcg" if asked == "auto" else "sparse"
        formed = "two_level" if self._matrix is not None else "schur_block"
        return LinearSolver(asked, linear_costs.describe(asked, n, None, None), formed)

    def pcg_tries(self) -> int:
        """Try no steps of PCG: in numpy they cost as much as an exact solution."""
        return 0

    def solve_sparse(self) -> FloatArray | None:
        """Return the solution by scipy's sparse factorisation; None if S is not positive definite."""
        return solve_factored(self.sparse(), self.rhs)

    def back_substitute(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return both steps and the reduction of the undamped model, by J p itself."""
        step_c, step_p = self._reduction.expand(x)
        moved = self._structure.jacobian_product(self._linearisation, step_c, step_p)
        slope = np.sum(self._equations.gradient_c * step_c) + np.sum(self._equations.gradient_p * step_p)
        curvature = float(np.sum(moved * moved))
        if self._linearisation.factors is not None:
            curvature += self._linearisation.factors.curvature(step_c)
        return step_c, step_p, -float(slope) - 0.5 * curvature


def solve_factored(matrix: scipy.sparse.spmatrix, rhs: FloatArray) -> FloatArray | None:
    """Return the solution by factorisation, a dense one if the matrix is full; None if it is not positive definite."""
    n = len(rhs)
    if matrix.nnz > _DENSE_SHARE * n * n and 8.0 * n * n <= linear_costs.MAX_BYTES:
        return linear.cholesky(np.asarray(matrix.toarray()), rhs).x
    return linear.cholesky(matrix, rhs).x


class _Blocked(System, Protocol):
    """A system of which the diagonal blocks of what was not eliminated are known too."""

    def own_blocks(self) -> tuple[FloatArray, ...]:
        """Return these blocks, damped, in runs of equal size."""


def solve_pcg(
    kind: str, system: _Blocked, scale: FloatArray, limits: linear.PcgLimits, *, formed: bool
) -> linear.Solution:
    """Return the solution by PCG in the space scaled by 1 / ``scale``, in which the preconditioner ``kind`` is made."""
    precondition = preconditioner(kind, system, scale)
    matrix = system.dense() if formed else None
    if matrix is not None:
        matrix *= scale[:, None]
        matrix *= scale

    def product(x: FloatArray) -> FloatArray:
        return np.asarray(matrix @ x) if matrix is not None else scale * system.product(scale * x)

    found = linear.pcg_steihaug(product, scale * system.rhs, precondition, limits)
    return found._replace(x=None if found.x is None else scale * found.x)


def preconditioner(kind: str, system: _Blocked, scale: FloatArray) -> linear.Product:
    """Return ``r -> M^-1 r`` for the system scaled by ``scale`` = 1/D, (n,)."""
    if kind == "none":
        return lambda r: r
    parts = system.diagonal_blocks() if kind.startswith("schur") else system.own_blocks()
    if kind.endswith("diag"):
        diagonal = np.concatenate([np.diagonal(part, axis1=1, axis2=2).ravel() for part in parts]) * scale * scale
        inverse = np.where(diagonal > 0.0, 1.0 / np.where(diagonal > 0.0, diagonal, 1.0), 1.0)
        return lambda r: inverse * r
    bounds = np.cumsum([0] + [part.shape[0] * part.shape[1] for part in parts])
    spans = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
    inverses = []
    for part, span in zip(parts, spans, strict=True):
        s = (np.ones_like(scale) if kind == "b_literal" else scale)[span].reshape(-1, part.shape[1])
        inverses.append(blocks.positive_inverses(part * s[:, :, None] * s[:, None, :]))

    def apply(r: FloatArray) -> FloatArray:
        pieces = [
            (inverse @ r[span].reshape(-1, inverse.shape[1], 1)).ravel()
            for inverse, span in zip(inverses, spans, strict=True)
        ]
        return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)

    return apply
