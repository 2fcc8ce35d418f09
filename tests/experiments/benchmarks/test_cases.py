# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Problems of the benchmarks, and a whole quick run with ba_node alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem
from experiments.benchmarks.floor import work
from experiments.benchmarks.generators import loop, sphere, window
from experiments.benchmarks.problem_file import Case, case_problem, read_case, read_state, write_case, write_state
from experiments.benchmarks.process import objective

ROOT = Path(__file__).resolve().parents[3]


def rms_px(problem: Problem) -> float:
    errors = Objective(problem, SolverOptions()).errors(problem.start)
    assert np.isfinite(errors).all(), "a point starts behind its camera"
    return float(np.sqrt(np.mean(errors**2)))


@pytest.mark.parametrize(
    ("case", "cameras", "points", "observations", "size", "fixed"),
    [
        (window(20), 20, 1500, 15000, 6, 2),
        (window(5), 5, 375, 1875, 6, 2),
        (loop(200, 2000), 200, 2000, 14974, 9, 0),
        (sphere("10-253"), 10, 253, 1334, 9, 0),
    ],
)
def test_generated_problems(case: Case, cameras: int, points: int, observations: int, size: int, fixed: int) -> None:
    problem = case_problem(case)
    problem.check()
    obs = problem.observations
    found = (problem.n_keyframes, problem.n_points, len(obs), case.size, int(problem.fixed.sum()))
    assert found == (cameras, points, observations, size, fixed)
    assert problem.free_intrinsics == (size == 9)
    pairs = obs.point * problem.n_keyframes + obs.keyframe
    assert len(np.unique(pairs)) == len(pairs), "a point is seen twice by one camera"
    assert np.bincount(obs.point).min() >= 2
    assert 2.0 < rms_px(problem) < 100.0, f"the start is off by {rms_px(problem):.3g} px"


def test_a_case_survives_its_file(tmp_path: Path) -> None:
    case = window(5)
    write_case(tmp_path / "case.bin", case)
    again = read_case(tmp_path / "case.bin")
    assert (again.n_fixed, again.size) == (case.n_fixed, case.size)
    for name in ("cameras", "points", "camera_index", "point_index", "observations"):
        np.testing.assert_array_equal(getattr(again.bal, name), getattr(case.bal, name))
    write_state(tmp_path / "state.bin", case.bal.cameras, case.bal.points + 1.0)
    np.testing.assert_array_equal(read_state(tmp_path / "state.bin", case).bal.points, case.bal.points + 1.0)
    with pytest.raises(ValueError, match="not a problem"):
        read_case(tmp_path / "state.bin")


def test_fixed_intrinsics_give_the_same_objective_as_free_ones() -> None:
    case = loop(50, 500)
    held = Case(case.bal, case.n_fixed, 6)
    assert objective(held, "huber") == pytest.approx(objective(case, "huber"), rel=1e-12)


def test_flops_of_the_window_are_those_counted_by_hand() -> None:
    flops, _ = work(window(20))
    # 55 pairs of a point are the larger part: 1500 x 55 x 216 = 17.8 MFLOP less those with the two fixed cameras.
    assert 18e6 < flops < 30e6, f"{flops / 1e6:.1f} MFLOP"


@pytest.mark.slow
def test_quick_runs_with_ba_node_alone(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "experiments.benchmarks",
        "--quick",
        "--solvers",
        "ba_node",
        "ba_node numpy",
        "--repeats",
        "1",
    ]
    command += ["--work", str(tmp_path / "work"), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    names = [problem["problem"] for problem in summary["problems"]]
    assert names == ["window-20 huber", "window-5 huber"]
    for problem in summary["problems"]:
        for name, row in problem["solvers"].items():
            assert isinstance(row["gap 1e-04"], float), f"{name} never came within 0.01 %: {row}"
            assert row["final"] < problem["f_start"] / 5
    for name in ("report.md", "runs.json", "profiles.png"):
        assert (tmp_path / "out" / name).stat().st_size > 0


def test_an_unknown_problem_is_named() -> None:
    command = [sys.executable, "-m", "experiments.benchmarks", "--problems", "nowhere"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2 and "no problem is called 'nowhere'" in done.stderr


def test_that_no_data_was_found_is_said(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "experiments.benchmarks", "--problems", "ladybug", "--solvers", "ba_node"]
    command += ["--data", str(tmp_path), "--work", str(tmp_path / "work"), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2 and done.stderr.startswith("benchmarks: nothing was run"), done.stderr
    assert not (tmp_path / "out").exists()
