# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of a comparison, for the terminal and for Markdown alike."""

from __future__ import annotations

import math
from collections.abc import Sequence

from experiments.benchmarks import metrics
from experiments.benchmarks.suite import Comparison

_GAPS = {f"gap {gap:.0e}": f"{100.0 * gap:g} %" for gap in metrics.GAPS}
_TAUS = {f"tau {tau:.0e}": f"tau {tau:g}" for tau in metrics.TAUS}
OURS = "ba_node"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with aligned columns."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]

    def line(cells: Sequence[str]) -> str:
        padded = [cells[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(cells[1:], widths[1:], strict=True))]
        return f"| {' | '.join(padded)} |"

    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    return "\n".join([line(head), line(rule), *map(line, rows)])


def problem_section(comparison: Comparison) -> str:
    """Return title, table and remarks of one problem."""
    cameras, points, observations, size = comparison.counts
    head = [
        "solver",
        "final",
        "total s",
        "set-up s",
        "iter",
        "ms/iter",
        *_TAUS.values(),
        *_GAPS.values(),
        "MB",
        "of start",
    ]
    rows = []
    for name, row in comparison.medians().items():
        if math.isnan(row["final"]):
            continue
        cells = [name, f"{row['final']:.9g}", seconds(row["total_s"]), seconds(row["setup_s"])]
        cells += [f"{row['iterations']:.0f}", f"{1e3 * row['iteration_s']:.3g}"]
        cells += [seconds(row[key]) for key in (*_TAUS, *_GAPS)]
        rows.append([*cells, f"{row['peak_mb']:.0f}", f"{row['start_mb']:.0f}"])
    if math.isfinite(comparison.floor_s):
        rows.append(["floor", *[""] * 4, f"{1e3 * comparison.floor_s:.3g}", *[""] * (len(head) - 6)])
    title = (
        f"### {comparison.problem.name}\n\n{cameras} cameras, {points} points, {observations} observations,"
        f" {size} parameters a camera; objective {comparison.f_start:.9g} at the start,"
        f" {comparison.f_best:.9g} at best\n\n"
    )
    remarks = [f"- {text}" for text in _remarks(comparison)]
    return title + table(head, rows) + ("\n\n" + "\n".join(remarks) if remarks else "") + "\n"


def overview(comparisons: Sequence[Comparison]) -> str:
    """Return the table of ba_node against the fastest peer of each problem."""
    keys = ("tau 1e-01", "tau 1e-03", *_GAPS)
    head = ["problem", *(({**_TAUS, **_GAPS})[key] for key in keys)]
    rows = []
    for comparison in comparisons:
        medians = comparison.medians()
        if OURS not in medians:
            continue
        cells = [comparison.problem.name]
        for key in keys:
            peers = {n: row[key] for n, row in medians.items() if not n.startswith(OURS) and math.isfinite(row[key])}
            cells.append(_against(medians[OURS][key], peers))
        rows.append(cells)
    return table(head, rows)


def seconds(value: float) -> str:
    """Return a time with three digits; "-" for never, nothing where it took no part."""
    if math.isnan(value):
        return ""
    return f"{value:.3g}" if math.isfinite(value) else "-"


def _against(ours: float, peers: dict[str, float]) -> str:
    if not peers:
        return seconds(ours)
    name = min(peers, key=lambda peer: peers[peer])
    factor = f"{peers[name] / ours:.1f}x" if math.isfinite(ours) else "never"
    return f"{seconds(ours)} ({factor} {name} {seconds(peers[name])})"


def _remarks(comparison: Comparison) -> list[str]:
    out: list[str] = []
    for result in comparison.results:
        failed = {one.reason for one in result.runs if not one.trace}
        texts = [*([result.refused] if result.refused else []), *sorted(failed), *result.faults]
        out.extend(f"{result.solver}: {text}" for text in texts)
    return out
