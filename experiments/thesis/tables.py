# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of an experiment: our metrics and those of the thesis side by side."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.thesis.experiments import Case, Experiment
from experiments.thesis.metrics import METRICS, shown

# Of one case; ``spread`` among them holds the least and the largest over its starts by name.
Metrics = Mapping[str, Any]


@dataclass(frozen=True)
class Table:
    """Text in rows and columns."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Return it for Markdown."""
        lines = [self.head, ("---",) * len(self.head), *self.rows]
        return "".join(f"| {' | '.join(map(escaped, line))} |\n" for line in lines)

    def html(self) -> str:
        """Return it for HTML."""

        def line(cells: Sequence[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

        rows = "\n".join(line(row, "td") for row in self.rows)
        return f"<table>\n{line(self.head, 'th')}\n{rows}\n</table>\n"


def escaped(text: str) -> str:
    """Return text without what Markdown takes for the border of a cell."""
    return text.replace("|", "&#124;")


def table(experiment: Experiment, metrics: Mapping[str, Metrics]) -> Table:
    """Return the table of an experiment.

    Args:
        experiment: which columns it has.
        metrics: of each case, by label. Cases without any of the columns make no row.
    """
    cases = [c for c in experiment.cases if any(name in metrics.get(c.label, {}) for name in experiment.columns)]
    head, columns = [""], []
    for name in experiment.columns:
        metric = METRICS[name]
        head.append(metric.title + (" (ratio)" if metric.is_time and len(cases) > 1 else ""))
        columns.append([_cell(name, case, experiment, metrics) for case in cases])
        if any(name in case.thesis for case in cases):
            head.append("thesis")
            thesis = {case.label: case.thesis for case in experiment.cases}
            columns.append([_cell(name, case, experiment, thesis) for case in cases])
    if any(case.note for case in cases):
        head.append("note")
        columns.append([case.note for case in cases])
    rows = [(case.label, *(column[i] for column in columns)) for i, case in enumerate(cases)]
    return Table(tuple(head), tuple(rows))


def _cell(name: str, case: Case, experiment: Experiment, metrics: Mapping[str, Metrics]) -> str:
    """Return a metric, a time with its ratio to the case it is compared with."""
    value = metrics.get(case.label, {}).get(name)
    if name not in metrics.get(case.label, {}):
        return ""
    text = shown(name, value)
    spread = metrics.get(case.label, {}).get("spread")
    low_high = spread.get(name) if isinstance(spread, Mapping) else None
    if low_high is not None:
        text = f"{text} [{shown(name, low_high[0])}, {shown(name, low_high[1])}]"
    if not METRICS[name].is_time or not isinstance(value, float) or len(experiment.cases) == 1:
        return text
    for label in (case.versus, ""):
        base = metrics.get(experiment.case(label).label, {}).get(name)
        if isinstance(base, float) and base > 0.0:
            ratio = value / base
            return f"{text} ({ratio:.0f})" if ratio >= 100.0 else f"{text} ({ratio:.2g})"
    return text
