# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write the result of a search or of a sweep: tables, JSON, CSV, and a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.config import Config, Value
from ba_node.io.files import whole_file
from ba_node.io.parameters import changes_yaml
from ba_node.offline.figures import BEFORE, CLOUD, COLOURS, line
from ba_node.offline.fleet import name_of
from ba_node.offline.page import Figure, Page, html_table, write_results, write_tables
from ba_node.offline.tuning import Swept, Tuned

_TUNED = "tuned.yaml"
ERRORS = ("recording", "error at the start", "tuned", "change", "solve p95 at the start", "tuned")
PARAMETERS = ("parameter", "start", "tuned", "importance")


def write_parameters(out: Path, base: Config, values: Mapping[str, Value]) -> None:
    """Write the parameters that differ from their defaults to tuned.yaml."""
    with whole_file(out / _TUNED) as stream:
        stream.write(changes_yaml(base.with_values(values)).encode())


def error_rows(tuned: Tuned) -> list[list[str]]:
    """Return the errors and times of each recording before and after, as text."""
    rows = []
    for name, before in tuned.start.items():
        after, kept = tuned.after[name], tuned.plan.validation is not None and name == tuned.plan.validation[0]
        label = name_of(name) + (" (validation)" if kept else "")
        errors = [f"{one.error:.4g} {one.unit}" for one in (before, after)]
        change = f"{100.0 * (after.error / max(before.error, 1e-12) - 1.0):+.1f} %"
        rows.append([label, *errors, change, *(f"{one.latency_ms:.1f} ms" for one in (before, after))])
    return rows


def parameter_rows(tuned: Tuned, base: Config) -> list[list[str]]:
    """Return each parameter's value before and after, and how much it decides, most important first."""
    values, share = base.values(), tuned.importance
    names = sorted(tuned.best.values, key=lambda name: -share.get(name, 0.0))
    pairs = ((name, _shown(values[name]), _shown(tuned.best.values[name])) for name in names)
    return [[*pair, f"{100.0 * share.get(pair[0], 0.0):.0f} %"] for pair in pairs]


def tuned_as_dict(tuned: Tuned) -> dict[str, Any]:
    """Return the content of tuning.json."""
    return {
        "goal": tuned.plan.goal,
        "improved": tuned.improved,
        "overfitted": tuned.overfitted,
        "recordings": {
            name: {"start": asdict(start), "tuned": asdict(tuned.after[name])} for name, start in tuned.start.items()
        },
        "validation": tuned.plan.validation[0] if tuned.plan.validation else None,
        "parameters": tuned.changes,
        "importance": tuned.importance,
        "trials": [asdict(trial) for trial in tuned.trials],
        "trials_refused": tuned.failed,
    }


def write_tuned(out: Path, tuned: Tuned, base: Config) -> str:
    """Write tuned.yaml, tuning.json, tuning.csv and index.html; return their names, or why there is no page.

    Raises:
        OSError: a file cannot be written.
    """
    write_parameters(out, base, tuned.changes)
    verdict, kind = "Better parameters were found", "good"
    if not tuned.improved:
        verdict, kind = "Nothing better was found: the parameters of the start stand", "look"
    elif tuned.overfitted:
        verdict, kind = "Over-fitted: on the recording kept for validation the error is larger", "bad"
    errors = error_rows(tuned)
    head = f"<div class='verdict {kind}'><b>{verdict}</b> in {len(tuned.trials)} trials.</div>"
    head += html_table(ERRORS, [("", row) for row in errors])
    head += "<p></p>" + html_table(PARAMETERS, [("", row) for row in parameter_rows(tuned, base)])
    text = escape(changes_yaml(base.with_values(tuned.changes)))
    figures = [_history(tuned), _importance(tuned), _trade(tuned), *tuned.slices]
    page = Page("Tuning", figures, head, f"<h2>{_TUNED}</h2><pre>{text}</pre>")
    return f"{_TUNED}, {write_results(out, 'tuning', tuned_as_dict(tuned), [ERRORS, *errors], page)}"


