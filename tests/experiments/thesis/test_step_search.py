# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The search for the steps of ``inc`` scaling."""

from __future__ import annotations

from pathlib import Path

import pytest

from ba_node.cli.main import main
from ba_node.core.problem import Problem
from ba_node.core.scaling import INC_STEPS
from ba_node.io import bal
from experiments.thesis import step_search
from experiments.thesis.problems import known_calibration
from experiments.thesis.sphere import generate_sphere
from experiments.thesis.sphere_file import start_of, truth_of
from experiments.thesis.sphere_options import SphereOptions


@pytest.fixture(scope="module")
def problem() -> Problem:
    return bal.to_problem(start_of(generate_sphere(SphereOptions(radius=5.0))))


@pytest.mark.parametrize("parameterisation", ["local", "global"])
def test_the_best_step_balances_curvature_and_rounding(parameterisation: str, problem: Problem) -> None:
    found = {item.kind: item for item in step_search.search_steps(problem, parameterisation)}
    assert set(found) == set(step_search.KINDS)
    for kind in ("rotation", "translation", "point"):
        step = found[kind].step
        assert step is not None and 1e-9 <= step <= 1e-6, f"{kind}: {step}"
        assert found[kind].errors.min() < 1e-6
    for kind in ("f", "k1", "k2"):
        assert found[kind].linear and found[kind].step is None


def test_poses_alone_have_no_intrinsics() -> None:
    sphere = generate_sphere(SphereOptions(radius=5.0))
    problem = known_calibration(bal.to_problem(start_of(sphere)), bal.to_problem(truth_of(sphere)).start)
    assert [item.kind for item in step_search.search_steps(problem, "local")] == ["rotation", "translation", "point"]


@pytest.mark.parametrize("parameterisation", ["local", "global"])
def test_the_steps_in_use_are_those_found_on_ladybug(parameterisation: str, shared_data: Path) -> None:
    problem = bal.to_problem(bal.read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"))
    for item in step_search.search_steps(problem, parameterisation):
        assert item.step in (INC_STEPS[item.kind], None), f"{item.kind}: {item.step}"
        assert (item.step is None) == (item.kind in ("f", "k1", "k2"))


def test_the_command_prints_the_table(shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_data / "gtsam-dubrovnik-small" / "dubrovnik-3-7-pre.txt"
    assert main(["steps", str(path), "--parameterisation", "local"]) == 0
    output = capsys.readouterr().out
    assert output.startswith("local parameterisation")
    assert output.splitlines()[-2].split() == ["best", "1e-08", "1e-06", "linear", "linear", "linear", "1e-06"]
