# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Repeat a choice of experiments: run what has no record yet, then write the pages."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from ba_node import native
from ba_node.io.files import write_json
from experiments.thesis.catalogue import PRINTED
from experiments.thesis.claims import CLAIMS
from experiments.thesis.experiments import Experiment
from experiments.thesis.findings import FINDINGS
from experiments.thesis.problems import Library
from experiments.thesis.report import Section, write_report
from experiments.thesis.runner import Clock, Progress, Runner
from experiments.thesis.tasks import Task
from experiments.thesis.verdicts import verdicts_on

# Problems that a quick look leaves out.
_LARGE = ("100-4000", "500-5000")


class Repetition:
    """Experiments, where their data come from, and where records and pages go."""

    def __init__(self, experiments: Sequence[Experiment], data: Path, out: Path, *, quick: bool = False) -> None:
        """Prepare.

        Args:
            experiments: what to repeat.
            data: folder of data sets.
            out: folder for records and pages.
            quick: a few steps a run, and no large problem.
        """
        self._library, self._out, self._quick = Library(data), out, quick
        # Names of problems that are left out, as their files are not there and the others do without.
        problems = {case.task.problem for experiment in experiments for case in experiment.cases}
        self.absent = sorted(filter(self._library.absent, problems))
        there = [_without(experiment, self.absent) for experiment in experiments]
        self._experiments = [_quick(experiment) for experiment in there] if quick else there

    def missing(self) -> list[Task]:
        """Return the tasks that have no record yet.

        Raises:
            DataError: a data set is not there.
        """
        return self._runner(lambda: 0.0, None).missing(self._tasks())

    def run(self, clock: Clock, progress: Progress | None = None) -> list[Section]:
        """Run what is missing, and return all; arguments as of Runner."""
        runner = self._runner(clock, progress)
        for task in runner.missing(self._tasks()):
            runner.record(task)
        return [
            Section(
                experiment, {case.label: [runner.record(task) for task in case.tasks()] for case in experiment.cases}
            )
            for experiment in self._experiments
            if experiment.cases
        ]

    def write(self, sections: Sequence[Section]) -> Path:
        """Write the pages, results.json and verdicts.json; return the page that holds all."""
        found = results(sections)
        write_json(self._out / "results.json", found)
        verdicts = [] if self._quick else verdicts_on((*CLAIMS, *FINDINGS), found, PRINTED)
        words = {verdict.claim.text: verdict.word for verdict in verdicts}
        write_json(self._out / "verdicts.json", {"kernels": native.description(), "verdicts": words})
        return write_report(self._out, sections, verdicts)

    def _tasks(self) -> list[Task]:
        return [task for experiment in self._experiments for case in experiment.cases for task in case.tasks()]

    def _runner(self, clock: Clock, progress: Progress | None) -> Runner:
        return Runner(self._library, self._out / "runs", clock, progress)


def results(sections: Sequence[Section]) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the metrics of all cases by experiment and label, with the key of the record; seven digits are enough."""
    return {
        section.experiment.name: {
            label: {
                "key": section.records[label]["key"],
                "seeds": len(section.runs[label]),
                **{name: _short(value) for name, value in metrics.items()},
            }
            for label, metrics in section.metrics.items()
        }
        for section in sections
    }


def _short(value: Any) -> Any:
    """Return a value with seven digits, and what holds values with those in it."""
    if isinstance(value, Mapping):
        return {name: _short(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_short(item) for item in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value


def _quick(experiment: Experiment) -> Experiment:
    there = _without(experiment, _LARGE)
    cases = tuple(dataclasses.replace(case, task=case.task.quick()) for case in there.cases)
    return dataclasses.replace(there, cases=cases)


def _without(experiment: Experiment, problems: Collection[str]) -> Experiment:
    cases = tuple(case for case in experiment.cases if case.task.problem not in problems)
    return dataclasses.replace(experiment, cases=cases)
