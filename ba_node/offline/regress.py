# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replay recordings and compare figures of their reports with a baseline that is kept beside them.

A baseline is YAML::

    recordings:
    - recording: stereo_loop.mcap        # beside the baseline, or absolute
      settings: {window.max_keyframes: 20}   # what differs from the defaults, optional
      figures:
      - {key: trajectory_error_m.refined, value: 0.0054, unit: m, direction: lower, tolerance: 0.02}

``key`` is a path into report.json. Better is ``lower`` or ``higher``, or ``equal`` alone; ``tolerance`` is the share of
the value by which a figure may be worse.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from ba_node.config import Config
from ba_node.io.files import whole_file
from ba_node.io.yaml_file import read_yaml
from ba_node.offline.replay import Watch
from ba_node.offline.replay import replay as run_replay

LOWER, HIGHER, EQUAL = "lower", "higher", "equal"
OK, WORSE, BETTER, MISSING = "ok", "WORSE", "better", "MISSING"
# What a new baseline holds: key, unit, direction, tolerance; what a recording does not have is left out.
_USUAL = (
    ("trajectory_error_m.refined", "m", LOWER, 0.02),
    ("rms_px_without_outliers.refined", "px", LOWER, 0.02),
    ("keyframes_refined", "", HIGHER, 0.0),
    ("landmarks", "", HIGHER, 0.05),
    ("solves", "", EQUAL, 0.0),
)
_HEAD = "# Baseline of `ba regress`; `ba regress FILE --update` takes the figures of now over.\n"


class RegressError(ValueError):
    """A baseline that cannot be read, or that names nothing."""


@dataclass(frozen=True)
class Figure:
    """A figure of a report as it was."""

    key: str
    value: float
    unit: str = ""
    direction: str = LOWER
    tolerance: float = 0.0

    def compare(self, now: float | None) -> str:
        """Return how a figure of now compares."""
        if now is None or not math.isfinite(now):
            return MISSING
        margin = self.tolerance * abs(self.value)
        change = now - self.value if self.direction == LOWER else self.value - now
        if self.direction == EQUAL:
            return OK if abs(change) <= margin else WORSE
        return WORSE if change > margin else BETTER if change < -margin else OK


@dataclass(frozen=True)
class Case:
    """A recording, how it is replayed, and its figures."""

    recording: str
    settings: Mapping[str, Any]
    figures: tuple[Figure, ...]


@dataclass(frozen=True)
class Row:
    """A figure then and now."""

    recording: str
    figure: Figure
    now: float | None
    verdict: str


def read_baseline(path: Path) -> list[Case]:
    """Read a baseline.

    Raises:
        RegressError: it is no baseline, or a figure of it is not one.
    """
    content = read_yaml(path, RegressError)
    if not isinstance(content, dict) or not isinstance(content.get("recordings"), list) or not content["recordings"]:
        raise RegressError(f"{path}: expected a list of recordings, as `ba regress FILE --new RECORDING...` writes")
    return [_case(path, entry) for entry in content["recordings"]]


def write_baseline(path: Path, cases: Sequence[Case]) -> None:
    """Write a baseline."""
    content = {
        "recordings": [
            {"recording": case.recording, "settings": dict(case.settings), "figures": [vars(f) for f in case.figures]}
            for case in cases
        ]
    }
    text = yaml.safe_dump(content, sort_keys=False, width=120, default_flow_style=None)
    with whole_file(path) as stream:
        stream.write((_HEAD + text).encode())


def run(
    path: Path, cases: Sequence[Case], clock: Callable[[], float], progress: Callable[[int, int], None]
) -> list[Row]:
    """Replay the recordings of a baseline and compare.

    Raises:
        BagError: a recording cannot be read. ConfigError: a setting does not exist.
    """
    rows = []
    for done, case in enumerate(cases):
        progress(done, len(cases))
        report = _report(path, case, clock)
        for figure in case.figures:
            now = value_of(report, figure.key)
            rows.append(Row(case.recording, figure, now, figure.compare(now)))
    return rows


def new_cases(path: Path, recordings: Sequence[Path], clock: Callable[[], float]) -> list[Case]:
    """Return a baseline of recordings as they replay now, named as seen from its file."""
    cases = []
    for recording in recordings:
        inside = recording.resolve().is_relative_to(path.resolve().parent)
        name = recording.resolve().relative_to(path.resolve().parent) if inside else recording.resolve()
        case = Case(str(name), {}, ())
        report = _report(path, case, clock)
        values = [(value_of(report, key), key, unit, way, share) for key, unit, way, share in _USUAL]
        figures = [Figure(key, value, unit, way, share) for value, key, unit, way, share in values if value is not None]
        cases.append(replace(case, figures=tuple(figures)))
    return cases


def updated(cases: Sequence[Case], rows: Sequence[Row]) -> list[Case]:
    """Return a baseline with the figures of now."""
    now = {(row.recording, row.figure): row.now for row in rows}

    def figures(case: Case) -> tuple[Figure, ...]:
        found = ((figure, now.get((case.recording, figure))) for figure in case.figures)
        return tuple(figure if value is None else replace(figure, value=value) for figure, value in found)

    return [replace(case, figures=figures(case)) for case in cases]


def value_of(report: Mapping[str, Any], key: str) -> float | None:
    """Return a number of a report by its path; the length of a list."""
    found: Any = report
    for name in key.split("."):
        found = found.get(name) if isinstance(found, Mapping) else None
    if isinstance(found, (list, tuple)):
        return len(found)
    return found if isinstance(found, (int, float)) and not isinstance(found, bool) else None


def _report(path: Path, case: Case, clock: Callable[[], float]) -> dict[str, Any]:
    config = Config().with_values(case.settings)
    with tempfile.TemporaryDirectory(prefix="ba_regress_") as folder:
        return run_replay(path.parent / case.recording, Path(folder) / "out", config, Watch(clock))


def _case(path: Path, entry: Any) -> Case:
    try:
        figures = tuple(_figure(figure) for figure in entry["figures"])
        return Case(str(entry["recording"]), dict(entry.get("settings") or {}), figures)
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise RegressError(f"{path}: {entry!r:.200}: {type(error).__name__}: {error}") from None


def _figure(entry: Mapping[str, Any]) -> Figure:
    figure = Figure(**entry)
    if figure.direction not in (LOWER, HIGHER, EQUAL) or isinstance(figure.value, (str, bool)):
        raise ValueError(f"{figure.key}: expected a number, and lower, higher or equal for what is better")
    if not (math.isfinite(figure.value) and math.isfinite(figure.tolerance) and figure.tolerance >= 0.0):
        raise ValueError(f"{figure.key}: expected finite numbers, and a tolerance of 0 or more")
    return figure
