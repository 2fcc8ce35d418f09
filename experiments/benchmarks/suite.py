# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run solvers side by side on problems, check them against each other, and keep what they gave."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ba_node.config import SolverOptions
from ba_node.core.cameras import MIN_DEPTH
from ba_node.core.objective import Objective
from experiments.benchmarks import metrics
from experiments.benchmarks.floor import Peak, floor_s
from experiments.benchmarks.problem_file import Case, case_problem
from experiments.benchmarks.problems import Problem
from experiments.benchmarks.process import Limits, Run, objective, run
from experiments.benchmarks.solvers import Solver

# A solver whose objective is off by more than this, at the start or at the end, minimised something else. The start
# of a solver that prints seven digits agrees to half a digit of the last.
START_AGREES = 1e-9
START_AGREES_PRINTED = 1e-6
END_AGREES = 1e-4
# Relative figures count from this share of the start's objective where the best is next to nothing.
_NOTHING = 1e-9
# A solver that took so long on a problem, all runs together, is not run on it again; after three runs the time is
# shorter, as long runs scatter less, s.
_LONG_S = 4.0
_LONG_AFTER_THREE_S = 0.5


@dataclass
class Result:
    """What one solver gave on one problem."""

    solver: str  # its name
    runs: list[Run] = field(default_factory=list)  # one a repeat; those that failed have no trace
    refused: str = ""  # why it took no part, or empty
    faults: list[str] = field(default_factory=list)  # how its objectives differ from ours

    @property
    def good(self) -> list[Run]:
        """Return the runs that ended, if they minimised what the others did."""
        return [] if self.faults else [one for one in self.runs if one.trace]

    def medians(self, f_start: float, f_best: float) -> dict[str, float]:
        """Return the figures of the tables; NaN where it took no part, inf for never."""
        good = self.good
        took_part = not self.refused and not self.faults and bool(self.runs)
        out = {
            "final": metrics.median(one.checked for one in good),
            "total_s": metrics.median(one.total_s for one in good),
            "setup_s": metrics.median(one.trace[0][0] for one in good),
            "iterations": metrics.median(len(one.trace) - 1 for one in good),
            "iteration_s": metrics.median(metrics.iteration_s(one.trace) for one in good),
            "start_mb": metrics.median(one.start_mb for one in good),
            "peak_mb": metrics.median(one.peak_mb for one in good),
        }
        for name, target in metrics.targets(f_start, f_best).items():
            times = [metrics.time_to(one.trace, target) for one in self.runs]
            out[name] = metrics.median(times) if took_part else math.nan
        return out


@dataclass
class Comparison:
    """All solvers on one problem."""

    problem: Problem
    counts: tuple[int, int, int, int]
    f_start: float
    floor_s: float
    results: list[Result]

    @property
    def f_best(self) -> float:
        """Return the lowest objective of any solution, recomputed by us."""
        finals = [one.checked for result in self.results for one in result.good if math.isfinite(one.checked)]
        return min(finals, default=self.f_start)

    def medians(self) -> dict[str, dict[str, float]]:
        """Return the figures by solver."""
        f_best = max(self.f_best, _NOTHING * self.f_start)
        return {result.solver: result.medians(self.f_start, f_best) for result in self.results}

    def as_dict(self) -> dict[str, Any]:
        """Return everything, for JSON."""
        names = ("cameras", "points", "observations", "parameters_a_camera")
        return {
            "problem": self.problem.name,
            **dict(zip(names, self.counts, strict=True)),
            "f_start": self.f_start,
            "f_best": self.f_best,
            "floor_iteration_s": self.floor_s,
            "solvers": [{**dataclasses.asdict(result)} for result in self.results],
        }


def compare(
    problem: Problem,
    prepared: tuple[Path, Case],
    solvers: Sequence[Solver],
    peak: Peak,
    repeats: int,
    limits: Limits,
    say: Callable[[str], None],
) -> Comparison:
    """Run all solvers on a problem, in turns, so that a slow minute of the machine meets all alike."""
    file, case = prepared
    f_start = objective(case, problem.loss)
    behind = _any_behind(case)
    results = [Result(solver.name, refused=solver.refuses(case, behind)) for solver in solvers]
    for _ in range(repeats):
        for solver, result in zip(solvers, results, strict=True):
            if result.refused or _is_settled(result):
                continue
            one = run(solver, file, case, problem.loss, limits)
            result.runs.append(one)
            result.faults = faults(one, f_start, START_AGREES_PRINTED if solver.printed else START_AGREES)
            say(f"  {solver.name}: {_line(one)}")
    bal = case.bal
    counts = len(bal.cameras), len(bal.points), len(bal.observations), case.size
    return Comparison(problem, counts, f_start, floor_s(case, peak), results)


def faults(one: Run, f_start: float, start_agrees: float) -> list[str]:
    """Return how the objectives that a solver told differ from ours, at the start and at its solution."""
    if not one.trace:
        return []
    out = []
    nothing = _NOTHING * f_start
    for name, told, ours, limit in (
        ("start", one.trace[0][1], f_start, start_agrees),
        ("end", metrics.lowest(one.trace), one.checked, END_AGREES),
    ):
        off = abs(told - ours) / max(ours, nothing)
        if not off <= limit:
            out.append(f"its objective at the {name} is {told:.9g}, ours there {ours:.9g}")
    return out


def _is_settled(result: Result) -> bool:
    """Return True if a further run would take long or fail again."""
    failed = bool(result.faults) or any(not one.trace for one in result.runs)
    return failed or sum(one.total_s for one in result.runs) > (
        _LONG_S if len(result.runs) < 3 else _LONG_AFTER_THREE_S
    )


def _any_behind(case: Case) -> bool:
    problem = case_problem(case)
    return bool((Objective(problem, SolverOptions()).in_camera(problem.start)[:, 2] <= MIN_DEPTH).any())


def _line(one: Run) -> str:
    if not one.trace:
        return one.reason
    return f"{one.checked:.8g} after {one.total_s:.3f} s, {len(one.trace) - 1} iterations, {one.peak_mb:.0f} MB"
