# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write the result of a search or of a sweep: tables, JSON, CSV, and a page."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.config import Config, Value
from ba_node.io.files import whole_file, write_json
from ba_node.io.parameters import changes_yaml
from ba_node.offline.figures import COLOURS, Figure, array, line
from ba_node.offline.fleet import name_of
from ba_node.offline.measure import Measured
from ba_node.offline.page import write_page
from ba_node.offline.report import html_table
from ba_node.offline.study import Trial
from ba_node.offline.tuning import Tuned

_GREY, _ORANGE = "#9AA0A6", "#D55E00"
_TUNED = "tuned.yaml"
# Parameters that are drawn one by one, and a row of them.
_DRAWN, _ACROSS = 12, 3


def write_parameters(out: Path, base: Config, values: Mapping[str, Value]) -> Path:
    """Write the parameters that differ from their defaults to tuned.yaml; return its path."""
    with whole_file(out / _TUNED) as stream:
        stream.write(changes_yaml(base.with_values(values)).encode())
    return out / _TUNED


def error_rows(tuned: Tuned) -> list[list[str]]:
    """Return the errors and times of each recording before and after, as text."""
    rows = []
    for name, before in tuned.start.items():
        after, kept = tuned.after[name], tuned.plan.validation is not None and name == tuned.plan.validation[0]
        rows.append(
            [
                name_of(name) + (" (validation)" if kept else ""),
                f"{before.error:.4g} {before.unit}",
                f"{after.error:.4g} {after.unit}",
                f"{100.0 * (after.error / max(before.error, 1e-12) - 1.0):+.1f} %",
                f"{before.latency_ms:.1f} ms",
                f"{after.latency_ms:.1f} ms",
            ]
        )
    return rows


ERRORS = ("recording", "error at the start", "tuned", "change", "solve p95 at the start", "tuned")
PARAMETERS = ("parameter", "start", "tuned", "importance")


def parameter_rows(tuned: Tuned, base: Config) -> list[list[str]]:
    """Return each parameter's value before and after, and how much it decides, most important first."""
    values = base.values()
    names = sorted(tuned.best.values, key=lambda name: -tuned.importance.get(name, 0.0))
    return [
        [
            name,
            _shown(values[name]),
            _shown(tuned.best.values[name]),
            f"{100.0 * tuned.importance.get(name, 0.0):.0f} %",
        ]
        for name in names
    ]


def tuned_as_dict(tuned: Tuned) -> dict[str, Any]:
    """Return the content of tuning.json."""
    return {
        "goal": tuned.plan.goal,
        "improved": tuned.improved,
        "overfitted": tuned.overfitted,
        "recordings": {name: _both(tuned, name) for name in tuned.start},
        "validation": tuned.plan.validation[0] if tuned.plan.validation else None,
        "parameters": tuned.changes,
        "importance": tuned.importance,
        "trials": [dataclasses.asdict(trial) for trial in tuned.trials],
        "trials_refused": tuned.failed,
    }


def write_tuned(out: Path, tuned: Tuned, base: Config) -> None:
    """Write tuning.json and index.html.

    Raises:
        PageError: plotly is not installed; tuning.json is there.
        OSError: a file cannot be written.
    """
    write_json(out / "tuning.json", tuned_as_dict(tuned))
    verdict, kind = "Better parameters were found", "good"
    if not tuned.improved:
        verdict, kind = "Nothing better was found: the parameters of the start stand", "look"
    elif tuned.overfitted:
        verdict, kind = "Over-fitted: on the recording kept for validation the error is larger", "bad"
    head = f"<div class='verdict {kind}'><b>{verdict}</b> in {len(tuned.trials)} trials.</div>"
    head += html_table(ERRORS, [("", row) for row in error_rows(tuned)])
    head += "<p></p>" + html_table(PARAMETERS, [("", row) for row in parameter_rows(tuned, base)])
    figures = [_history(tuned), _importance(tuned), _trade(tuned), _slices(tuned)]
    text = escape(changes_yaml(base.with_values(tuned.changes)))
    tail = f"<h2>{_TUNED}</h2><pre>{text}</pre>"
    write_page(out / "index.html", "Tuning", [one for one in figures if one.data], head, tail)


def _both(tuned: Tuned, name: str) -> dict[str, Any]:
    return {"start": dataclasses.asdict(tuned.start[name]), "tuned": dataclasses.asdict(tuned.after[name])}


