# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run what experiments ask for, and keep a record of each: a run that was recorded is never made again.

A record takes its name only when it is whole; whoever interrupts loses the run that was under way, nothing else.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.core.problem import Problem
from ba_node.core.result import Iteration, Result
from ba_node.core.solver import solve
from ba_node.io.files import write_json
from experiments.thesis import final_state, measures
from experiments.thesis.problems import NAMES, Library, Posed
from experiments.thesis.tasks import Measure, Run, Task, key
from experiments.thesis.variants import VARIANTS

# How far a seed moves the start: less than what is written in the files of the data sets, more than rounding.
_MOVE = 1e-13

Clock = Callable[[], float]
Record = Mapping[str, Any]
# Called with the task that is under way, and with how much of it is done, 0 to 1.
Progress = Callable[[Task, float], None]


class Runner:
    """Make or find the records of tasks."""

    def __init__(self, library: Library, folder: Path, clock: Clock, progress: Progress | None = None) -> None:
        """Prepare the folder of the records.

        Args:
            library: the problems.
            folder: of the records.
            clock: seconds, for the traces alone.
            progress: told how far a task is; may be None.
        """
        self._library, self._folder, self._clock = library, folder, clock
        self._progress = progress
        folder.mkdir(parents=True, exist_ok=True)

    def missing(self, tasks: Iterable[Task]) -> list[Task]:
        """Return those without a record, each once, those of the same problem together."""
        wanted = {key(task, self._library): task for task in tasks}
        left = (task for name, task in wanted.items() if self._read(name) is None)
        return sorted(left, key=lambda task: NAMES.index(task.problem))

    def record(self, task: Task) -> Record:
        """Return the record of a task, made now if there is none.

        Raises:
            DataError: the data set is not there.
        """
        name = key(task, self._library)
        found = self._read(name)
        if found is not None:
            return found
        posed = self._library.get(task.problem)
        made = self._run(task, posed) if isinstance(task, Run) else self._measure(task, posed)
        write_json(self._folder / f"{name}.json", {"key": name, "problem": _sizes(task, posed), **made})
        self._tell(task, 1.0)
        found = self._read(name)
        assert found is not None
        return found

    def _read(self, name: str) -> Record | None:
        path = self._folder / f"{name}.json"
        try:
            record: Record = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            # Not there, or damaged: it is made again.
            return None
        return record if isinstance(record, dict) and record.get("key") == name else None

    def _run(self, task: Run, posed: Posed) -> dict[str, Any]:
        options = task.options()
        taken = -1  # row 0 of the trace is the start

        def watch(row: Iteration) -> bool:
            nonlocal taken
            taken += row.accepted
            self._tell(task, max(taken, 0) / max(task.iterations, 1))
            return taken < task.iterations

        kernels = None
        if task.kernels:
            kernels = VARIANTS[task.kernels](posed.problem, options)  # the start is no part of them
        problem = moved(posed.problem, task.seed)
        result = solve(problem, options, clock=self._clock, on_iteration=watch, kernels=kernels)
        return {
            "method": task.method,
            "settings": list(task.settings),
            "options": dataclasses.asdict(options),
            "iterations": task.iterations,
            "status": result.status.name,
            "reason": f"took {taken} steps" if taken >= task.iterations else result.reason,
            "trace": [row._asdict() for row in result.trace],
            **_end(task, posed, result),
        }

    def _measure(self, task: Measure, posed: Posed) -> dict[str, Any]:
        self._tell(task, 0.0)
        return {"measure": task.what, **measures.MEASURES[task.what](posed, task.settings, self._clock)}

    def _tell(self, task: Task, share: float) -> None:
        if self._progress is not None:
            self._progress(task, share)


def moved(problem: Problem, seed: int) -> Problem:
    """Return a problem whose points begin elsewhere by 1e-13 of their coordinates; the same for seed 0."""
    if not seed:
        return problem
    points = problem.start.points
    points = points * (1.0 + _MOVE * np.random.default_rng(seed).normal(size=points.shape))
    return dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points))


def _end(task: Run, posed: Posed, result: Result) -> dict[str, Any]:
    problem, state = posed.problem, result.state
    out: dict[str, Any] = {
        "gradient": final_state.gradients(problem, task.options(), state),
        "residuals": final_state.residuals(problem, state),
        "images": final_state.pictures(problem, state, task.images),
    }
    if posed.truth is not None:
        out["truth_before"] = final_state.truth_errors(problem.start, posed.truth)
        out["truth_after"] = final_state.truth_errors(state, posed.truth)
    return out


def _sizes(task: Task, posed: Posed) -> dict[str, object]:
    problem = posed.problem
    return {
        "name": task.problem,
        "images": problem.n_keyframes,
        "points": problem.n_points,
        "observations": len(problem.observations),
    }
