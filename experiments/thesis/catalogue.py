# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""All experiments, and how they are asked for."""

from __future__ import annotations

import re
from collections.abc import Sequence

from experiments.thesis.beside import BESIDE
from experiments.thesis.chapter3 import CHAPTER_3
from experiments.thesis.chapter45 import CHAPTER_4, CHAPTER_5
from experiments.thesis.experiments import Experiment
from experiments.thesis.open_problems import OPEN

# Of the thesis, each with its seeds.
REPEATED: tuple[Experiment, ...] = (*CHAPTER_3, *BESIDE, *CHAPTER_4, *CHAPTER_5)
EXPERIMENTS: tuple[Experiment, ...] = (*REPEATED, *OPEN)


def _is_number(value: float | str) -> bool:
    return not isinstance(value, str) or re.fullmatch(r"> \d+", value) is not None


_FIGURE = re.compile(r"(?:fig(?:ure)?)[-. ]?(\d+\.\d+)")
_TABLE = re.compile(r"(?:table[-. ]?)?(\d+\.\d+)")


# The thesis's own figures, by experiment, label and metric; "> 5000" is 5000.
PRINTED: dict[str, dict[str, dict[str, float]]] = {
    experiment.name: {
        case.label: {name: float(str(value).lstrip("> ")) for name, value in case.thesis.items() if _is_number(value)}
        for case in experiment.cases
    }
    for experiment in EXPERIMENTS
}


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
