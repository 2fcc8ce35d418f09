# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a BAL problem as a whole, and tell everything about how it went."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ba_node.core.options import SolverOptions
from ba_node.core.problem import Problem
from ba_node.core.result import Iteration, Result
from ba_node.core.solver import solve
from ba_node.io.bal import BalProblem, from_state, read_bal, to_problem
from ba_node.offline.solver_settings import describe
from ba_node.window.quality import problem_rms_px


@dataclass(frozen=True)
class Solution:
    """A solved file.

    Attributes:
        source: the file.
        bal: what it held.
        problem: the same in our terms.
        result: state and trace.
        options: with which it was solved.
        setup_s: time to read and prepare it, s.
        solve_s: time in the solver, s.
    """

    source: str
    bal: BalProblem
    problem: Problem
    result: Result
    options: SolverOptions
    setup_s: float
    solve_s: float

    def refined(self) -> BalProblem:
        """Return the problem with the solution as start."""
        return from_state(self.bal, self.result.state)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON; an infinite radius becomes null there."""
        result = self.result
        rms_before, rms_after = problem_rms_px(self.problem, self.problem.start, result.state)
        return {
            "problem": {
                "file": Path(self.source).name,
                "cameras": self.problem.n_keyframes,
                "points": self.problem.n_points,
                "observations": len(self.problem.observations),
            },
            "method": result.method,
            "linear_solver": result.linear_solver,
            "options": describe(self.options),
            "status": result.status.name,
            "reason": result.reason,
            "objective_before": result.objective_before,
            "objective_after": result.objective_after,
            "rms_px_before": rms_before,
            "rms_px_after": rms_after,
            "iterations": max(0, len(result.trace) - 1),
            "accepted_iterations": result.accepted_iterations,
            "linear_iterations": result.linear_iterations,
            "setup_s": self.setup_s,
            "solve_s": self.solve_s,
            "trace": [dataclasses.asdict(row) for row in result.trace],
        }


def solve_file(
    path: Path | str,
    options: SolverOptions,
    *,
    clock: Callable[[], float],
    on_iteration: Callable[[Iteration], bool] | None = None,
) -> Solution:
    """Read and solve a file; see :func:`ba_node.core.solver.solve` for the arguments.

    Raises:
        BalError: the file cannot be read.
        ProblemError: it holds no well-formed problem.
    """
    began = clock()
    bal = read_bal(path)
    problem = to_problem(bal)
    ready = clock()
    result = solve(problem, options, clock=clock, on_iteration=on_iteration)
    return Solution(str(path), bal, problem, result, options, ready - began, clock() - ready)
