# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Show a comparison on a page: who is how fast, who ends how low, and who needs how much memory.

``python -m experiments.benchmarks.page SUMMARY.json PAGE.html`` makes it again from what a run has recorded. Times to a
target close to the best and the objective at the end are two questions: a solver that stops early is quick to 1 % and
never gets further.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.offline.figures import COLOURS
from ba_node.offline.page import Figure, Page, html_table, write_page
from experiments.benchmarks import metrics

Problems = Sequence[Mapping[str, Any]]

# From here on two objectives at the end are the same.
SAME = 1e-8
# As in suite.py: below this share of the start's objective differences do not count.
_NOTHING = 1e-9
_TARGETS = {"gap 1e-02": "1 %", "gap 1e-03": "0.1 %", "gap 1e-06": "0.0001 %"}
RANKING = ("solver", "problems", "lowest on", "median above the best", "most above the best")
_DASHES = ("solid", "dash", "dot")


def ranking(problems: Problems) -> list[list[str]]:
    """Return the solvers by the objective at their end: on how many problems it is the lowest, and how far above it."""
    above: dict[str, list[float]] = {}
    for problem in problems:
        for name, row in problem["solvers"].items():
            if math.isfinite(row["final"]):
                above.setdefault(name, []).append(_above(problem, row))
    order = sorted(above, key=lambda name: (statistics.median(above[name]), max(above[name])))
    rows = []
    for name in order:
        found = above[name]
        lowest = sum(value <= SAME for value in found)
        middle = statistics.median(found)
        rows.append([name, str(len(found)), str(lowest), _share(middle), _share(max(found))])
    return rows


def _above(problem: Mapping[str, Any], row: Mapping[str, float]) -> float:
    """Return by which share of the best of all a solver ends above it; next to nothing at the start is nothing."""
    best = max(problem["f_best"], _NOTHING * problem["f_start"])
    return float(max(row["final"] / best - 1.0, 0.0))


def _share(value: float) -> str:
    return "same" if value <= SAME else f"{100.0 * value:.2g} %"


def figures(problems: Problems) -> list[Figure]:
    """Return the figures: performance profiles, times to 0.0001 %, objectives at the end, memory."""
    solvers = list(dict.fromkeys(name for problem in problems for name in problem["solvers"]))
    style = {
        name: {"color": COLOURS[n % len(COLOURS)], "dash": _DASHES[n // len(COLOURS) % len(_DASHES)]}
        for n, name in enumerate(solvers)
    }
    found = []
    for key, share in _TARGETS.items():
        times = {n: [p["solvers"].get(n, {}).get(key, math.nan) for p in problems] for n in solvers}
        drawn = [_steps(name, *rows, style[name]) for name, rows in metrics.profile(times).items() if rows[0]]
        caption = f"Share of the problems brought to within {share} of the best within a factor of the fastest's time."
        layout = {"xaxis": {"title": "factor over the fastest", "type": "log"}, "yaxis": {"range": [0, 1.05]}}
        found.append(Figure(f"profile_{key[-2:]}", f"To within {share}", caption, drawn, layout))
    for key, title, caption, unit in (
        ("gap 1e-06", "Time to within 0.0001 %", "Of the best objective; missing: never.", "s"),
        ("above", "Objective at the end", f"Above the best of all; {SAME:.0e} and less is the same.", "share"),
        ("peak_mb", "Memory", "Largest resident size of the process.", "MB"),
    ):
        data = [_points(name, key, problems, style[name]["color"]) for name in solvers]
        layout = {"yaxis": {"title": unit, "type": "log"}, "xaxis": {"automargin": True}}
        found.append(Figure(key.replace(" ", "_").replace("-", "_"), title, caption, data, layout, wide=True))
    return found


def _steps(name: str, ratios: list[float], share: list[float], style: Mapping[str, str]) -> dict[str, Any]:
    x, y = [1.0, *ratios, max(1e3, ratios[-1])], [0.0, *share, share[-1]]
    trace = {"type": "scatter", "mode": "lines", "x": np.array(x), "y": np.array(y), "name": name}
    return trace | {"line": dict(style) | {"shape": "hv"}}


def _points(name: str, key: str, problems: Problems, colour: str) -> dict[str, Any]:
    shown, values = [], []
    for problem in problems:
        row = problem["solvers"].get(name, {})
        value = row.get(key, math.nan)
        if key == "above" and row:
            value = max(_above(problem, row), SAME)
        if math.isfinite(value):
            shown.append(problem["problem"])
            values.append(value)
    return {"type": "scatter", "mode": "markers", "x": shown, "y": values, "name": name, "marker": {"color": colour}}


def write(path: Path, summary: Mapping[str, Any], problems: Problems) -> None:
    """Write the page of a comparison.

    Raises:
        PageError: plotly is not installed.
        OSError: the file cannot be written.
    """
    rows = [("best" if row[0].startswith("ba_node") else "", row) for row in ranking(problems)]
    head = f"<p>{summary['machine']}, medians of the runs.</p><h3>Objective at the end</h3>{html_table(RANKING, rows)}"
    write_page(path, Page("Solvers beside each other", figures(problems), head))


def main() -> int:
    """Make the page of a summary."""
    summary = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    write(Path(sys.argv[2]), summary, metrics.numbers(summary["problems"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
