# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The examples run, and what the pages show is out of them. Those of front-ends run in tests/ros/tools."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from ba_node.cli.main import main
from ba_node.io.bal import read_bal, to_problem, write_bal
from ba_node.io.trajectory import read_tum
from tests.cli.conftest import make_bal

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"


def run(name: str, *arguments: object) -> list[str]:
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


@pytest.mark.parametrize(("page", "language"), [("docs/front_end.md", "python"), ("docs/front_end.md", "cpp")])
def test_pages_show_code_that_runs(page: str, language: str) -> None:
    (block,) = re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    suffix = {"python": "py", "cpp": "cpp"}[language]
    assert str(block) in (EXAMPLES / f"front_end.{suffix}").read_text(), f"{page} and examples/ have drifted apart"
    assert len([line for line in block.splitlines() if line.strip()]) <= 40, "short enough to be read at a glance"


def test_every_example_is_in_the_readme() -> None:
    readme = (ROOT / "README.md").read_text()
    names = [path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".cpp")]
    assert len(names) == 4
    assert [name for name in names if f"examples/{name}" not in readme] == []


def test_replay_gives_what_the_command_gives(tmp_path: Path) -> None:
    bag = ROOT / "bags" / "mono_loop.mcap"
    lines = run("replay.py", bag)
    assert main(["replay", str(bag), "--out", str(tmp_path), "--set", "window.max_keyframes=15", "--no-report"]) == 0
    written = read_tum(tmp_path / "trajectory.tum").position.tolist()
    told = [re.findall(r"-?[0-9.]+", line.partition(" to ")[2]) for line in lines if line.startswith("keyframe ")]
    assert len(told) == len(written) == 40
    for one, other in zip(told, written, strict=True):
        assert [float(value) for value in one] == pytest.approx(other, abs=6e-4)
    assert sum(line.startswith("solve ") for line in lines) == 40


def test_solve_bal_writes_the_solution(tmp_path: Path) -> None:
    write_bal(tmp_path / "four.txt", make_bal())
    lines = run("solve_bal.py", tmp_path / "four.txt", tmp_path / "refined.txt")
    assert lines[-1].startswith("CONVERGED: ")
    assert to_problem(read_bal(tmp_path / "refined.txt")).start.is_finite()
    before, after = (float(line.split()[2]) for line in (lines[0], lines[-2]))
    assert after < 1e-12 * before, "the problem has an exact solution"
