# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a problem of BAL or a scene of Bundler as a whole, and report how it went."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core.objective import rms_px, squared_errors
from ba_node.core.problem import Problem, State
from ba_node.core.result import Result, Status
from ba_node.core.solver import solve
from ba_node.estimate import Iteration
from ba_node.io.bal import BalProblem, behind, from_state, read_bal, to_problem, translated, write_bal
from ba_node.io.bundler import BundlerScene, from_bal, is_bundler, read_bundler, write_bundler
from ba_node.kept import kept_property

# Points that lie so many times their own extent from the origin are moved there: coordinates of a whole country, as UTM
# has them, leave too few digits to the steps of a solver.
_FAR = 10.0
# Observations behind their cameras from which on somebody has to look at the file; a few points may well end there.
_MANY_BEHIND = 0.01


@dataclass(frozen=True)
class Totals:
    """What is summed over all observations of a problem, each at its start and at its end."""

    rms_px: tuple[float, float]
    behind: tuple[int, int]  # observations of points behind their cameras


def totals(
    bal: BalProblem, problem: Problem, end: State, total: Callable[[FloatArray], FloatArray] = np.asarray
) -> Totals:
    """Return the totals of a problem, of which this may be a part: ``total`` adds up what all parts have."""
    with np.errstate(all="ignore"):  # infinite where the solve failed
        squares = [squared_errors(problem, state) for state in (problem.start, end)]
    behinds = [np.count_nonzero(behind(one)) for one in (bal, from_state(bal, end))]
    sums = total(np.array([*np.concatenate(squares), *behinds], dtype=float))
    return Totals((rms_px(sums[:2]), rms_px(sums[2:4])), (int(sums[4]), int(sums[5])))


@dataclass(frozen=True, kw_only=True)
class Solved:
    """What a solve of a file gave, whatever its format."""

    source: str  # the file or folder
    # (3,) of the coordinates in which it was solved, in those of the file; zeros if they are the same
    origin: FloatArray
    problem: Problem  # in our terms, moved by minus the origin
    result: Result  # state and trace
    options: SolverOptions  # with which it was solved
    setup_s: float = 0.0  # time to read and prepare it, s
    solve_s: float = 0.0  # time in the solver, s

    def told(self, behind: tuple[int, int], count: int, meaning: str) -> tuple[list[str], bool]:
        """Return what a user has to know, one sentence each, and whether the result has to be looked at for it.

        ``behind`` are the observations, of ``count``, of points behind their cameras at the start and at the end,
        ``meaning`` what becomes of them.
        """
        result, lines = self.result, list[str]()
        grave = max(behind) > _MANY_BEHIND * count
        if any(behind):
            lines.append(
                f"{behind[0]} of {count} observations are of points behind their camera at the start, {behind[1]} at"
                f" the end: {meaning}"
            )
        if result.status.usable and not result.objective_after <= result.objective_before:
            grave = True
            lines.append(
                f"the objective at the end, {result.objective_after:.8g}, is worse than at the start,"
                f" {result.objective_before:.8g}"
            )
        return lines, grave

    def statistics(
        self, sizes: tuple[int, int, int], rms_px: tuple[float, float], attention: list[str]
    ) -> dict[str, Any]:
        """Return statistics, options and trace for JSON; an infinite radius becomes null there.

        ``sizes`` are cameras, points, observations; ``rms_px`` is that at the start and at the end.
        """
        result = self.result
        return {
            "problem": {
                "file": Path(self.source).name,
                **dict(zip(("cameras", "points", "observations"), sizes, strict=True)),
            },
            "method": result.method,
            "linear_solver": result.linear_solver,
            "options": dataclasses.asdict(self.options),
            "status": result.status.name,
            "reason": result.reason,
            "objective_before": result.objective_before,
            "objective_after": result.objective_after,
            "rms_px_before": rms_px[0],
            "rms_px_after": rms_px[1],
            "iterations": max(0, len(result.trace) - 1),
            "accepted_iterations": result.accepted_iterations,
            "linear_iterations": result.linear_iterations,
            "trace": [row._asdict() for row in result.trace],
            "origin": self.origin.tolist(),
            "attention": attention,
            "setup_s": self.setup_s,
            "solve_s": self.solve_s,
        }


