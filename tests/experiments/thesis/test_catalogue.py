# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The experiments: every table and figure is there, every option is one that exists, and each can be asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from ba_node.cli.main import main
from experiments.thesis import catalogue
from experiments.thesis.experiments import Experiment
from experiments.thesis.measures import MEASURES
from experiments.thesis.metrics import METRICS
from experiments.thesis.plots import PLOTS
from experiments.thesis.problems import NAMES
from experiments.thesis.tasks import Run

TABLES = [*(f"3.{i}" for i in range(1, 12)), "4.1", "4.2", *(f"5.{i}" for i in range(1, 5))]
FIGURES = [
    *(f"3.{i}" for i in range(1, 24)),
    *(f"4.{i}" for i in range(1, 7)),
    *(f"5.{i}" for i in range(1, 20)),
]
IDS = [experiment.name for experiment in catalogue.EXPERIMENTS]


def test_every_table_and_figure_is_repeated_once() -> None:
    assert sorted(name for name in IDS if name in TABLES) == sorted(TABLES)
    figures = [number for experiment in catalogue.EXPERIMENTS for number in experiment.figures]
    assert sorted(figures) == sorted(FIGURES)
    assert len(set(IDS)) == len(IDS)


@pytest.mark.parametrize("experiment", catalogue.EXPERIMENTS, ids=IDS)
def test_everything_it_names_exists(experiment: Experiment) -> None:
    assert set(experiment.columns) <= METRICS.keys()
    assert set(experiment.plots) <= PLOTS.keys()
    labels = [case.label for case in experiment.cases]
    assert len(set(labels)) == len(labels)
    for case in experiment.cases:
        assert case.task.problem in NAMES
        assert set(case.thesis) <= set(experiment.columns), case.label
        assert case.versus == "" or case.versus in labels
        if isinstance(case.task, Run):
            case.task.options().check()
        else:
            assert case.task.what in MEASURES


@pytest.mark.parametrize("experiment", catalogue.EXPERIMENTS, ids=IDS)
def test_a_table_whose_times_are_compared_uses_one_kind_of_kernels(experiment: Experiment) -> None:
    if not any(METRICS[name].is_time for name in experiment.columns):
        return
    compared = [case.task for case in experiment.cases if not case.label.endswith("C++")]
    backends = {task.options().kernels for task in compared if isinstance(task, Run)}
    assert len(backends) <= 1, backends


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ("3.8", "3.8"),
        ("table 3.8", "3.8"),
        ("fig-3.8", "3.5"),
        ("3.16", "3.8"),
        ("figure 5.6", "ladybug"),
        ("4.6", "outliers"),
    ],
)
def test_it_is_found_by_table_figure_or_name(asked: str, found: str) -> None:
    assert catalogue.find(asked).name == found


def test_unknown_names_are_answered_with_those_there_are() -> None:
    with pytest.raises(catalogue.ExperimentError) as refusal:
        catalogue.chosen(["3.8", "3.99"])
    assert "'3.99'" in str(refusal.value)
    assert all(name in str(refusal.value) for name in TABLES)


class TestCommand:
    def test_list(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["thesis", "--list"]) == 0
        assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == IDS

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [([], "say which experiments"), (["3.8", "--all"], "say which experiments"), (["7.1"], "choose of fig-3.1")],
    )
    def test_refusals(self, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["thesis", *arguments]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1

    def test_missing_data_is_one_line(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["thesis", "3.8", "--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
        assert "grail.cs.washington.edu" in capsys.readouterr().err

    @pytest.mark.slow
    def test_a_small_one(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        arguments = ["thesis", "5.1", "fig-5.5", "--quick", "--out", str(tmp_path / "a" / "b")]
        assert main(arguments) == 0
        first = capsys.readouterr().out
        assert "| local DINM |" in first and "report.html" in first
        assert main(arguments) == 0
        assert capsys.readouterr().out == first, "records are used again, times and all"
