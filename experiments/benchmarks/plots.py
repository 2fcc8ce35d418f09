# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Plots of a comparison: performance profiles, and growth of time and memory with size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt

from experiments.benchmarks import metrics
from experiments.benchmarks.suite import Comparison

_TITLES = {
    **{f"tau {tau:.0e}": f"f_best + {tau:g} (f_0 - f_best)" for tau in metrics.TAUS},
    **{f"gap {gap:.0e}": f"within {100.0 * gap:g} % of f_best" for gap in metrics.GAPS},
}


def draw_profiles(comparisons: Sequence[Comparison], path: Path) -> None:
    """Draw, for each target, the share of problems solved within a factor of the fastest."""
    medians = [comparison.medians() for comparison in comparisons]
    solvers = list(dict.fromkeys(name for row in medians for name in row))
    figure, axes = plt.subplots(2, 4, figsize=(16, 7), sharey=True, layout="constrained")
    for axis, (key, title) in zip(axes.flat, _TITLES.items(), strict=True):
        times = {name: [row.get(name, {}).get(key, math.nan) for row in medians] for name in solvers}
        for name, (ratios, share) in metrics.profile(times).items():
            if ratios:
                steps = [1.0, *ratios, 1e3], [0.0, *share, share[-1]]
                axis.step(*steps, where="post", label=name, **_style(solvers.index(name)))
        axis.set(title=title, xscale="log", xlim=(1.0, 1e3), ylim=(0.0, 1.05), xlabel="factor over the fastest")
        axis.grid(visible=True, alpha=0.3)
    axes[0, 0].set_ylabel("share of problems")
    axes[1, 0].set_ylabel("share of problems")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize="small")
    _save(figure, path)


def fit_growth(comparisons: Sequence[Comparison]) -> list[dict[str, Any]]:
    """Return, for each family, quantity and solver, sizes, values and the fitted ``c size^p``."""
    rows = []
    for family in sorted({c.problem.family for c in comparisons if c.problem.family}):
        members = [c for c in comparisons if c.problem.family == family]
        medians = [comparison.medians() for comparison in members]
        for name in dict.fromkeys(name for row in medians for name in row):
            for quantity, value in _QUANTITIES.items():
                sizes = [float(c.counts[2]) for c in members]
                values = [value(row[name]) if name in row else math.nan for row in medians]
                known = [(s, v) for s, v in sorted(zip(sizes, values, strict=True)) if math.isfinite(v) and v > 0]
                factor, exponent = metrics.growth([s for s, _ in known], [v for _, v in known])
                if len(known) > 1:
                    rows.append(
                        {"family": family, "quantity": quantity, "solver": name, "points": known}
                        | {"factor": factor, "exponent": exponent}
                    )
    return rows


_QUANTITIES: dict[str, Callable[[dict[str, float]], float]] = {
    "s to within 0.01 %": lambda row: row["gap 1e-04"],
    "MB above the start": lambda row: row["peak_mb"] - row["start_mb"],
}


def draw_growth(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw time and memory over the number of observations, with the fitted exponents."""
    families = sorted({row["family"] for row in rows})
    if not families:
        return
    figure, axes = plt.subplots(
        len(families), len(_QUANTITIES), figsize=(17, 5 * len(families)), squeeze=False, layout="constrained"
    )
    solvers = list(dict.fromkeys(row["solver"] for row in rows))
    for line, family in zip(axes, families, strict=True):
        for axis, quantity in zip(line, _QUANTITIES, strict=True):
            for row in rows:
                if (row["family"], row["quantity"]) == (family, quantity):
                    x, y = zip(*row["points"], strict=True)
                    style = _style(solvers.index(row["solver"]))
                    axis.plot(x, y, marker="o", label=f"{row['solver']}: N^{row['exponent']:.2f}", **style)
            axis.set(title=family, xscale="log", yscale="log", xlabel="observations N", ylabel=quantity)
            axis.grid(visible=True, which="both", alpha=0.3)
            axis.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    _save(figure, path)


def _style(solver: int) -> dict[str, str]:
    """Return colour and dashes by which the n-th solver is known from the others."""
    return {"color": f"C{solver % 10}", "linestyle": ("-", "--", ":")[solver // 10 % 3]}


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
