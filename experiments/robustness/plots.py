# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the rows of `ba robustness`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures import COLOURS, new_figure, png
from experiments.robustness.faults import FAULTS, RIGS, SOUND
from experiments.robustness.page import grouped, seeds
from experiments.robustness.runs import FAULT_TABLE, KINDS, OUTLIER_TABLE, Row

_BEFORE, _AFTER, _BEST = COLOURS[1], COLOURS[0], COLOURS[-1]
# Shown for an error of zero, m.
_FLOOR = 1e-4


def draw(folder: Path, rows: Sequence[Row]) -> list[Path]:
    """Write a PNG for each table that has rows; return the files."""
    written = []
    for name, plot in ((FAULT_TABLE, _faults), (OUTLIER_TABLE, _outliers)):
        some = [row for row in rows if row["table"] == name and row["published_m"] is not None]
        if some:
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"robustness_{name}.png"
            path.write_bytes(png(plot(some)))
            written.append(path)
    return written


def _faults(rows: Sequence[Row]) -> Any:
    """Draw a line a fault, from what came in to what was published, of its worst rig and amount."""
    names = [name for name in (SOUND, *FAULTS) if any(row["fault"] == name for row in rows)]
    figure = new_figure(9.0, 1.6 + 0.24 * len(names), dpi=100)
    axes = figure.subplots()
    for place, name in enumerate(names):
        worst = max(grouped(rows, name).values(), key=_growth)
        before, after = _median(worst, "input_m"), _median(worst, "published_m")
        axes.plot([before, after], [place, place], "-", color="#8C8C8C", lw=1.2, zorder=1)
        axes.plot(before, place, "o", color=_BEFORE, ms=7, mfc="none", mew=1.6, label="came in" if not place else None)
        axes.plot(after, place, "s", color=_AFTER, ms=5, label="published" if not place else None)
    abouts = ["sound" if name == SOUND else FAULTS[name].about for name in names]
    axes.set_yticks(range(len(names)), [about.split(", ")[0] for about in abouts])
    axes.invert_yaxis()
    axes.set_xscale("log")
    count = seeds(rows)
    several = f", median of {count} seeds" if count > 1 else ""
    axes.set_xlabel(f"translation RMSE [m], worst rig and amount{several}")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def _outliers(rows: Sequence[Row]) -> Any:
    kinds = [kind for kind in KINDS if any(row["fault"] == kind for row in rows)]
    figure = new_figure(11.0, 0.8 + 2.4 * len(kinds), dpi=100)
    grid = figure.subplots(len(kinds), len(RIGS), sharex=True, sharey="row", squeeze=False)
    styles = {
        "input_m": ("o:", _BEFORE, "came in"),
        "published_m": ("s-", _AFTER, "published"),
        "optimum_m": ("^--", _BEST, "without the outliers"),
    }
    for line, kind in zip(grid, kinds, strict=True):
        for axes, rig in zip(line, RIGS, strict=True):
            cells = {share: cell for (name, share), cell in grouped(rows, kind).items() if name == rig}
            for key, (style, colour, label) in styles.items():
                values = [[max(_FLOOR, row[key]) for row in cell] for cell in cells.values()]
                axes.plot(list(cells), [np.median(v) for v in values], style, color=colour, ms=5, lw=1.4, label=label)
                axes.fill_between(
                    list(cells), [min(v) for v in values], [max(v) for v in values], color=colour, alpha=0.12
                )
            axes.set_yscale("log")
            axes.grid(alpha=0.3)
            axes.set_title(f"{FAULTS[kind].about.removesuffix(', share')}, {rig}", fontsize=10)
    for axes in grid[-1]:
        axes.set_xlabel("share of outliers")
    for line in grid:
        line[0].set_ylabel("RMSE [m]")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def _growth(rows: Sequence[Row]) -> float:
    return _median(rows, "published_m") / _median(rows, "input_m")


def _median(rows: Sequence[Row], key: str) -> float:
    return max(_FLOOR, float(np.median([row[key] for row in rows])))
