# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make a page of the results of replays: verdict and key numbers first, then figures, then all that they depend on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.config import Config
from ba_node.offline.figures import figures, verdicts
from ba_node.offline.page import Page, PageError, html_table, write_page
from ba_node.offline.pictures import Progress, draw_trajectory, write_pictures
from ba_node.offline.run_folder import Run, read_run

REPORT = "report.html"


def write_report(folders: Sequence[Path], path: Path, progress: Progress = lambda *_: None) -> str:
    """Write a page of one replay, or of several side by side, and each figure as PNG; return what to say of them.

    The pictures go to a folder beside the page, of the same name without its end; ``progress`` is called as they come.

    Raises:
        RunError: a folder holds no results.
        OSError: a file cannot be written.
    """
    runs = [read_run(folder, name) for folder, name in zip(folders, _names(folders), strict=True)]
    drawn = figures(runs)
    write_pictures(path.with_suffix(""), drawn, progress)
    head = [_subtitle(runs), *map(_verdict, runs)]
    head.append(_tiles(runs[0]) if len(runs) == 1 else _side_by_side(runs))
    tail = [_guard(run, several=len(runs) > 1) for run in runs] + [_parameters(runs), _origin(runs)]
    title = f"Replay of {runs[0].report['bag']}" if len(runs) == 1 else f"{len(runs)} replays side by side"
    pictures = f"each figure as PNG in {path.stem}/"
    try:
        write_page(path, Page(title, drawn, "\n".join(head), "\n".join(tail)))
    except PageError as error:
        return f"{pictures}; {error}"
    return f"{path.name}, {pictures}"


def show(folder: Path, progress: Progress = lambda *_: None) -> str:
    """Write page and pictures of a replay into its folder; return what to say of them.

    Raises:
        RunError: the folder holds no results.
        OSError: a file cannot be written.
    """
    draw_trajectory(folder / "trajectory.png", read_run(folder))
    return f"trajectory.png, {write_report([folder], folder / REPORT, progress)}"


def _names(folders: Sequence[Path]) -> list[str]:
    """Return what tells folders apart: their last names, or as much of their paths as it takes."""
    parts = [folder.resolve().parts for folder in folders]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(one[-depth:]) for one in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{n}: {folder}" for n, folder in enumerate(folders, start=1)]


def _subtitle(runs: Sequence[Run]) -> str:
    texts = dict.fromkeys(
        f"session {run.report['session_id']}, topics {', '.join(run.report['topics_taken'].values())}" for run in runs
    )
    return f"<p class=sub>ba_node {runs[0].report['versions']['ba_node']}; {escape('; '.join(texts))}</p>"


def _verdict(run: Run) -> str:
    report, lines = run.report, run.report["attention"]
    held = not report["keyframes_refined"]
    kind = "bad" if held else "look" if lines else "good"
    text = f"{report['keyframes_refined']} of {report['keyframes']} keyframes refined"
    error = report.get("trajectory_error_m")
    if error:
        text += f"; error to the reference {error['input']:.3g} m before, {error['refined']:.3g} m after"
    text += "; look at this:" if lines else "; nothing to look at."
    items = f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>" if lines else ""
    return f"<div class='verdict {kind}'><b>{escape(run.name)}</b>: {escape(text)}{items}</div>"


def _pair(values: dict[str, Any], unit: str) -> str:
    before, after = ("-" if values[key] is None else _short(values[key], unit) for key in ("input", "refined"))
    return f"{before} → {after} {unit}"


def _short(value: float, unit: str) -> str:
    """Return three digits of a number; of pixels next to nothing that they are, as nobody compares such."""
    return "<0.001" if unit == "px" and 0.0 < value < 1e-3 else f"{value:.3g}"


def _times(report: dict[str, Any], share: float) -> str:
    times = report.get("solve_times_s") or [0.0]
    return f"{1e3 * float(np.percentile(times, share)):.1f} ms"


# Key numbers: what they are, and how they read.
_KEYS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("error to the reference", lambda r: _pair(r["trajectory_error_m"], "m") if r.get("trajectory_error_m") else "-"),
    ("keyframes refined", lambda r: f"{r['keyframes_refined']} of {r['keyframes']}"),
    ("median residual", lambda r: _pair(r["median_px"], "px")),
    ("rms of all", lambda r: _pair(r["rms_px"], "px")),
    ("rms without outliers", lambda r: _pair(r["rms_px_without_outliers"], "px")),
    ("points", lambda r: str(r["landmarks"])),
    ("observations", lambda r: str(r["observations"])),
    ("outliers", lambda r: f"{100.0 * r['outliers'] / max(r['observations'], 1):.1f} %"),
    ("solves held or failed", lambda r: str(sum(r["solves_by_status"].get(name, 0) for name in ("HELD", "FAILED")))),
    ("time of a solve, median", lambda r: _times(r, 50)),
    ("time of a solve, p95", lambda r: _times(r, 95)),
    ("solver in all", lambda r: f"{r['solver_time_s']:.2f} s"),
)


def _tiles(run: Run) -> str:
    shown = [(name, value) for name, of in _KEYS if (value := of(run.report)) != "-"]
    tiles = "".join(f"<div class=tile><b>{escape(value)}</b><span>{name}</span></div>" for name, value in shown)
    return f"<div class=tiles>{tiles}</div>"


def _side_by_side(runs: Sequence[Run]) -> str:
    rows = [("", [name, *(of(run.report) for run in runs)]) for name, of in _KEYS]
    return html_table(["", *(run.name for run in runs)], rows)


def _guard(run: Run, *, several: bool) -> str:
    rows = [("", [text, str(count)]) for text, count in verdicts(run.report, run.details)]
    title = f"What the guard said{f' of {run.name}' if several else ''}"
    shown = (
        html_table(["solves that gave nothing, and why", "solves"], rows) if rows else "<p>All solves were taken.</p>"
    )
    return f"<h2>{escape(title)}</h2>{shown}"


def _parameters(runs: Sequence[Run]) -> str:
    defaults = Config().values()
    changed, same = [], []
    for name, default in defaults.items():
        values = [run.parameters[name] for run in runs]
        cells = [name, *map(str, values), str(default)]
        if any(value != default for value in values):
            changed.append(("changed", cells))
        else:
            same.append(("", cells))
    head = ["parameter", *(run.name for run in runs), "default"]
    text = html_table(head, changed) if changed else "<p>All parameters have their defaults.</p>"
    return f"<h2>Parameters in force</h2>{text}<details><summary>all others</summary>{html_table(head, same)}</details>"


def _origin(runs: Sequence[Run]) -> str:
    rows = []
    for run in runs:
        for file in run.report["recording"]["files"]:
            digest = next(f"{key}: {value}" for key, value in file.items() if key.startswith("sha256"))
            rows.append(("", [run.name, file["name"], f"{file['bytes']:,}".replace(",", " "), digest]))
    versions = [("", [run.name, *map(str, run.report["versions"].values())]) for run in runs]
    return (
        f"<h2>Made from</h2>{html_table(['run', 'file', 'bytes', 'hash'], rows)}<p></p>"
        f"{html_table(['run', *runs[0].report['versions']], versions)}"
    )
