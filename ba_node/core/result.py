# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what a solve returns: the state, a trace of its iterations, and why it stopped."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from ba_node.core.problem import State
from ba_node.kept import kept_property


class Status(enum.IntEnum):
    """Why a solve stopped; the values are those of ``ba_msgs/SolverReport``."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    STALLED = 2
    SKIPPED = 3
    FAILED = 4
    HELD = 5

    @property
    def usable(self) -> bool:
        """Return True if the estimate may replace what was known."""
        return self in (Status.CONVERGED, Status.MAX_ITERATIONS, Status.STALLED)


class Iteration(NamedTuple):
    """One row of the trace. Row 0 is the start."""

    iteration: int  # number of the outer iteration
    time_s: float  # seconds since the solve began, by the caller's clock
    objective: float  # robust objective after the iteration (dimensionless, px^2 / sigma^2)
    gradient_norm: float  # Euclidean norm of its gradient
    linear_iterations: int  # PCG steps; 0 with a direct solver
    accepted: bool  # True if the step was taken
    damping: float  # mu during the iteration
    radius: float  # radius of the trust region during the iteration, inf without one
    side: str = ""  # what was eliminated: points, cameras or none; empty in row 0


@dataclass(frozen=True)
class Result:
    """What a solve returns. ``state`` is finite always; on FAILED and SKIPPED it is the start.

    ``linear_solver`` says how the reduced systems were solved, and what that takes; empty if there was none.
    ``loosest`` works out ``weakest``, ``at_end`` the ``gradient_norm`` where the trace ends without it.
    """

    state: State
    status: Status
    reason: str
    method: str
    trace: tuple[Iteration, ...]
    linear_solver: str = ""
    loosest: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0)
    at_end: Callable[[], float] | None = None

    @kept_property
    def weakest(self) -> tuple[float, float]:
        """Return what ``covariance.weakest`` has of the free poses, worked out now; 0, 0 if it was not asked for."""
        return self.loosest()

    def settled(self) -> Result:
        """Return the same, with ``weakest`` worked out and without what that takes."""
        # Not by the property: in Python 3.11 one thread alone may work a cached one out, and ranks do it together.
        weakest = self.loosest()
        return replace(self, loosest=lambda: weakest)

    @property
    def objective_before(self) -> float:
        """Return the objective at the start."""
        return self.trace[0].objective if self.trace else 0.0

    @property
    def objective_after(self) -> float:
        """Return the objective at the end."""
        return self.trace[-1].objective if self.trace else 0.0

    @kept_property
    def gradient_norm(self) -> float:
        """Return the norm of the gradient at the end, worked out now if nobody had time to."""
        if self.at_end is not None:
            return self.at_end()
        return self.trace[-1].gradient_norm if self.trace else 0.0

    @property
    def linear_iterations(self) -> int:
        """Return the number of PCG steps in all."""
        return sum(row.linear_iterations for row in self.trace)

    @property
    def accepted_iterations(self) -> int:
        """Return the number of steps that were taken."""
        return sum(row.accepted for row in self.trace[1:])
