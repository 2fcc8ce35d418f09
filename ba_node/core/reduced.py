# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve one damped, reduced system by the linear solver that was asked for, or by the cheapest (linear_costs.py).

Directly: dense S with LAPACK's Cholesky, or S by blocks with a sparse one. Or inexactly: by PCG in the scaled space
inside the trust region (Algorithm 4). In the scaled space ``x~ = D x`` (3.94-3.99) the system is
``D^-1 S D^-1 x~ = D^-1 rhs``; the region, the residual that ends PCG, and the preconditioner all live there. Without a
region D is that of the damping (Algorithm 7).

An exact solution is the limit of PCG for t_eps -> 0. If it leaves the region it is cut off at the boundary: PCG would
get there on a curve, by hundreds of steps where S is badly conditioned, for the same progress.

Where a step of PCG costs next to nothing beside an exact solution, PCG is tried first, as long as it gets there.
"""

from __future__ import annotations

import math

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import linear, scaling
from ba_node.core.kernels import DENSE_LIMIT, Hessian, System

# Where steps of PCG cost next to nothing beside the rest of an iteration, they go nearly as far as an exact solution.
_NEARLY = 0.01


class ReducedSolver:
    """Solve the systems of one run, all in the same way."""

    def __init__(self, options: SolverOptions) -> None:
        self._options = options
        self.kind = ""  # dense, sparse or pcg; empty while none has been needed
        self._preconditioner = options.preconditioner
        self.text = ""  # how the systems were solved, for the report, with what it costs
        # Steps of PCG to be tried before an exact solver; 0 once they did not get there; None before the first system.
        self._tries: int | None = None

    def solve(self, system: System, hessian: Hessian, radius: float) -> linear.Solution:
        """Return the solution of ``S x = rhs`` in the space that is not scaled.

        The radius is in the scaled space, infinite for none.
        """
        if system.unknowns == 0:
            return linear.Solution(np.zeros(0))
        if self._tries is None:
            self._tries = self._worth_trying(system)
        if self._tries:
            found = self._try(system, hessian, self._tries, radius)
            if found.iterations < self._tries:
                return found
            self._tries = 0
        if not self.kind:
            self._choose(system)
        options, t_eps, q_eps = self._options, self._options.t_eps, self._options.q_eps
        radius *= system.radius_factor
        if self.kind != "pcg":
            x = system.solve_dense() if self.kind == "dense" else system.solve_sparse()
            return linear.Solution(None) if x is None else self._inside(x, system, hessian, radius)
        if self._preconditioner == "two_level":
            t_eps, q_eps = min(t_eps, _NEARLY), min(q_eps, _NEARLY)
        limits = linear.PcgLimits(t_eps, options.max_linear_iterations, radius, q_eps)
        return self._pcg(system, hessian, limits, self._preconditioner, formed=system.unknowns <= DENSE_LIMIT)

    def _inside(self, x: FloatArray, system: System, hessian: Hessian, radius: float) -> linear.Solution:
        """Return the part of a solution that lies inside the region, None if it is no step at all."""
        length2 = system.length2(self._options.scaled_space if radius < math.inf else "none", x, hessian)
        # No square is finite of what is not, nor of a step that is no step any more.
        if not math.isfinite(length2):
            return linear.Solution(None)
        if length2 <= radius * radius:
            return linear.Solution(x)
        return linear.Solution(radius / math.sqrt(length2) * x, on_boundary=True)

    def _worth_trying(self, system: System) -> int:
        """Return how many steps of PCG to try before an exact solver."""
        options = self._options
        tries = system.pcg_tries() if options.linear_solver == "auto" else 0
        if tries:
            self.text = f"PCG ({system.unknowns} unknowns), as long as less than {tries} steps do"
        return tries

    def _try(self, system: System, hessian: Hessian, steps: int, radius: float) -> linear.Solution:
        """Solve by a few steps of PCG; if all of them were taken they did not get there.

        M is made of B: Z, of which the blocks of S are made, would cost as much as the steps that it saves.
        """
        t_eps, q_eps = (min(eps, _NEARLY) for eps in (self._options.t_eps, self._options.q_eps))
        return self._pcg(system, hessian, linear.PcgLimits(t_eps, steps, radius, q_eps), "b_block", formed=False)

    def _pcg(
        self, system: System, hessian: Hessian, limits: linear.PcgLimits, kind: str, *, formed: bool
    ) -> linear.Solution:
        """Solve by PCG with a preconditioner, in the scaled space."""
        scale = 1.0 / self._scale(system, hessian, literal=kind == "b_literal")
        return system.solve_pcg(kind, scale, limits, formed=formed)

    def _scale(self, system: System, hessian: Hessian, *, literal: bool = False) -> FloatArray:
        """Return D of the scaled space for the unknowns of S."""
        # Points have no part in S where they were eliminated; most maps have many.
        diagonals = hessian(of_points=system.side != "points")
        return system.gather(*scaling.scaled_space(self._options.scaled_space, diagonals, literal=literal))

    def _choose(self, system: System) -> None:
        """Settle on a linear solver."""
        self.kind, self.text, preconditioner, _ = system.choose(self._options.linear_solver)
        if self._preconditioner == "auto":
            self._preconditioner = preconditioner
        if self.kind == "pcg" and self._preconditioner == "two_level":
            self.text += ", preconditioned on two levels"
