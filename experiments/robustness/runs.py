# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replay recordings with faults and with outliers, one row of figures each; what is in the file is not run again."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ba_node.config import Config
from ba_node.offline.recording import record
from ba_node.offline.replay import replay
from experiments.robustness.faults import FAULTS, RIGS, SOUND, Recording, spoiled, without_outliers
from experiments.robustness.harm import SessionResult, messages_of, session_results

Row = dict[str, Any]

FAULT_TABLE, OUTLIER_TABLE = "faults", "outliers"
KINDS = ("outliers_uniform", "outliers_jumping", "outliers_moving")
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)
RESULTS = "results.jsonl"
# Drives whose odometry is worse than those of the faults, so that outliers are seen to cost accuracy.
_DRIVE = {
    "keyframes": 60,
    "length_m": 30.0,
    "path": "loop",
    "tracks": 200,
    "landmarks": 3000,
    "outlier_share": 0.0,
    "drift_rotation_deg": 0.5,
    "drift_translation": 0.03,
}
# An observation farther from the truth than so many sigma is an outlier.
_OUTLIER_SIGMA = 6.0
_NOISE_PX = 0.5
_NO_MESSAGE = r"\A\s*\Z"


class NameChoiceError(ValueError):
    """A name that is no fault and no table."""


@dataclass(frozen=True)
class Task:
    """A recording to be replayed."""

    table: str  # FAULT_TABLE or OUTLIER_TABLE
    fault: str  # name in FAULTS, or ``sound``
    rig: str  # name in RIGS
    amount: float  # of the fault
    seed: int  # of world, noise and fault

    @property
    def key(self) -> str:
        """Return what names it in the file of results."""
        return f"{self.table}/{self.fault}/{self.rig}/{self.amount:g}/{self.seed}"


def tasks(seeds: int, only: Collection[str] = ()) -> list[Task]:
    """Return all that there is to run.

    Args:
        seeds: how many seeds of each.
        only: names of faults or tables; empty for all.

    Raises:
        NameChoiceError: a name is neither.
    """
    names = (FAULT_TABLE, OUTLIER_TABLE, SOUND, *FAULTS)
    unknown = [name for name in only if name not in names]
    if unknown:
        raise NameChoiceError(f"{unknown[0]!r} is no fault and no table: choose from {', '.join(names)}")
    found = [Task(FAULT_TABLE, SOUND, rig, 0.0, seed) for rig in RIGS for seed in range(seeds)]
    for name, fault in FAULTS.items():
        if name not in KINDS:
            found += [
                Task(FAULT_TABLE, name, rig, amount, seed)
                for rig in fault.rigs
                for amount in fault.amounts
                for seed in range(seeds)
            ]
    for kind in KINDS:
        found += [
            Task(OUTLIER_TABLE, kind, rig, share, seed) for rig in RIGS for share in SHARES for seed in range(seeds)
        ]
    return [task for task in found if not only or task.fault in only or task.table in only]


def run_all(wanted: Sequence[Task], out: Path, jobs: int, progress: Callable[[int, int], None]) -> list[Row]:
    """Run what is missing and return the rows of all that is wanted, in its order.

    Args:
        wanted: tasks.
        out: folder with the file of results; made if missing.
        jobs: processes.
        progress: called with the number of rows and of all rows.

    Raises:
        OSError: the file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / RESULTS
    rows = _read(path)
    missing = [task for task in wanted if task.key not in rows]
    done = len(wanted) - len(missing)
    progress(done, len(wanted))
    with path.open("a", encoding="utf-8") as stream:
        for row in _results(missing, jobs):
            rows[row["key"]] = row
            stream.write(f"{json.dumps(row)}\n")
            stream.flush()
            done += 1
            progress(done, len(wanted))
    return [rows[task.key] for task in wanted]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows without their words, one a line, for docs/robustness_results.json."""
    lines = (json.dumps({key: _short(value) for key, value in row.items() if key != "words"}) for row in rows)
    path.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")


def run(task: Task) -> Row:
    """Replay one recording, an outlier's without its outliers too; return the row of results."""
    row: Row = {"key": task.key, "table": task.table, "fault": task.fault, "rig": task.rig}
    row |= {"amount": task.amount, "seed": task.seed}
    if task.table == FAULT_TABLE:
        recording = spoiled(task.fault, task.rig, task.amount, task.seed)
        return row | _fault(task, recording)
    recording = spoiled(task.fault, task.rig, task.amount, task.seed, **_DRIVE)
    best = _replayed(without_outliers(recording, _OUTLIER_SIGMA * _NOISE_PX))
    found = _replayed(recording)
    return (
        row | _figures(found.errors) | {"optimum_m": _figures(best.errors)["published_m"], "words": found.words[:200]}
    )


@dataclass(frozen=True)
class _Outcome:
    errors: list[SessionResult]
    words: str
    refused: bool
    crashed: bool = False


def _replayed(recording: Recording) -> _Outcome:
    with TemporaryDirectory(prefix="ba_robustness_") as name:
        folder = Path(name)
        bag, out = folder / "recording.mcap", folder / "out"
        record(bag, recording.timeline, camera_info=recording.camera_info)
        try:
            report = replay(bag, out, Config())
        except ValueError as error:
            crashed = not type(error).__module__.startswith("ba_node.")
            return _Outcome([], f"{type(error).__name__}: {error}", not crashed, crashed)
        except Exception as error:  # a table of faults has a row for this one too
            return _Outcome([], f"{type(error).__name__}: {error}", False, crashed=True)
        errors = session_results(out, recording.truth)
        shutil.rmtree(out)
        return _Outcome(errors, messages_of(report), False)


def _fault(task: Task, recording: Recording) -> Row:
    fault, outcome = FAULTS.get(task.fault), _replayed(recording)
    named = (_NO_MESSAGE,) if fault is None else fault.named
    share = sum(error.keyframes for error in outcome.errors) / len(recording.keyframes)
    enough = share >= (1.0 if fault is None else fault.least)
    return {
        **_figures(outcome.errors),
        "published_share": share,
        "verdict": _verdict(outcome, enough),
        "told": all(re.search(pattern, outcome.words, re.IGNORECASE) for pattern in named),
        "words": outcome.words[:300],
    }


def _verdict(outcome: _Outcome, enough: bool) -> str:
    if outcome.crashed:
        return "crash"
    if outcome.refused:
        return "refused" if not enough or not outcome.errors else "kept"
    if not enough or not all(error.harmless for error in outcome.errors):
        return "harm"
    better = all(error.published_m < 0.9 * error.input_m for error in outcome.errors)
    return "better" if better else "kept"


def _figures(errors: Sequence[SessionResult]) -> Row:
    """Return the errors of all sessions together; the rotation is that of the worst."""
    if not errors:
        return dict.fromkeys(("input_m", "published_m", "input_deg", "published_deg"))
    weight = [error.keyframes for error in errors]

    def total(values: list[float]) -> float:
        return float(np.sqrt(np.average(np.square(values), weights=weight)))

    return {
        "input_m": total([error.input_m for error in errors]),
        "published_m": total([error.published_m for error in errors]),
        "input_deg": total([error.input_deg for error in errors]),
        "published_deg": total([error.published_deg for error in errors]),
    }


def _short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _results(missing: Sequence[Task], jobs: int) -> Iterator[Row]:
    if jobs == 1:
        yield from map(run, missing)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(run, missing)


def _read(path: Path) -> dict[str, Row]:
    """Return the rows in a file by key; a line that broke off when it was written is made anew."""
    rows: dict[str, Row] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        rows[row["key"]] = row
    return rows
