# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What an experiment is: cases to run, what is shown of them, and what the thesis has in the same place."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from experiments.thesis.tasks import Measure, Task

# Starts of every solve: the file's, and others that differ from it by 1e-13.
SEEDS = 3


@dataclass(frozen=True)
class Case:
    """A row of a table, a curve of a picture."""

    label: str  # as in the thesis where it has the same
    task: Task  # what is run
    thesis: Mapping[str, float | str] = field(default_factory=dict)  # its figures, by metric (metrics.py)
    note: str = ""  # what departs from the thesis
    versus: str = ""  # label of the case that its times are compared with; empty for the first
    seeds: int = SEEDS  # how many starts it is run from; what is measured beside the loop is measured once

    def tasks(self) -> tuple[Task, ...]:
        """Return what is run: the task, and the same from starts moved by rounding alone."""
        if isinstance(self.task, Measure):
            return (self.task,)
        return tuple(dataclasses.replace(self.task, seed=seed) for seed in range(self.seeds))


@dataclass(frozen=True)
class Experiment:
    """A table of the thesis with the figures that belong to it, or figures alone."""

    name: str  # ``3.8`` for a table, ``fig-3.1`` for figures alone, a word for what the thesis does not have
    title: str  # what is compared
    cases: tuple[Case, ...]  # rows
    columns: tuple[str, ...]  # metrics of the table
    figures: tuple[str, ...] = ()  # of the thesis that it repeats
    plots: tuple[str, ...] = ()  # names in plots.PLOTS
    note: str = ""  # what is to be known
    clock: str = ""  # label of the case at whose end the others are looked at too, by time; empty for none

    def case(self, label: str) -> Case:
        """Return the case of a label, the first one for an empty label."""
        return next(case for case in self.cases if label in ("", case.label))

    @property
    def is_table(self) -> bool:
        """Return True if the thesis has a table of this name."""
        return self.name.replace(".", "").isdigit()

    @property
    def heading(self) -> str:
        """Return what it repeats and its title."""
        repeated = [f"Table {self.name}"] if self.is_table else []
        if self.figures:
            repeated.append(f"Figure{'s' if len(self.figures) > 1 else ''} {', '.join(self.figures)}")
        name = f"Open problem ({self.name})" if self.name.startswith("open-") else self.name.capitalize()
        return f"{', '.join(repeated) or name}: {self.title}"
