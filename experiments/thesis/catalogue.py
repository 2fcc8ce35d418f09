# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""All experiments, and how they are asked for."""

from __future__ import annotations

import re
from collections.abc import Sequence

from experiments.thesis.chapter3 import CHAPTER_3
from experiments.thesis.chapter45 import CHAPTER_4, CHAPTER_5
from experiments.thesis.experiments import Experiment
from experiments.thesis.open_problems import OPEN

EXPERIMENTS: tuple[Experiment, ...] = (*CHAPTER_3, *CHAPTER_4, *CHAPTER_5, *OPEN)
_FIGURE = re.compile(r"(?:fig(?:ure)?)[-. ]?(\d+\.\d+)")
_TABLE = re.compile(r"(?:table[-. ]?)?(\d+\.\d+)")


class ExperimentError(ValueError):
    """An experiment that does not exist."""


def find(name: str) -> Experiment:
    """Return an experiment by a table (``3.8``), a figure (``fig-3.16``) or its name; a bare number is a table first.

    Raises:
        ExperimentError: there is none; the message lists those there are.
    """
    wanted = name.strip().lower()
    for experiment in EXPERIMENTS:
        if wanted == experiment.name:
            return experiment
    figure, table = _FIGURE.fullmatch(wanted), _TABLE.fullmatch(wanted)
    if table and any(experiment.name == table[1] for experiment in EXPERIMENTS):
        return find(table[1])
    number = figure or table
    for experiment in EXPERIMENTS:
        if number and number[1] in experiment.figures:
            return experiment
    raise ExperimentError(
        f"{name!r} is no table or figure that is repeated: choose of {', '.join(e.name for e in EXPERIMENTS)}, or a"
        f" figure, fig-N, of {', '.join(number for e in EXPERIMENTS for number in e.figures)}"
    )


def chosen(names: Sequence[str]) -> tuple[Experiment, ...]:
    """Return the experiments of some names, each once, in the order of the thesis; all if there are none."""
    wanted = {find(name).name for name in names}
    return tuple(experiment for experiment in EXPERIMENTS if not names or experiment.name in wanted)
