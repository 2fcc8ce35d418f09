# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Show where the time of ba_node's iteration goes: ``python -m experiments.benchmarks.breakdown "window-20 huber"``.

Solves the same problem several times in one process and shows for each part the median over the solves, so that what
happens once a process (imports, first touch of libraries) is told apart: it is the first solve less the median.
GFLOP/s are those of the flops counted in floor.py, which leave out polishing: a row with it has none.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

from ba_node.core import linear, native_kernels
from ba_node.core import solver as loop
from ba_node.core.methods import METHODS
from experiments.benchmarks import problems
from experiments.benchmarks.floor import flops
from experiments.benchmarks.problem_file import Case, case_problem
from experiments.benchmarks.report import table

Seconds = dict[str, float]


class _Timed:
    """An object whose methods are timed."""

    def __init__(self, inner: Any, parts: Seconds) -> None:
        self._inner, self._parts = inner, parts

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._inner, name)
        if not callable(value):
            return value
        timed = _timed(name, value, self._parts)
        if name in ("reduce", "damp"):
            return lambda *args: _Timed(timed(*args), self._parts)
        return timed


def _timed(name: str, function: Callable[..., Any], parts: Seconds) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        began = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            parts[name] += time.perf_counter() - began

    return call


def solve_once(case: Case, loss: str, method: Mapping[str, Any]) -> tuple[Seconds, int]:
    """Return seconds by part, ``total`` among them, and the number of iterations."""
    parts: Seconds = defaultdict(float)
    options = dataclasses.replace(
        METHODS["auto"],
        loss=loss,
        loss_scale_px=1.0,
        cheirality="keep",
        max_iterations=100,
        function_tolerance=1e-8,
        **method,
    )
    make = native_kernels.make
    began = time.perf_counter()
    problem = _timed("set-up: case to problem", case_problem, parts)(case)
    build = _timed("set-up: kernels", make, parts)
    with ExitStack() as stack:
        for owner, name, replacement in (
            (native_kernels, "make", lambda *args: _Timed(build(*args), parts)),
            (linear, "pcg_steihaug", _timed("pcg", linear.pcg_steihaug, parts)),
        ):
            stack.enter_context(mock.patch.object(owner, name, replacement))
        result = loop.solve(problem, options)
    parts["total"] = time.perf_counter() - began
    if options.linear_solver == "pcg" or "pcg" in parts:
        parts.pop("product", None)
    parts["rest (Python)"] = 2.0 * parts["total"] - sum(parts.values())
    return dict(parts), len(result.trace) - 1


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks.breakdown", description=__doc__)
    parser.add_argument("problems", nargs="+", metavar="NAME", help="problems whose name contains NAME")
    parser.add_argument("--data", type=Path, default=problems.DATA)
    parser.add_argument("--work", type=Path, default=Path("out/bench"))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--backend", default="native")
    args = parser.parse_args()
    for problem in problems.chosen(args.problems, set()):
        prepared = problems.prepare(problem, args.data, args.work / "problems")
        if prepared is None:
            print(f"skipped: {problem.name}: no {problem.needs} in {args.data}")
            continue
        runs = [solve_once(prepared[1], problem.loss, {"kernels": args.backend}) for _ in range(args.repeats)]
        print(f"\n{problem.name}: {runs[0][1]} iterations\n\n{_table(runs, flops(prepared[1]))}")
    return 0


def _table(runs: list[tuple[Seconds, int]], counted: Mapping[str, float]) -> str:
    iterations = max(runs[0][1], 1)
    middle = {name: statistics.median(run[name] for run, _ in runs) for name in runs[0][0]}
    factor = counted["eliminate"] + counted["solve"]
    work = {"linearise": counted["linearise"], "solve_sparse": factor, "solve_dense": factor}
    rows = []
    for name, seconds in sorted(middle.items(), key=lambda item: -item[1]):
        first = 1e3 * (runs[0][0][name] - seconds)
        once = name.startswith("set-up")
        each = "" if once else f"{1e3 * seconds / iterations:.3f}"
        rate = f"{1e-9 * work[name] * iterations / seconds:.1f}" if math.isfinite(work.get(name, math.nan)) else ""
        share = f"{100 * seconds / middle['total']:.0f} %"
        rows.append([name, f"{1e3 * seconds:.2f}", each, share, rate, f"{first:.1f}"])
    return table(["part", "ms a solve", "ms/iter", "share", "GFLOP/s", "more in the first solve, ms"], rows)


if __name__ == "__main__":
    sys.exit(main())
