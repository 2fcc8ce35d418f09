# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve one problem on several processes: points and their observations are dealt to ranks, keyframes are on all.

Of a sum over observations each rank has its part. So objective, gradient, diag(B), the right-hand side, the diagonal
blocks of S and products with S are sums over ranks (Agarwal et al. 2010, section 5; Wu et al. 2011), the loop of
solver.py runs on every rank with the same numbers, and each rank steps and iterates its own points. S itself is summed
where a factor pays. Factors between keyframes belong to rank 0.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy

from ba_node import native
from ba_node.arrays import FloatArray, IntArray
from ba_node.config import ConfigError, SolverOptions
from ba_node.core import linear, linear_costs, native_kernels, scaling
from ba_node.core.communicator import Communicator, total
from ba_node.core.kernels import DENSE_LIMIT, LinearSolver, StepResult, System, length2
from ba_node.core.numpy_kernels import solve_pcg
from ba_node.core.problem import Problem, ProblemError, State
from ba_node.core.two_level import TwoLevel

_PRECONDITIONERS = ("auto", "none", "schur_block", "schur_diag", "two_level")


def deal(problem: Problem, rank: int, size: int) -> tuple[Problem, slice]:
    """Return the part of a problem that a rank has, and which points these are: neighbours, with their observations.

    Raises:
        ProblemError: there are more ranks than points.
    """
    obs = problem.observations
    cuts = point_cuts(np.searchsorted(obs.point, np.arange(problem.n_points), side="right"), size)
    points = slice(int(cuts[rank]), int(cuts[rank + 1]))
    rows = slice(*np.searchsorted(obs.point, [points.start, points.stop]).tolist())

    def part(array: FloatArray | IntArray) -> Any:
        return array[rows].copy() if len(array) else array  # so that the whole need not stay

    own = {field.name: part(getattr(obs, field.name)) for field in dataclasses.fields(obs)}
    own["point"] = own["point"] - points.start
    start = dataclasses.replace(problem.start, points=problem.start.points[points].copy())
    changes: dict[str, Any] = {"start": start, "observations": dataclasses.replace(obs, **own)}
    if rank:
        changes["factors"] = ()
    return dataclasses.replace(problem, **changes), points


def point_cuts(ends: IntArray, size: int) -> IntArray:
    """Return where the points of each rank begin, (size + 1,), as even by observations as can be.

    Args:
        ends: (n_points,) observations of each point and of all before it.
        size: number of ranks; each gets a point.

    Raises:
        ProblemError: there are more ranks than points.
    """
    n = len(ends)
    if size > n:
        raise ProblemError(f"{size} ranks for {n} points: take at most one rank a point")
    # Cut where the observations before come nearest to equal shares, but leave everybody a point.
    cuts = np.searchsorted(ends, ends[-1] * np.arange(size + 1) / size)
    cuts[0], cuts[-1] = 0, n
    for i in range(1, size):
        cuts[i] = min(max(cuts[i], cuts[i - 1] + 1), n - (size - i))
    return np.asarray(cuts)


class RankKernels:
    """The kernels of one rank's part of a problem, with what all ranks need summed over them."""

    def __init__(self, part: Problem, options: SolverOptions, communicator: Communicator) -> None:
        """Take a rank's part of a problem, see :func:`deal`.

        Raises:
            ConfigError: the options ask for what cannot be had on several ranks.
        """
        if options.schur != "points" or options.annealing != "none":
            raise ConfigError(
                "several ranks eliminate the points, without annealing: take schur = points, another loss"
            )
        if options.preconditioner not in _PRECONDITIONERS:
            raise ConfigError(
                f"option preconditioner = {options.preconditioner!r} with several ranks: take one of"
                f" {', '.join(_PRECONDITIONERS)}"
            )
        self._local, self._communicator = native_kernels.make(part, options), communicator
        self.n_free, self.size = self._local.n_free, self._local.size
        self._two_level, self._factor = TwoLevel(np.flatnonzero(~part.fixed), communicator), SumFactor()
        self.gradient_norm = np.inf
        self._gradient: FloatArray
        self._diagonals: tuple[FloatArray, FloatArray]

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""
        self._two_level.state = state
        value = self._local.linearise(state)
        own, (d_c, d_p) = self._local.gradient(), self._local.diagonals()
        of_points = max(self._local.gradient_norm**2 - float(np.sum(own * own)), 0.0)
        numbers = self._communicator.sum(np.concatenate([[value, of_points], own.ravel(), d_c.ravel()]))
        gradient, d_c = numbers[2 : 2 + own.size], numbers[2 + own.size :].reshape(d_c.shape)
        self.gradient_norm = float(np.sqrt(gradient @ gradient + numbers[1]))
        self._gradient, self._diagonals = gradient.reshape(d_c.shape), (d_c, d_p)
        return float(numbers[0])

    def gradient(self) -> FloatArray:
        """Return the keyframes' part of the gradient, (n_free, d)."""
        return self._gradient

    def diagonals(self, *, of_points: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) (n_free, d) of all, and diag(C) (n_points, 3) of this rank's points, or (0, 3)."""
        d_c, d_p = self._diagonals
        return d_c, d_p if of_points else d_p[:0]

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> RankSystem:
        """Add damping to the diagonals and eliminate the points."""
        own = damping_c if self._communicator.rank == 0 else np.zeros_like(damping_c)
        return RankSystem(self._local.reduce(own, damping_p), self._communicator, self._two_level, self._factor)

    def damp(self, kind: str, mu: float) -> RankSystem:
        """Add mu D, with D a choice of damping, to the diagonals and eliminate the points."""
        d_c, d_p = scaling.diagonals(kind, self._diagonals)
        return self.reduce(mu * d_c, mu * d_p)

    def step(self, state: State, system: System, x: FloatArray, inner_iterations: int) -> StepResult:
        """Take the step whose part in ``system`` is x, and the inner iterations after it."""
        assert isinstance(system, RankSystem)
        own = self._local.step(state, system.local, x, inner_iterations)
        numbers = np.array([own.predicted, own.damping, own.before_inner, own.objective])
        return StepResult(own.state, *self._communicator.sum(numbers).tolist())

    def objective(self, state: State) -> float:
        """Return the robust objective."""
        return float(self._communicator.sum(np.array([self._local.objective(state)]))[0])

    def iterate_points(self, state: State, iterations: int) -> tuple[float, State]:
        """Improve every point alone by up to so many damped Newton steps; return the objective and the state."""
        value, moved = self._local.iterate_points(state, iterations)
        return float(self._communicator.sum(np.array([value]))[0]), moved


