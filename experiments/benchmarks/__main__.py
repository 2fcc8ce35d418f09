# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare ba_node with the solvers that are installed, on the same problems, and write tables, plots and a page."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import sys
from pathlib import Path
from typing import Any

from ba_node.offline.page import PageError
from experiments.benchmarks import page, plots, problems, solvers, suite
from experiments.benchmarks.floor import Peak, measure
from experiments.benchmarks.process import Limits
from experiments.benchmarks.report import overview, problem_section, table
from experiments.figures import png

_EPILOG = "Problems, solvers, rules and how to read the tables: docs/performance.md"


def main() -> int:
    """Run the command line."""
    args = _parse()
    try:
        chosen = problems.chosen(args.problems, _sets(args))
    except ValueError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    here, absent = solvers.find(args.work / "build", args.python)
    for line in absent:
        print(f"absent: {line}")
    here = [s for s in here if (s.quick or not args.quick) and (not args.solvers or s.name in args.solvers)]
    if not here:
        print(f"benchmarks: none of {', '.join(args.solvers)} is here", file=sys.stderr)
        return 2
    peak = measure()
    print(f"one core: {peak.gflops:.1f} GFLOP/s in a matrix product, {peak.gbytes_s:.1f} GB/s in a copy", flush=True)
    limits = Limits(iterations=args.iterations, tolerance=args.tolerance, seconds=args.seconds)
    comparisons = []
    for problem in chosen:
        prepared = problems.prepare(problem, args.data, args.work / "problems")
        if prepared is None:
            print(f"skipped: {problem.name}: no {problem.needs} in {args.data}")
            continue
        print(f"{problem.name} ...", flush=True)
        say = print if args.verbose else lambda _: None
        comparisons.append(suite.compare(problem, prepared, here, peak, args.repeats, limits, say))
        print("\n" + problem_section(comparisons[-1]), flush=True)
    if not comparisons:
        print("benchmarks: nothing was run; name the folder of the data sets by --data", file=sys.stderr)
        return 2
    _write(args.out, comparisons, absent, peak)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks", description=__doc__, epilog=_EPILOG)
    parser.add_argument("--quick", action="store_true", help="two windows, the main solvers, less than a minute")
    parser.add_argument("--large", action="store_true", help="the large loops too; takes long")
    parser.add_argument("--problems", nargs="+", default=[], metavar="NAME", help="those whose name contains NAME")
    parser.add_argument(
        "--solvers", nargs="+", default=[], metavar="NAME", help='those of exactly this name: "ceres dense"'
    )
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="runs a solver; medians are shown (3)")
    parser.add_argument("--iterations", type=int, default=100, metavar="N", help="cap on iterations (100)")
    parser.add_argument("--tolerance", type=float, default=1e-8, help="relative decrease at which solvers stop (1e-8)")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="a run is ended after so long (60; 1800 if --large)"
    )
    parser.add_argument("--data", type=Path, default=problems.DATA, help="folder of the data sets (%(default)s)")
    parser.add_argument("--python", default=sys.executable, help="interpreter with the wheels of the peers")
    parser.add_argument("--work", type=Path, default=Path("out/bench"), help="where problems and driver are kept")
    parser.add_argument("--out", type=Path, help="where results go (experiments/benchmarks/results/latest, or quick)")
    parser.add_argument("--verbose", action="store_true", help="a line for each run")
    args = parser.parse_args()
    args.seconds = max(args.seconds, 1800.0) if args.large else args.seconds
    args.out = args.out or solvers.FOLDER / "results" / ("quick" if args.quick else "latest")
    return args


def _sets(args: argparse.Namespace) -> set[str]:
    if args.quick:
        return {"quick"}
    return {"default", "large"} if args.large else {"default"}


def _machine() -> str:
    """Return processor model and number of cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    return f"{model or platform.machine()}, {os.cpu_count()} cores"


def _write(out: Path, comparisons: list[suite.Comparison], absent: list[str], peak: Peak) -> None:
    out.mkdir(parents=True, exist_ok=True)
    common: dict[str, Any] = {"machine": _machine(), "peak": peak.__dict__, "absent": absent}
    (out / "runs.json").write_text(json.dumps({**common, "problems": [c.as_dict() for c in comparisons]}))
    short = [{k: v for k, v in c.as_dict().items() if k != "solvers"} | {"solvers": c.medians()} for c in comparisons]
    growth = plots.fit_growth(short, [c.problem.family for c in comparisons])
    versions = {r.solver: one.version for c in comparisons for r in c.results for one in r.runs if one.trace}
    summary = {**common, "versions": versions, "problems": short, "growth": growth}
    (out / "summary.json").write_text(json.dumps(_finite(summary), indent=1) + "\n")
    text = overview(comparisons)
    sections = "\n".join(problem_section(comparison) for comparison in comparisons)
    ranked = table(page.RANKING, page.ranking(short))
    (out / "report.md").write_text(
        f"## Against the fastest peer\n\n{text}\n\n## Objective at the end\n\n{ranked}\n\n## Problems\n\n{sections}"
    )
    (out / "profiles.png").write_bytes(png(plots.profiles(short)))
    if growth:
        (out / "growth.png").write_bytes(png(plots.growth(growth)))
    try:
        page.write(out / "index.html", common, short)
    except PageError as error:
        print(error)
    print(f"{text}\n\n{ranked}\n\nwritten to {os.path.relpath(out)}")


def _finite(value: Any) -> Any:
    """Return the value with ten digits, "never" for inf and null for NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        if math.isnan(value):
            return None
        return float(f"{value:.10g}") if math.isfinite(value) else "never"
    return value


if __name__ == "__main__":
    sys.exit(main())
