# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels in C++ (ba_node/native), and the choice between them and numpy's."""

from __future__ import annotations

import os
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray, changed
from ba_node.config import SolverOptions
from ba_node.core import linear_costs, scaling
from ba_node.core.factors import FactorSum, FactorTerms, Known, Pairs, RelativePoses
from ba_node.core.inner_iterations import least_promise
from ba_node.core.kernels import DENSE_LIMIT, Hessian, Kernels, LinearSolver, StepResult, System, length2
from ba_node.core.linear import PcgLimits, Solution
from ba_node.core.linear_costs import Factor, Sizes
from ba_node.core.numpy_kernels import NumpyKernels
from ba_node.core.objective import reprojection_errors
from ba_node.core.priors import PosePriors
from ba_node.core.problem import KeyframeFactors, Problem, State
from ba_node.core.two_level import TwoLevel

if TYPE_CHECKING:
    from ba_node.native._kernels import Kernel
    from ba_node.native._kernels import RelativePoses as CompiledPoses


class KernelsError(ValueError):
    """Kernels that were asked for by name and cannot be had."""


_NO_PAIRS = (np.empty(0, np.int64), np.empty(0, np.int64))


def make(problem: Problem, options: SolverOptions) -> Kernels:
    """Return the kernels of a problem.

    Raises:
        KernelsError: native is asked for and is not built, or does not have what else is asked for.
    """
    reason = missing(options)
    if options.kernels == "native" and reason:
        raise KernelsError(f"kernels native: {reason}; take numpy or auto")
    if options.kernels == "numpy" or reason:
        return NumpyKernels(problem, options)
    return NativeKernels(problem, options)


def missing(options: SolverOptions) -> str:
    """Return why the C++ kernels cannot be used, or an empty string if they can."""
    reason = native.missing(options.parameterisation, options.loss)
    if not reason and options.schur != "points":
        return f"the C++ kernels eliminate points only, not schur = {options.schur}"
    if not reason and options.loss_per != "observation":
        return f"the C++ kernels weigh observations, not loss_per = {options.loss_per}"
    if not reason and options.preconditioner == "b_literal":
        return "the C++ kernels have no preconditioner = b_literal"
    return reason


def residual_norms(problem: Problem, state: State, kernels: str = "auto", rows: IntArray | None = None) -> FloatArray:
    """Return the size of each residual, (n_obs,) in sigmas, inf for points that their camera cannot see.

    ``rows`` are the observations that are wanted, by default all.
    """
    if kernels != "numpy" and native.kernels is not None and not problem.free_intrinsics:
        norms: FloatArray = (
            native.kernels.residual_norms(problem, state)
            if rows is None
            else native.kernels.residual_norms_of(problem, state, rows)
        )
        return norms
    if rows is not None:
        problem = changed(problem, observations=problem.observations.take(rows))
    error = reprojection_errors(problem, state)
    # Ten times as quick as np.hypot, which minds numbers that no pixel has.
    sizes = np.sqrt(error[:, 0] ** 2 + error[:, 1] ** 2) / problem.observations.sigma_px
    sizes[np.isnan(sizes)] = np.inf
    return sizes


