# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replay or check many recordings: each by itself, so that a bad one fails alone; one table and page of all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.config import Config
from ba_node.io.bag_files import same_recording
from ba_node.io.bag_topics import TopicChoice
from ba_node.io.parameters import parameters_yaml
from ba_node.offline.check import check_recording
from ba_node.offline.figures import BEFORE, COLOURS
from ba_node.offline.fleet import Fleet, delivered, expand, fetched, is_url, name_of, words_of
from ba_node.offline.page import Figure, Page, html_table, write_results
from ba_node.offline.replay import MapOptions, Watch, replay
from ba_node.offline.report import REPORT, show

# Columns of the table of all recordings: name in results.json and .csv, heading.
COLUMNS = {
    "recording": "recording",
    "state": "state",
    "keyframes": "keyframes",
    "refined": "refined",
    "error_before_m": "error before [m]",
    "error_after_m": "after [m]",
    "median_before_px": "median before [px]",
    "median_after_px": "after [px]",
    "held": "held",
    "solve_p95_ms": "solve p95 [ms]",
    "time_s": "time [s]",
    "note": "note",
}
OK, LOOK, FAILED = "ok", "look", "failed"


@dataclass(frozen=True)
class ReplayTask:
    """One recording of many."""

    recording: tuple[str, ...]  # a path or URL, or the files of one recording
    out: str  # folder or URL for its results
    config: Config
    topics: TopicChoice
    report: bool = True  # write page and picture too
    resume: bool = False  # leave it alone if its results are there, with the same parameters
    clock: Callable[[], float] = lambda: 0.0  # s


def recordings(places: Sequence[str], *, each: bool = False) -> list[tuple[str, ...]]:
    """Return which recordings are meant: files that are called as parts of one are one, unless ``each`` is by itself.

    Raises:
        FleetError: a URL with a wildcard matches nothing.
    """
    found: list[list[str]] = []
    for place in expand(places):
        lone = each or is_url(place) or Path(place).is_dir()
        files = (one for one in found if not (is_url(one[0]) or Path(one[0]).is_dir()))
        group = None if lone else next((one for one in files if same_recording(Path(one[0]), Path(place))), None)
        if group is None:
            found.append([place])
        else:
            group.append(place)
    return [tuple(group) for group in found]


def each(
    fleet: Fleet,
    function: Callable[[ReplayTask], dict[str, Any]],
    tasks: Sequence[ReplayTask],
    progress: Callable[[int, int], None],
) -> list[dict[str, Any]]:
    """Call :func:`replay_one` or :func:`check_one` with every recording; return their rows in order."""
    rows: list[dict[str, Any]] = [{}] * len(tasks)
    for done, (number, row) in enumerate(fleet.each(function, tasks, _failed), start=1):
        rows[number] = row
        progress(done, len(tasks))
    return rows


def folder_names(found: Sequence[tuple[str, ...]]) -> list[str]:
    """Return a folder name for each recording, with a number where a name comes again."""
    names: list[str] = []
    for group in found:
        name, again = name_of(group[0]), 2
        while name in names:
            name, again = f"{name_of(group[0])}_{again}", again + 1
        names.append(name)
    return names


def replay_one(task: ReplayTask) -> dict[str, Any]:
    """Replay a recording and return its row; whatever is wrong with it stands there."""
    begun = task.clock()
    try:
        report = (_known(task) if task.resume else None) or _replayed(task)
    except (ValueError, OSError) as error:
        return _failed(task, words_of(error))
    return _row(task, report) | {"time_s": task.clock() - begun}


def _replayed(task: ReplayTask) -> dict[str, Any]:
    with fetched(task.recording[0]) as first, delivered(task.out) as out:
        bag = [first, *map(Path, task.recording[1:])]
        report = replay(bag, out, task.config, Watch(task.clock), MapOptions(topics=task.topics))
        if task.report:
            show(out)
    return report


def _known(task: ReplayTask) -> dict[str, Any] | None:
    """Return the report of an earlier replay of the recording with these parameters, None if there is none."""
    if is_url(task.out):
        return None
    try:
        if (Path(task.out) / "effective.yaml").read_text() != parameters_yaml(task.config, comments=False):
            return None
        report: dict[str, Any] = json.loads((Path(task.out) / "report.json").read_text())
    except (OSError, ValueError):
        return None
    return report if report["bag"] == Path(task.recording[0]).name else None