def _shown(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _points(x: Any, y: Any, name: str, colour: str, **more: Any) -> dict[str, Any]:
    return line(x, y, name, colour, mode="markers", marker={"color": colour, "size": 6}, **more)


def _groups(trials: Sequence[Trial]) -> list[tuple[str, str, list[Trial]]]:
    """Return the trials within the limits and the others, in their colours."""
    good, bad = [one for one in trials if one.feasible], [one for one in trials if not one.feasible]
    return [(n, c, of) for n, c, of in (("trials", COLOURS[0], good), ("beyond a limit", _GREY, bad)) if of]


def _history(tuned: Tuned) -> Figure:
    data = [_points([t.number for t in of], [t.score for t in of], name, c) for name, c, of in _groups(tuned.trials)]
    good = [t for t in tuned.trials if t.feasible]
    if good:
        best = np.minimum.accumulate([t.score for t in good])
        data.append(line([t.number for t in good], best, "best", _ORANGE, mode="lines") | {"line": {"shape": "hv"}})
    layout = {"xaxis": {"title": "trial"}, "yaxis": {"title": "error beside the start's", "type": "log"}}
    return Figure("history", "Trials", "1 is as good as the start; less is better.", data, layout, wide=True)


def _importance(tuned: Tuned) -> Figure:
    names = list(reversed(tuned.importance))
    bar = {"type": "bar", "orientation": "h", "y": names, "x": array([tuned.importance[name] for name in names])}
    data = [bar | {"marker": {"color": COLOURS[0]}}] if names else []
    layout = {"xaxis": {"title": "share"}, "yaxis": {"automargin": True}}
    return Figure("importance", "What decides", "Importance of each parameter by PED-ANOVA.", data, layout)


def _trade(tuned: Tuned) -> Figure:
    data = [_points([t.latency_ms for t in of], [t.score for t in of], n, c) for n, c, of in _groups(tuned.trials)]
    data.append(_points([tuned.best.latency_ms], [tuned.best.score], "tuned", _ORANGE))
    layout = {
        "xaxis": {"title": "time of a solve, p95 [ms]", "type": "log"},
        "yaxis": {"title": "error beside the start's", "type": "log"},
    }
    return Figure("trade", "Error against latency", "Each point is a trial.", data, layout)


def _slices(tuned: Tuned) -> Figure:
    """Draw the score against each parameter, a picture each."""
    names = sorted(tuned.best.values, key=lambda name: -tuned.importance.get(name, 0.0))[:_DRAWN]
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {"showlegend": False}
    down = -(-len(names) // _ACROSS)
    for place, name in enumerate(names):
        axis = str(place + 1) if place else ""
        column, row = place % _ACROSS, place // _ACROSS
        values = [one.values[name] for one in tuned.trials]
        numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
        for number, (colour, of) in enumerate(((COLOURS[0], tuned.trials), (_ORANGE, [tuned.best]))):
            drawn = _points([], [one.score for one in of], name, colour, xaxis=f"x{axis}", yaxis=f"y{axis}")
            shown = [one.values[name] for one in of]
            drawn["x"] = array(shown) if numbers else [str(value) for value in shown]
            data.append(drawn | {"marker": {"color": colour, "size": 5 + 3 * number}})
        layout[f"xaxis{axis}"] = {
            "title": name,
            "domain": [column / _ACROSS + 0.02, (column + 1) / _ACROSS - 0.03],
            "anchor": f"y{axis}",
            "type": "log" if numbers and min(float(v) for v in values) > 0 else "-",
        }
        layout[f"yaxis{axis}"] = {
            "domain": [1.0 - (row + 0.62) / down, 1.0 - row / down],
            "anchor": f"x{axis}",
            "type": "log",
        }
    caption = "Error beside the start's; the best trial is orange."
    return Figure("slices", "Each parameter by itself", caption, data, layout, wide=True)


def sweep_rows(found: Sequence[tuple[dict[str, Value], dict[str, Measured]]]) -> tuple[list[str], list[list[str]]]:
    """Return heading and rows of a sweep's table, as text."""
    values, measured = found[0]
    head = [*values, *(f"{name_of(name)} [{one.unit}]" for name, one in measured.items()), "solve p95 [ms]"]
    rows = [
        [
            *map(_shown, combination.values()),
            *(f"{one.error:.4g}" for one in of.values()),
            f"{max(one.latency_ms for one in of.values()):.1f}",
        ]
        for combination, of in found
    ]
    return head, rows


def sweep_as_dict(found: Sequence[tuple[dict[str, Value], dict[str, Measured]]]) -> dict[str, Any]:
    """Return the content of sweep.json."""
    return {
        "combinations": [
            {"parameters": values, "recordings": {name: dataclasses.asdict(one) for name, one in of.items()}}
            for values, of in found
        ]
    }


def write_sweep(out: Path, found: Sequence[tuple[dict[str, Value], dict[str, Measured]]]) -> None:
    """Write sweep.csv, sweep.json and index.html.

    Raises:
        PageError: plotly is not installed; the other files are there.
        OSError: a file cannot be written.
    """
    head, rows = sweep_rows(found)
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    with whole_file(out / "sweep.csv") as stream:
        stream.write(text.getvalue().encode())
    write_json(out / "sweep.json", sweep_as_dict(found))
    errors = np.array([[one.error for one in of.values()] for _, of in found])
    best = int(np.argmin(np.mean(np.log(np.maximum(errors, 1e-12)), axis=1)))
    names = [", ".join(f"{name}={_shown(value)}" for name, value in values.items()) for values, _ in found]
    data = [
        {"type": "scatter", "mode": "lines+markers", "x": names, "y": array(errors[:, column]), "name": name_of(name)}
        | {"marker": {"color": COLOURS[column % len(COLOURS)]}}
        for column, name in enumerate(found[0][1])
    ]
    layout = {"yaxis": {"title": "error", "type": "log"}, "xaxis": {"automargin": True}}
    figure = Figure("errors", "Errors", "Of each combination, on each recording.", data, layout, wide=True)
    shown = html_table(head, [("best" if n == best else "", row) for n, row in enumerate(rows)])
    write_page(out / "index.html", "Sweep", [figure], shown)