class NativeKernels:
    """The kernels in C++."""

    def __init__(self, problem: Problem, options: SolverOptions) -> None:
        """Hand the problem over; it is copied and sorted once."""
        self.size = 9 if problem.free_intrinsics else 6
        self._factors = NativeFactorSum(problem.factors, problem.fixed) if problem.factors else None
        pairs = _NO_PAIRS if self._factors is None else (self._factors.rows, self._factors.columns)
        threads = options.threads or len(os.sched_getaffinity(0))
        cost = (options.loss, options.loss_scale_px, options.cheirality, least_promise(options))
        self._kernel: Kernel = native.kernels.Kernel(problem, cost, pairs, threads)
        self.n_free: int = self._kernel.n_free
        self.gradient_norm = np.inf
        self._system = NativeSystem(self._kernel, self.size, problem.fixed)
        # Where steps lead, in turn: the state that a step starts from is one of them.
        self._states = [_like(problem.start), _like(problem.start)]
        self._stepped: StepResult | None = None
        # Where the last step began, until something is linearised: what was kept there has been written over.
        self._left: State | None = None

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        stepped, self._stepped, self._system.state = self._stepped, None, state
        self._left = None
        # The step has seen all of it where it ended.
        if stepped is not None and state is stepped.state and self._kernel.linearise_prepared():
            value = stepped.objective
        else:
            stepped, value = None, self._kernel.linearise(state)
        if self._factors is not None:
            terms = self._factors.linearise(state)
            self._kernel.add_factors(terms.diagonal, terms.gradient, terms.pairs.blocks)
            value += terms.value if stepped is None else 0.0
        self.gradient_norm = self._kernel.gradient_norm
        return value

    def gradient(self) -> FloatArray:
        """Return the keyframes' part of the gradient, (n_free, d)."""
        self._return()
        return self._kernel.gradient()

    def diagonals(self, *, of_points: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) (n_free, d) and diag(C) (n_points, 3), or (0, 3) unless that is wanted too."""
        self._return()
        d_c, d_p = self._kernel.diagonals(of_points)
        return d_c, d_p

    def _return(self) -> None:
        """Linearise once more where the last step began, if it was not taken."""
        if self._left is not None:
            self.linearise(self._left)

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> NativeSystem:
        """Add damping to the diagonals and eliminate the points."""
        self._return()
        self._kernel.factor(damping_c, damping_p)
        return self._system.renew()

    def damp(self, kind: str, mu: float) -> NativeSystem:
        """Add mu D, with D a choice of damping, to the diagonals and eliminate the points."""
        if kind == "inc":
            d_c, d_p = scaling.diagonals(kind, self.diagonals())
            return self.reduce(mu * d_c, mu * d_p)
        self._return()
        self._kernel.damp(kind == "diag", 0.0 if kind == "none" else mu)
        return self._system.renew()

    def step(self, state: State, _system: System, x: FloatArray, inner_iterations: int) -> StepResult:
        """Take the step whose part in the system is x, and the inner iterations after it; see Kernels."""
        target = self._states[self._states[0] is state]
        self._left = state
        predicted, damping, value, inner = self._kernel.step(state, x, inner_iterations, target)
        if self._factors is not None and np.isfinite(value):
            factors = self._factors.value(target)
            value, inner = value + factors, inner + factors
        stepped = StepResult(target, predicted, damping, value, inner)
        self._stepped = stepped if np.isfinite(inner) else None
        return stepped

    def objective(self, state: State) -> float:
        """Return the robust objective."""
        value: float = self._kernel.objective(state)
        return value + self._value_of_factors(state)

    def iterate_points(self, state: State, iterations: int) -> tuple[float, State]:
        """Improve every point alone by up to so many damped Newton steps; return the objective and the state."""
        _before, value, points = self._kernel.inner_iterations(state, iterations)
        value += self._value_of_factors(state)
        return value, State(state.rotation, state.translation, points, state.intrinsics)

    def _value_of_factors(self, state: State) -> float:
        return 0.0 if self._factors is None else self._factors.value(state)


def _like(state: State) -> State:
    """Return room for a state of the same size."""
    arrays = (state.rotation, state.translation, state.points, state.intrinsics)
    return State(*(np.empty(array.shape) for array in arrays))


class NativeSystem:
    """The kernel's current reduced system; valid until the next linearisation or reduction."""

    side = "points"
    radius_factor = 1.0

    def __init__(self, kernel: Kernel, size: int, fixed: BoolArray) -> None:
        self._kernel, self._size, self._fixed = kernel, size, fixed
        self.state: State  # of the last linearisation
        self._two_level: TwoLevel | None = None
        n = kernel.n_free * size
        self.unknowns: int = n
        self.product = kernel.product
        # These are written in every iteration; right-hand side and S only where they are asked for.
        self._x, self._rhs, self._dense = np.empty(n), np.empty(n), np.empty((0, 0))
        self._has_rhs = False
        self._sizes: Sizes | None = None
        # S, and where its blocks on and above the diagonal go, and their transposes, -1 for those of the diagonal.
        self._sparse: tuple[scipy.sparse.bsr_matrix, IntArray, IntArray] | None = None

    def renew(self) -> NativeSystem:
        """Return the system after another reduction."""
        self._has_rhs = False
        return self

    @property
    def two_level(self) -> TwoLevel:
        """Return the preconditioner on two levels, made at its first use."""
        self._two_level = self._two_level or TwoLevel(np.flatnonzero(~self._fixed))
        self._two_level.state = self.state
        return self._two_level

    @property
    def rhs(self) -> FloatArray:
        """Return the right-hand side, (n,)."""
        if not self._has_rhs:
            self._kernel.rhs(self._rhs)
            self._has_rhs = True
        return self._rhs

    def dense(self) -> FloatArray:
        """Return S, (n, n); the next call writes over it."""
        n = self.unknowns
        if len(self._dense) != n:
            self._dense = np.empty((n, n))
        self._kernel.dense(self._dense)
        return self._dense

    def solve_dense(self) -> FloatArray | None:
        """Return the solution by dense Cholesky, None if S is not positive definite; the next call writes over it."""
        return self._x if self._kernel.solve(self._x) else None

    def sparse(self) -> scipy.sparse.bsr_matrix:
        """Return S, block-sparse; the next call writes over it."""
        if self._sparse is None:
            columns, starts = self._kernel.schur_pattern()
            n, rows = self.unknowns, np.repeat(np.arange(self._kernel.n_free), np.diff(starts))
            above = np.flatnonzero(rows != columns)
            all_rows, all_columns = np.concatenate([rows, columns[above]]), np.concatenate([columns, rows[above]])
            order = np.lexsort((all_columns, all_rows))
            place, mirrored = np.argsort(order), np.full(len(rows), -1)
            mirrored[above] = place[len(rows) :]
            ends = np.searchsorted(all_rows[order], np.arange(self._kernel.n_free + 1))
            data = np.empty((len(order), self._size, self._size))
            matrix = scipy.sparse.bsr_matrix((data, all_columns[order], ends), shape=(n, n))
            self._sparse = matrix, place[: len(rows)], mirrored
        matrix, place, mirrored = self._sparse
        self._kernel.sparse(place, mirrored, matrix.data)
        return matrix

    def sizes(self) -> Sizes:
        """Return what each linear solver would have to do, which no iteration changes."""
        if self._sizes is None:
            self._sizes = Sizes(self.unknowns, self._size, *self._kernel.pairs())
        return self._sizes

    def choose(self, asked: str) -> LinearSolver:
        """Return how to solve systems like this one: by what each way would cost, see linear_costs.py."""
        if asked == "dense" or (asked in ("auto", "cholesky") and self.unknowns <= linear_costs.FEW_UNKNOWNS):
            return LinearSolver("dense", linear_costs.describe("dense", self.unknowns, None, None))
        sizes = self.sizes()
        if asked == "pcg":
            return self._pcg(sizes)
        exact = asked == "cholesky"
        limit = np.inf if asked == "sparse" else linear_costs.max_products(sizes, exact=exact)
        factor = self.factor_size(linear_costs.max_blocks(sizes.block), limit)
        if asked != "sparse" or not factor.complete:
            asked = linear_costs.cheapest(sizes, factor, exact=exact)
        if asked == "pcg":
            return self._pcg(sizes)
        formed = "two_level" if asked == "sparse" and self.unknowns > DENSE_LIMIT else "schur_block"
        return LinearSolver(asked, linear_costs.describe(asked, self.unknowns, sizes, factor), formed)

    def _pcg(self, sizes: Sizes) -> LinearSolver:
        text = linear_costs.describe("pcg", sizes.unknowns, None, None)
        blocks = len(self._kernel.schur_pattern()[0])
        of_two_levels = linear_costs.two_level_bytes(sizes, blocks)
        return LinearSolver("pcg", text, linear_costs.preconditioner(sizes, blocks), of_two_levels)

    def pcg_tries(self) -> int:
        """Return how many steps of PCG to try before an exact solution."""
        return 0 if self.unknowns <= linear_costs.FEW_UNKNOWNS else linear_costs.pcg_tries(self.sizes())

    def factor_size(self, max_blocks: int, max_products: float) -> Factor:
        """Return the size of the sparse factor; found at the first call with limits that it meets."""
        complete, blocks, products = self._kernel.analyse(max_blocks, max_products)
        return Factor(blocks, products, complete)

    def solve_sparse(self) -> FloatArray | None:
        """Return the solution by sparse Cholesky; None if S is not positive definite."""
        x: FloatArray | None = self._kernel.solve_sparse()
        return x

    def length2(self, kind: str, x: FloatArray, hessian: Hessian) -> float:
        """Return |D x|^2 of a solution in the scaled space of that kind."""
        if kind == "inc":
            return length2(self, kind, x, hessian)
        of_step: float = self._kernel.length2(kind == "diag", x)
        return of_step

    def solve_pcg(self, kind: str, scale: FloatArray, limits: PcgLimits, *, formed: bool) -> Solution:
        """Solve by PCG in the space scaled by 1 / ``scale``; the next call writes over the solution."""
        if kind == "two_level":
            return self.two_level.solve(self.sparse(), self.rhs, scale, limits)
        found, steps, on_boundary = self._kernel.pcg(scale, kind, limits, formed, self._x)
        return Solution(self._x if found else None, steps, on_boundary)

    def diagonal_blocks(self) -> tuple[FloatArray, ...]:
        """Return the diagonal blocks of S, (n_free, d, d)."""
        return (self._kernel.diagonal_blocks(),)

    def gather(self, of_keyframes: FloatArray, _of_points: FloatArray) -> FloatArray:
        """Return what belongs to the unknowns of S out of values for all unknowns."""
        return of_keyframes.ravel()

    def back_substitute(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return both steps and the reduction of the undamped model."""
        step_p, reduction = self._kernel.back_substitute(x)
        return x.reshape(-1, self._size), step_p, reduction


class NativeFactorSum(FactorSum):
    """The sum of all factors of a problem, stepped locally."""

    def __init__(self, factors: Sequence[KeyframeFactors], fixed: BoolArray) -> None:
        """Hand those on relative poses, and of poses in the world, over; they are copied."""
        super().__init__(factors, fixed)
        self._kernels = [self._kernel(kind, number) for number, kind in enumerate(self._factors)]
        n, pairs = len(self._free), len(self.rows)
        between = Pairs(self.rows, self.columns, np.empty((pairs, 6, 6)))
        self._sums = np.empty((n, 6)), np.empty((n, 6, 6)), between

    def linearise(self, state: State) -> FactorTerms:
        """Return what the factors add at a state; the next call writes over it."""
        if any(kernel is None for kernel in self._kernels):
            return super().linearise(state)
        gradient, diagonal, between = self._sums
        value, blocks = 0.0, between.blocks
        gradient[...] = diagonal[...] = blocks[...] = 0.0
        for kernel in self._kernels:
            assert kernel is not None
            value += kernel.linearise(state, gradient, diagonal, blocks)
        return FactorTerms(value, gradient, diagonal, between)

    def value(self, state: State) -> float:
        """Return 1/2 sum Psi."""
        total = 0.0
        known: Known = {}
        for kind, kernel in zip(self._factors, self._kernels, strict=True):
            total += self._value(kind, state, known) if kernel is None else kernel.value(state)
        return total

    def _add(self, kind: KeyframeFactors, number: int, state: State, terms: FactorTerms, known: Known) -> float:
        kernel = self._kernels[number]
        if kernel is None:
            return super()._add(kind, number, state, terms, known)
        return kernel.linearise(state, terms.gradient, terms.diagonal, terms.pairs.blocks)

    def _kernel(self, kind: KeyframeFactors, number: int) -> CompiledPoses | None:
        if not isinstance(kind, RelativePoses | PosePriors) or kind.loss not in native.LOSSES:
            return None
        own = isinstance(kind, PosePriors)
        pair = np.full(len(kind), -1) if own else self._pair[number][:, 0]
        given = _in_world(kind) if isinstance(kind, PosePriors) else kind
        kernel: CompiledPoses = native.kernels.RelativePoses(given, self._column, pair)
        return kernel


def _in_world(priors: PosePriors) -> SimpleNamespace:
    """Return measured poses as those of the body in a keyframe that is the world."""
    ends = np.insert(priors.keyframes, 0, -1, axis=1)
    return SimpleNamespace(**vars(priors) | {"keyframes": ends, "translation": priors.position})