class SumFactor:
    """The sparse Cholesky factor of S summed over ranks, on rank 0; its structure is found again where that changes."""

    def __init__(self) -> None:
        self._pattern: tuple[IntArray, IntArray] = (np.empty(0, np.int64), np.empty(0, np.int64))
        self._compiled: Any = None

    def solve(self, s: scipy.sparse.bsr_matrix, rhs: FloatArray) -> FloatArray | None:
        """Return the solution of ``S x = rhs``, None if S is not positive definite; scipy's without C++ kernels."""
        if native.kernels is None:
            return linear.cholesky(s, rhs).x
        s.sort_indices()
        rows = np.repeat(np.arange(len(s.indptr) - 1), np.diff(s.indptr))
        upper = np.flatnonzero(s.indices >= rows)
        pattern = s.indices[upper].astype(np.int64), np.searchsorted(rows[upper], np.arange(len(s.indptr)))
        if self._compiled is None or not all(map(np.array_equal, pattern, self._pattern)):
            self._compiled, self._pattern = native.kernels.SparseFactor(s.blocksize[0], *pattern), pattern
        x = rhs.copy()
        return x if self._compiled.solve(s.data[upper], x) and np.isfinite(x).all() else None


class RankSystem:
    """The reduced system of all points, of which each rank has the part that its own points leave."""

    side = "points"
    radius_factor = 1.0
    length2 = length2

    def __init__(self, local: System, communicator: Communicator, two_level: TwoLevel, factor: SumFactor) -> None:
        self.local, self._communicator, self._two_level, self._factor = local, communicator, two_level, factor
        self.rhs: FloatArray = communicator.sum(local.rhs)
        self.unknowns = len(self.rhs)

    def choose(self, asked: str) -> LinearSolver:
        """Return how to solve systems like this one: dense while S is small, else by products with S."""
        n = len(self.rhs)
        if asked in ("auto", "cholesky"):
            asked = "dense" if n <= DENSE_LIMIT else "pcg" if asked == "auto" else "sparse"
        text = linear_costs.describe(asked, n, None, None)
        own = self.local.choose("pcg")
        # Ranks on one machine share its memory.
        fits = self._communicator.neighbours * own.two_level_bytes <= linear_costs.MAX_BYTES
        choices = self._communicator.gather(own.preconditioner if fits else "schur_block")
        preconditioner = self._communicator.broadcast(None if choices is None else min(choices))
        return LinearSolver(asked, f"{text}, on {self._communicator.size} ranks", preconditioner)

    def pcg_tries(self) -> int:
        """Try no steps of PCG."""
        return 0

    def dense(self) -> FloatArray:
        """Return S, (n, n)."""
        return self._communicator.sum(self.local.dense())

    def solve_dense(self) -> FloatArray | None:
        """Return the solution by dense Cholesky, on rank 0; None if S is not positive definite."""
        matrix = self.dense()
        x: FloatArray | None = self._communicator.broadcast(
            linear.cholesky(matrix, self.rhs).x if self._communicator.rank == 0 else None
        )
        return x

    def sparse(self) -> Any:
        """Return S, sparse."""
        return total(self._communicator, self.local.sparse())

    def solve_sparse(self) -> FloatArray | None:
        """Return the solution by sparse Cholesky, on rank 0; None if S is not positive definite."""
        parts = self._communicator.gather(self.local.sparse())
        x = None if parts is None else self._factor.solve(sum(parts[1:], parts[0]), self.rhs)
        found: FloatArray | None = self._communicator.broadcast(x)
        return found

    def solve_pcg(self, kind: str, scale: FloatArray, limits: linear.PcgLimits, *, formed: bool) -> linear.Solution:
        """Return the solution by PCG in the space scaled by 1 / ``scale``, with products summed over ranks."""
        if kind == "two_level":
            return self._two_level.solve(self.local.sparse(), self.rhs, scale, limits)
        return solve_pcg(kind, self, scale, limits, formed=formed)

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x."""
        return self._communicator.sum(self.local.product(x))

    def diagonal_blocks(self) -> tuple[FloatArray, ...]:
        """Return the diagonal blocks of S, (n_free, d, d)."""
        return tuple(self._communicator.sum(part) for part in self.local.diagonal_blocks())

    def own_blocks(self) -> tuple[FloatArray, ...]:
        """Return the same: B is not summed."""
        return self.diagonal_blocks()

    def gather(self, of_keyframes: FloatArray, _of_points: FloatArray) -> FloatArray:
        """Return what belongs to the unknowns of S out of values for all unknowns."""
        return of_keyframes.ravel()

    def back_substitute(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the step of the keyframes, that of this rank's points, and the reduction of the undamped model."""
        step_c, step_p, own = self.local.back_substitute(x)
        return step_c, step_p, float(self._communicator.sum(np.array([own]))[0])
