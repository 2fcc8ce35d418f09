# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Show what each ingredient of the default method is worth.

Usage: ``python -m experiments.benchmarks.ingredients "window-20 huber"``.

Each is left out in turn. Variants take turns in one process, so that a change of the machine's load meets all; times
are the least of the runs, to within 0.1 % of the lowest objective that any of them reached.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from pathlib import Path

from ba_node.config import SolverOptions
from ba_node.core.methods import METHODS
from ba_node.core.solver import solve
from experiments.benchmarks import problems
from experiments.benchmarks.metrics import time_to
from experiments.benchmarks.problem_file import Case, case_problem
from experiments.benchmarks.report import table

GAP = 1e-3
Trace = list[tuple[float, float]]


def variants(loss: str) -> dict[str, SolverOptions]:
    """Return the default method and what is left of it without each of its ingredients."""
    base = dataclasses.replace(
        METHODS["auto"], loss=loss, cheirality="keep", max_iterations=100, function_tolerance=1e-8
    )
    return {
        "all": base,
        "inner_iterations=0": dataclasses.replace(base, inner_iterations=0),
        "damping_policy=nielsen": dataclasses.replace(base, damping_policy="nielsen"),
        "linear_solver=cholesky": dataclasses.replace(base, linear_solver="cholesky"),
        "linear_solver=pcg": dataclasses.replace(base, linear_solver="pcg"),
        "threads=2": dataclasses.replace(base, threads=2),
        "kernels=numpy": dataclasses.replace(base, kernels="numpy"),
        "kernels=numpy parameterisation=global": dataclasses.replace(base, kernels="numpy", parameterisation="global"),
    }


def run(case: Case, options: SolverOptions) -> Trace:
    """Return (seconds with the set-up, objective) of the start and after each iteration."""
    began = time.perf_counter()
    problem = case_problem(case)
    before = time.perf_counter() - began
    result = solve(problem, options, clock=time.perf_counter)
    return [(before + row.time_s, row.objective) for row in result.trace]


def rows(case: Case, loss: str, repeats: int) -> list[list[str]]:
    """Return one row a variant: iterations and ms to the target, and how many times as long as with everything."""
    choices = variants(loss)
    traces: dict[str, list[Trace]] = {name: [] for name in choices}
    for repeat in range(repeats):
        for name, options in choices.items():
            if options.kernels != "numpy" or repeat < 2:
                traces[name].append(run(case, options))
    target = (1.0 + GAP) * min(row[1] for runs in traces.values() for row in runs[0])
    seconds = {name: min(time_to(trace, target) for trace in runs) for name, runs in traces.items()}
    out = []
    for name, runs in traces.items():
        steps = next((i for i, row in enumerate(runs[0]) if row[1] <= target), None)
        factor = seconds[name] / seconds["all"]
        shown = [f"{1e3 * seconds[name]:.2f}", f"{factor:.2f}"] if math.isfinite(factor) else ["never", ""]
        out.append([name, "" if steps is None else str(steps), *shown])
    return out


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks.ingredients", description=__doc__)
    parser.add_argument("problems", nargs="+", metavar="NAME", help="problems whose name contains NAME")
    parser.add_argument("--data", type=Path, default=problems.DATA)
    parser.add_argument("--work", type=Path, default=Path("out/bench"))
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    for problem in problems.chosen(args.problems, set()):
        prepared = problems.prepare(problem, args.data, args.work / "problems")
        if prepared is None:
            print(f"skipped: {problem.name}: no {problem.needs} in {args.data}")
            continue
        found = rows(prepared[1], problem.loss, args.repeats)
        print(f"\n{problem.name}\n\n{table(['variant', 'iterations', 'ms to 0.1 %', 'times all'], found)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
