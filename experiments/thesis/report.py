# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put tables, pictures and verdicts on pages: one HTML file that holds all, Markdown with pictures beside it."""

from __future__ import annotations

import base64
import html
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ba_node.io.files import whole_file
from experiments.figures import png
from experiments.thesis.experiments import Experiment
from experiments.thesis.metrics import in_time, metrics_of, over_seeds
from experiments.thesis.page import grounds, verdict_table
from experiments.thesis.plots import PLOTS
from experiments.thesis.tables import Table, table
from experiments.thesis.verdicts import Verdict

Record = Mapping[str, Any]

INTRO = (
    "The experiments of Z. Qu, Efficient Optimization for Robust Bundle Adjustment, master's thesis, TU Munich, 2018,"
    " repeated. Times are processor time of one thread; the thesis's are Matlab's on another machine, so only ratios"
    " compare: they stand in parentheses. Steps are those taken, as the thesis counts; a rejected one is tried again."
)
_STYLE = (
    "body{font-family:sans-serif;max-width:75em;margin:auto;padding:1em}"
    "table{border-collapse:collapse;margin:1em 0;display:block;overflow-x:auto;font-size:.85em}"
    "td,th{border:1px solid #bbb;padding:.2em .6em;text-align:right;vertical-align:top}"
    "td:first-child,th:first-child,td:last-child,.claims td,.claims th{text-align:left}"
    "th{background:#eee}img{max-width:100%}"
    "summary{cursor:pointer;font-weight:bold;margin:1em 0}"
)


@dataclass(frozen=True)
class Section:
    """An experiment that has been run."""

    experiment: Experiment  # what it is
    runs: Mapping[str, Sequence[Record]]  # of its cases, by label: one for each start

    @property
    def records(self) -> dict[str, Record]:
        """Return the record of the first start of each case."""
        return {label: runs[0] for label, runs in self.runs.items()}

    @property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """Return the metrics of each case: medians over its starts, and their spread."""
        found = {label: [metrics_of(run) for run in runs] for label, runs in self.runs.items()}
        clock = self.experiment.clock
        if clock and clock in found:
            seconds = statistics.median(float(row["seconds"] or 0.0) for row in found[clock])
            for label, runs in self.runs.items():
                for run, row in zip(runs, found[label], strict=True):
                    row.update(in_time(run, seconds) if run.get("trace") else {})
        return {label: over_seeds(rows) for label, rows in found.items()}

    def table(self) -> Table:
        """Return its table."""
        return table(self.experiment, self.metrics)

    def pictures(self) -> dict[str, bytes]:
        """Return its pictures as PNG, by name."""
        return {name: png(PLOTS[name](self.experiment, self.records)) for name in self.experiment.plots}


def write_report(folder: Path, sections: Sequence[Section], verdicts: Sequence[Verdict]) -> Path:
    """Write report.html and report.md with its images; return the former.

    Args:
        folder: exists.
        sections: what has been run.
        verdicts: on the thesis's claims and on our findings; none to leave them out.
    """
    title = "The thesis's experiments"
    page = [f"<!doctype html><meta charset='utf-8'><title>{title}</title><style>{_STYLE}</style><h1>{title}</h1>"]
    text = [f"# {title}\n", f"{INTRO}\n"]
    page.append(f"<p>{html.escape(INTRO)}</p>\n{_contents(sections)}")
    if verdicts:
        shown = verdict_table(verdicts)
        page.append(f"<h2>Claims and findings</h2>\n<div class='claims'>{shown.html()}</div>\n{_grounds(verdicts)}")
        text += ["## Claims and findings\n", shown.markdown(), grounds(verdicts)]
    images = folder / "images"
    images.mkdir(exist_ok=True)
    for section in sections:
        experiment, rows = section.experiment, section.table()
        page.append(f"<h2 id='{experiment.name}'>{html.escape(experiment.heading)}</h2>\n{rows.html()}")
        text += [f"## {experiment.heading}\n", rows.markdown()]
        if experiment.note:
            page.append(f"<p>{html.escape(experiment.note)}</p>")
            text.append(f"{experiment.note}\n")
        for name, picture in section.pictures().items():
            file = images / f"{experiment.name}-{name}.png"
            _write(file, picture)
            encoded = base64.b64encode(picture).decode()
            page.append(f"<img alt='{experiment.name} {name}' src='data:image/png;base64,{encoded}'>")
            text.append(f"![{name}](images/{file.name})\n")
    _write(folder / "report.md", "\n".join(text).encode())
    _write(folder / "report.html", "\n".join(page).encode())
    return folder / "report.html"


def _contents(sections: Sequence[Section]) -> str:
    """Return links to all experiments."""
    found = [section.experiment for section in sections]
    links = "".join(f"<li><a href='#{one.name}'>{html.escape(one.heading)}</a></li>" for one in found)
    return f"<details><summary>Contents</summary><ul>{links}</ul></details>"


def _grounds(verdicts: Sequence[Verdict]) -> str:
    """Return what the verdicts rest on, to be unfolded."""
    parts = []
    for number, verdict in enumerate(verdicts, start=1):
        lines = "".join(
            f"<li>{'yes' if one.good else '<b>no</b>'}: {html.escape(one.words)}</li>" for one in verdict.found
        )
        head = html.escape(f"{number}. {verdict.claim.text}: {verdict.said}")
        parts.append(f"<p><b>{head}</b></p><ul>{lines}</ul><p>{html.escape(verdict.claim.remark)}</p>")
    return f"<details><summary>What the verdicts rest on</summary>{''.join(parts)}</details>\n"


def _write(path: Path, content: bytes) -> None:
    with whole_file(path) as stream:
        stream.write(content)