def _shown(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _trials(tuned: Tuned, of: str) -> list[dict[str, Any]]:
    """Return a trace of the score of each trial over a field of it, those beyond a limit by themselves."""
    data = []
    for feasible, name, colour in ((True, "trials", COLOURS[0]), (False, "beyond a limit", CLOUD)):
        rows = [one for one in tuned.trials if one.feasible == feasible]
        if rows:
            x, y = [getattr(one, of) for one in rows], [one.score for one in rows]
            data.append(line(x, y, name, colour, mode="markers", marker={"color": colour, "size": 6}))
    return data


def _history(tuned: Tuned) -> Figure:
    data, good = _trials(tuned, "number"), [one for one in tuned.trials if one.feasible]
    if good:
        best = np.minimum.accumulate([one.score for one in good])
        steps = {"color": BEFORE, "shape": "hv"}
        data.append(line([one.number for one in good], best, "best", BEFORE, mode="lines") | {"line": steps})
    layout = {"xaxis": {"title": "trial"}, "yaxis": {"title": "error beside the start's", "type": "log"}}
    return Figure("history", "Trials", "1 is as good as the start; less is better.", data, layout, wide=True)


def _importance(tuned: Tuned) -> Figure:
    names = list(reversed(tuned.importance))
    bar = {"type": "bar", "orientation": "h", "y": names, "x": [tuned.importance[name] for name in names]}
    data = [bar | {"marker": {"color": COLOURS[0]}}] if names else []
    layout = {"xaxis": {"title": "share"}, "yaxis": {"automargin": True}}
    return Figure("importance", "What decides", "Importance of each parameter by PED-ANOVA.", data, layout)


def _trade(tuned: Tuned) -> Figure:
    marker = {"color": BEFORE, "size": 8}
    best = line([tuned.best.latency_ms], [tuned.best.score], "tuned", BEFORE, mode="markers", marker=marker)
    x, y = ({"title": text, "type": "log"} for text in ("time of a solve, p95 [ms]", "error beside the start's"))
    data = [*_trials(tuned, "latency_ms"), best]
    return Figure("trade", "Error against latency", "Each point is a trial.", data, {"xaxis": x, "yaxis": y})


def sweep_rows(found: Swept) -> tuple[list[str], list[list[str]]]:
    """Return heading and rows of a sweep's table, as text."""
    values, measured = found[0]
    head = [*values, *(f"{name_of(name)} [{one.unit}]" for name, one in measured.items()), "solve p95 [ms]"]
    rows = []
    for combination, of in found:
        latency_ms = max(one.latency_ms for one in of.values())
        errors = (f"{one.error:.4g}" for one in of.values())
        rows.append([*map(_shown, combination.values()), *errors, f"{latency_ms:.1f}"])
    return head, rows


def sweep_as_dict(found: Swept) -> dict[str, Any]:
    """Return the content of sweep.json."""
    return {
        "combinations": [
            {"parameters": values, "recordings": {name: asdict(one) for name, one in of.items()}}
            for values, of in found
        ]
    }


def keep_sweep(out: Path, found: Swept) -> None:
    """Write sweep.csv and sweep.json with what is through, so that a sweep that is interrupted leaves it.

    Raises:
        OSError: a file cannot be written.
    """
    if found:
        head, rows = sweep_rows(found)
        write_tables(out, "sweep", sweep_as_dict(found), [head, *rows])


def write_sweep(out: Path, found: Swept) -> str:
    """Write sweep.csv, sweep.json and index.html; return their names, or why there is no page.

    Raises:
        OSError: a file cannot be written.
    """
    head, rows = sweep_rows(found)
    errors = np.array([[one.error for one in of.values()] for _, of in found])
    best = int(np.argmin(np.mean(np.log(np.maximum(errors, 1e-12)), axis=1)))
    names = [", ".join(f"{name}={_shown(value)}" for name, value in values.items()) for values, _ in found]
    data = [
        line([], errors[:, column], name_of(name), COLOURS[column % len(COLOURS)]) | {"x": names}
        for column, name in enumerate(found[0][1])
    ]
    layout = {"yaxis": {"title": "error", "type": "log"}, "xaxis": {"automargin": True}}
    figure = Figure("errors", "Errors", "Of each combination, on each recording.", data, layout, wide=True)
    shown = html_table(head, [("best" if n == best else "", row) for n, row in enumerate(rows)])
    return write_results(out, "sweep", sweep_as_dict(found), [head, *rows], Page("Sweep", [figure], shown))
