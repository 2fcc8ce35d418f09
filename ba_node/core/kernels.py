# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the solver asks of the heavy arithmetic of one problem; numpy_kernels.py and native_kernels.py do it."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import scipy

from ba_node.arrays import FloatArray
from ba_node.core import scaling
from ba_node.core.linear import PcgLimits, Solution
from ba_node.core.problem import State

# Up to this many unknowns PCG forms S for its products.
DENSE_LIMIT = 3000


class Hessian(Protocol):
    """What returns the diagonal of H."""

    def __call__(self, *, of_points: bool) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) and diag(C), not damped; see Kernels.diagonals."""


class StepResult(NamedTuple):
    """What a step did."""

    state: State  # after the step and the inner iterations
    predicted: float  # by what the undamped model said the objective would fall, ``-g'p - 1/2 |J p|^2``
    damping: float  # ``1/2 mu p'D p``, which the damped model adds
    before_inner: float  # objective after the step alone; NaN if the state is not finite
    objective: float  # objective of ``state``; NaN if that is not finite


class LinearSolver(NamedTuple):
    """How a system is to be solved: dense, sparse or pcg, and a line that tells of it, with what it costs."""

    kind: str
    text: str
    preconditioner: str = "schur_block"  # of PCG, which goes to the boundary of a region for exact solvers too
    two_level_bytes: float = 0.0  # memory that two levels would take; 0 where that is not known


class System(Protocol):
    """A damped system ``S x = rhs`` after elimination of the points, of the keyframes, or of nothing."""

    unknowns: int  # n
    side: str  # what was eliminated: points, cameras or none
    radius_factor: float  # by what the radius of a trust region is multiplied on this side

    @property
    def rhs(self) -> FloatArray:
        """Return the right-hand side, (n,)."""

    def choose(self, asked: str) -> LinearSolver:
        """Return how to solve systems like this one.

        Args:
            asked: ``auto`` for what costs least, ``cholesky`` for the cheapest that is exact, or one kind by its name.
        """

    def pcg_tries(self) -> int:
        """Return how many steps of PCG to try before an exact solution, as they cost next to nothing; 0 for none."""

    def solve_dense(self) -> FloatArray | None:
        """Return the solution by dense Cholesky; None if S is not positive definite."""

    def solve_sparse(self) -> FloatArray | None:
        """Return the solution by sparse Cholesky; None if S is not positive definite."""

    def length2(self, kind: str, x: FloatArray, hessian: Hessian) -> float:
        """Return |D x|^2 of a solution in the scaled space of that kind; see scaling.py."""

    def solve_pcg(self, kind: str, scale: FloatArray, limits: PcgLimits, *, formed: bool) -> Solution:
        """Return the solution by PCG in the space ``D x``, in the space that is not scaled.

        ``kind`` is the preconditioner, ``scale`` (n,) 1/D; the radius of the limits is that of the scaled space. S is
        ``formed`` for the products.
        """

    def gather(self, of_keyframes: FloatArray, of_points: FloatArray) -> FloatArray:
        """Return (n,) what belongs to the unknowns of S out of values (n_free, d) and (n_points, 3)."""

    def back_substitute(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return steps (n_free, d), (n_points, 3) and the reduction ``-g'p - 1/2 |J p|^2`` of the undamped model."""

    def dense(self) -> FloatArray:
        """Return S, (n, n)."""

    def sparse(self) -> scipy.sparse.spmatrix:
        """Return S, sparse."""

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x without forming S."""

    def diagonal_blocks(self) -> tuple[FloatArray, ...]:
        """Return the diagonal blocks of S in runs of equal size, each (n, d, d)."""


def length2(system: System, kind: str, x: FloatArray, hessian: Hessian) -> float:
    """Return |D x|^2 of a solution, with D of :func:`scaling.scaled_space`."""
    if kind in ("none", "identity"):
        return float(np.dot(x, x))
    # In every iteration, and without roots.
    diagonals = scaling.diagonals(kind, hessian(of_points=system.side != "points"))
    squares = diagonals if kind == "diag" else (diagonals[0] ** 2, diagonals[1] ** 2)
    return float(np.dot(system.gather(*squares) * x, x))


class Kernels(Protocol):
    """What the solver's loop asks of a problem."""

    n_free: int
    size: int
    gradient_norm: float

    def linearise(self, state: State) -> float:
        """Linearise at a state and keep the normal equations; return the objective there."""

    def gradient(self) -> FloatArray:
        """Return the keyframes' part of the gradient, (n_free, d)."""

    def diagonals(self, *, of_points: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) (n_free, d) and diag(C) (n_points, 3), or (0, 3) unless that is wanted too."""

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> System:
        """Add damping to the diagonals and eliminate."""

    def damp(self, kind: str, mu: float) -> System:
        """Add mu D, with D a choice of damping, to the diagonals and eliminate."""

    def step(self, state: State, system: System, x: FloatArray, inner_iterations: int) -> StepResult:
        """Take the step whose part in ``system`` is x, and the inner iterations after it.

        The kernels may write over what this returned two calls before.
        """

    def objective(self, state: State) -> float:
        """Return the robust objective."""

    def iterate_points(self, state: State, iterations: int) -> tuple[float, State]:
        """Improve every point alone by up to so many damped Newton steps; return the objective and the state."""