def _row(task: ReplayTask, report: Mapping[str, Any]) -> dict[str, Any]:
    error = report.get("trajectory_error_m") or {"input": None, "refined": None}
    return {
        "recording": task.recording[0],
        "folder": task.out,
        "state": LOOK if report["attention"] else OK,
        "keyframes": report["keyframes"],
        "refined": report["keyframes_refined"],
        "error_before_m": error["input"],
        "error_after_m": error["refined"],
        "median_before_px": report["median_px"]["input"],
        "median_after_px": report["median_px"]["refined"],
        "held": sum(report["solves_by_status"].get(name, 0) for name in ("HELD", "FAILED")),
        "solve_p95_ms": 1e3 * float(np.percentile(report["solve_times_s"] or [0.0], 95)),
        "note": "; ".join(report["attention"]),
    }


def _failed(task: ReplayTask, words: str) -> dict[str, Any]:
    return {"recording": task.recording[0], "folder": task.out, "state": FAILED, "note": words}


def check_one(task: ReplayTask) -> dict[str, Any]:
    """Check a recording and return its sessions, or why it cannot be checked."""
    try:
        with fetched(task.recording[0]) as first:
            checked = check_recording(first, task.config)
    except (ValueError, OSError) as error:
        return _failed(task, words_of(error))
    causes = [cause for one in checked.sessions for finding in one.found.findings for cause in finding.causes]
    notes = [*dict.fromkeys(causes), *checked.all_warnings]
    return {
        "recording": task.recording[0],
        "state": LOOK if notes else OK,
        "note": "; ".join(notes) or "the set-up fits the tracks",
        **checked.as_dict(),
    }


def cells(row: Mapping[str, Any]) -> list[str]:
    """Return a row of the table as text."""
    values = (row.get(name) for name in COLUMNS)
    return ["" if v is None else f"{v:.4g}" if isinstance(v, float) else str(v) for v in values]


def write_summary(out: Path, rows: Sequence[Mapping[str, Any]]) -> str:
    """Write results.json, results.csv and index.html; return their names, or why there is no page.

    Raises:
        OSError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    columns = [*COLUMNS, "folder"]
    listed: list[list[object]] = [list(columns), *([row.get(name) for name in columns] for row in rows)]
    states = {state: sum(row["state"] == state for row in rows) for state in (OK, LOOK, FAILED)}
    names = [name_of(str(row["recording"])) for row in rows]
    kind = "bad" if states[FAILED] else "look" if states[LOOK] else "good"
    verdict = f"{len(rows)} recordings: {states[OK]} sound, {states[LOOK]} to look at, {states[FAILED]} failed"
    marks = {OK: "", LOOK: "changed", FAILED: "changed"}
    shown = html_table(list(COLUMNS.values()), [(marks[row["state"]], cells(row)) for row in rows])
    links = "".join(
        f'<li><a href="{name}/{REPORT}">{name}</a></li>'
        for name in (Path(str(row.get("folder", ""))).name for row in rows if row["state"] != FAILED)
        if (out / name / REPORT).is_file()
    )
    figures = [
        _bars("error", "Error to the reference", names, rows, "error_before_m", "error_after_m", "m"),
        _bars("median", "Median residual", names, rows, "median_before_px", "median_after_px", "px"),
    ]
    head = f"<div class='verdict {kind}'><b>{verdict}</b></div>{shown}<ul>{links}</ul>"
    return write_results(out, "results", {"recordings": rows}, listed, Page("Replays", figures, head))


def _bars(
    key: str, title: str, names: Sequence[str], rows: Sequence[Mapping[str, Any]], before: str, after: str, unit: str
) -> Figure:
    data = []
    for name, column, colour in (("before", before, BEFORE), ("after", after, COLOURS[0])):
        values = [row.get(column) for row in rows]
        if any(value is not None for value in values):
            bar = {"type": "bar", "x": list(names), "y": values}
            data.append(bar | {"name": name, "marker": {"color": colour}})
    layout = {"yaxis": {"title": f"[{unit}]", "type": "log"}, "barmode": "group", "xaxis": {}}
    return Figure(key, title, "Before and after adjustment, of each recording.", data, layout, wide=True)