@dataclass(frozen=True, kw_only=True)
class Solution(Solved):
    """A solved file of BAL or Bundler."""

    bal: BalProblem  # its content, moved by minus the origin
    bundler: BundlerScene | None = None  # what else a file of Bundler holds
    # for ``totals`` where several ranks have found them, each for its part
    summed: Totals | None = None

    @kept_property
    def totals(self) -> Totals:
        """Return what is summed over all observations."""
        return self.summed or totals(self.bal, self.problem, self.result.state)

    def write(self, path: Path) -> None:
        """Write the problem with the solution as start: a scene of Bundler where the name ends in .out, else BAL."""
        refined = self.refined()
        if path.suffix != ".out":
            write_bal(path, refined)
        elif self.bundler is not None:
            write_bundler(path, dataclasses.replace(self.bundler, bal=refined))
        else:
            write_bundler(path, from_bal(refined, np.full(refined.points.shape, 255)))

    def refined(self) -> BalProblem:
        """Return the problem with the solution as start, in the coordinates of the file."""
        refined = from_state(self.bal, self.result.state)
        return translated(refined, self.origin) if self.origin.any() else refined

    def attention(self) -> tuple[list[str], bool]:
        """Return what a user has to know, one sentence each, and whether the result has to be looked at for it."""
        lines, grave = self.told(self.totals.behind, len(self.bal.observations), "they are not in the rms")
        focal = self.bal.cameras[:, 6]
        bad = np.flatnonzero(focal <= 0.0)
        if len(bad):
            grave = True
            lines.insert(
                0,
                f"{len(bad)} of {len(focal)} cameras have a focal length that is not positive (camera {bad[0]}:"
                f" f = {focal[bad[0]]:g} px): a BAL camera looks along -z and has f > 0; turn one that looks along +z"
                " by 180 degrees about its x axis, and give f and the signs of the pixels as the format has them",
            )
        return lines, grave

    def as_dict(self) -> dict[str, Any]:
        """Return statistics, options and trace for JSON."""
        sizes = (len(self.bal.cameras), len(self.bal.points), len(self.bal.observations))
        return self.statistics(sizes, self.totals.rms_px, self.attention()[0])


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
    solution = read(path, options)
    ready = clock()
    result = solve(solution.problem, options, clock=clock, on_iteration=on_iteration)
    return dataclasses.replace(solution, result=result, setup_s=ready - began, solve_s=clock() - ready)


def read(path: Path | str, options: SolverOptions) -> Solution:
    """Read a file as its own solution, to be solved yet.

    Raises:
        BalError: the file cannot be read.
        ProblemError: it holds no well-formed problem.
    """
    scene = read_bundler(Path(path)) if is_bundler(Path(path)) else None
    bal = read_bal(path) if scene is None else scene.bal
    origin = middle_if_far(bal.points)
    bal = translated(bal, -origin) if origin.any() else bal
    problem = to_problem(bal)
    unsolved = Result(problem.start, Status.SKIPPED, "not solved yet", options.method, ())
    return Solution(
        source=str(path), origin=origin, problem=problem, result=unsolved, options=options, bal=bal, bundler=scene
    )


def middle_if_far(points: FloatArray) -> FloatArray:
    """Return the middle of points (m, 3) if the origin is far from all of them, otherwise zeros."""
    if not len(points):
        return np.zeros(3)
    middle = _median(points)
    with np.errstate(over="ignore"):  # a few may lie anywhere
        extent = float(_median(np.linalg.norm(points - middle, axis=1)))
    return middle if float(np.linalg.norm(middle)) > _FAR * extent > 0.0 else np.zeros(3)


def _median(values: FloatArray) -> FloatArray:
    """Return the median over the first axis; np.median loads what numpy has for masked arrays (7 ms, 2 MB)."""
    n = len(values)
    middle: FloatArray = np.partition(values, ((n - 1) // 2, n // 2), axis=0)[[(n - 1) // 2, n // 2]].mean(axis=0)
    return middle
