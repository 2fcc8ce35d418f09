# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Plots of a comparison: performance profiles, and growth of time and memory with size.

``python -m experiments.benchmarks.plots SUMMARY.json DIR`` draws them again from what a run has recorded.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments.benchmarks import metrics
from experiments.figures import curve, new_figure, png

# By problem: figures of a summary, and figures by solver.
Problems = Sequence[Mapping[str, Any]]

_TITLES = {
    "tau 1e-02": "f_best + 0.01 (f_0 - f_best)",
    "tau 1e-04": "f_best + 0.0001 (f_0 - f_best)",
    "gap 1e-03": "within 0.1 % of f_best",
    "gap 1e-06": "within 0.0001 % of f_best",
}
_OURS = ("ba_node", "ba_node 2 threads")
# Solvers that are drawn in one plot, beside ours: those whose names begin so, and all others.
_GROUPS = (("ceres", "pycolmap"), ("rootba",), ("",))
_QUANTITIES: dict[str, Callable[[Mapping[str, float]], float]] = {
    "s to within 0.01 %": lambda row: row["gap 1e-04"],
    "MB above the start": lambda row: row["peak_mb"] - row["start_mb"],
}


def groups(solvers: Sequence[str]) -> list[list[str]]:
    """Return the solvers in groups that a plot can show, ours in each."""
    ours = [name for name in _OURS if name in solvers]
    left = [name for name in solvers if name not in _OURS]
    out = []
    for begins in _GROUPS:
        chosen = [name for name in left if name.startswith(begins)]
        left = [name for name in left if name not in chosen]
        if chosen:
            out.append(ours + chosen)
    return out or [ours]


def profiles(problems: Problems) -> Figure:
    """Draw, for each target, the share of problems solved within a factor of the fastest of all solvers."""
    medians = [problem["solvers"] for problem in problems]
    solvers = list(dict.fromkeys(name for row in medians for name in row))
    rows = groups(solvers)
    figure = new_figure(16.0, 3.6 * len(rows), dpi=110)
    axes = figure.subplots(len(rows), len(_TITLES), sharey=True, squeeze=False)
    for column, (key, title) in zip(axes.T, _TITLES.items(), strict=True):
        times = {name: [row.get(name, {}).get(key, math.nan) for row in medians] for name in solvers}
        found = metrics.profile(times)
        for axis, group in zip(column, rows, strict=True):
            for index, name in enumerate(group):
                ratios, share = found[name]
                if ratios:
                    steps = [1.0, *ratios, 1e3], [0.0, *share, share[-1]]
                    axis.step(*steps, where="post", label=name, **curve(index))
            axis.set(title=title, xscale="log", xlim=(1.0, 1e3), ylim=(0.0, 1.05), xlabel="factor over the fastest")
            axis.grid(visible=True, alpha=0.3)
    for line in axes:
        line[0].set_ylabel("share of problems")
        fullest = max(line, key=lambda axis: len(axis.lines))
        line[-1].legend(
            *fullest.get_legend_handles_labels(), loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=4.0
        )
    return figure


def fit_growth(problems: Problems, families: Sequence[str]) -> list[dict[str, Any]]:
    """Return, for each family, quantity and solver, sizes, values and the fitted ``c size^p``."""
    rows = []
    for family in sorted(set(families) - {""}):
        members = [problem for problem, name in zip(problems, families, strict=True) if name == family]
        for name in dict.fromkeys(name for member in members for name in member["solvers"]):
            for quantity, value in _QUANTITIES.items():
                sizes = [float(member["observations"]) for member in members]
                values = [value(m["solvers"][name]) if name in m["solvers"] else math.nan for m in members]
                known = [(s, v) for s, v in sorted(zip(sizes, values, strict=True)) if math.isfinite(v) and v > 0]
                factor, exponent = metrics.growth([s for s, _ in known], [v for _, v in known])
                if len(known) > 1:
                    rows.append(
                        {"family": family, "quantity": quantity, "solver": name, "points": known}
                        | {"factor": factor, "exponent": exponent}
                    )
    return rows


def growth(rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw time and memory over the number of observations, with the fitted exponents."""
    families = sorted({row["family"] for row in rows})
    parts = {
        name: groups(list(dict.fromkeys(row["solver"] for row in rows if row["family"] == name))) for name in families
    }
    lines = [(family, quantity) for family in families for quantity in _QUANTITIES]
    width = max((len(part) for part in parts.values()), default=1)
    figure = new_figure(8.0 * width, 3.2 * max(1, len(lines)), dpi=110)
    axes = figure.subplots(max(1, len(lines)), width, squeeze=False, sharey="row")
    for line, (family, quantity) in zip(axes, lines, strict=False):
        found = {row["solver"]: row for row in rows if (row["family"], row["quantity"]) == (family, quantity)}
        for axis, group in zip(line, parts[family], strict=False):
            for index, name in enumerate(group):
                if name in found:
                    x, y = zip(*found[name]["points"], strict=True)
                    axis.plot(x, y, label=f"{name}: N^{found[name]['exponent']:.2f}", **curve(index))
            axis.set(title=family, xscale="log", yscale="log", xlabel="observations N")
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.grid(visible=True, which="both", alpha=0.3)
            axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=4.0)
        for axis in line[len(parts[family]) :]:
            axis.set_visible(False)
        line[0].set_ylabel(quantity)
    return figure


def main() -> int:
    """Draw the plots of a summary."""
    source, out = Path(sys.argv[1]), Path(sys.argv[2])
    summary = json.loads(source.read_text(), parse_constant=float)
    out.mkdir(parents=True, exist_ok=True)
    (out / "bench_profiles.png").write_bytes(png(profiles(metrics.numbers(summary["problems"]))))
    (out / "bench_growth.png").write_bytes(png(growth(summary["growth"])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
