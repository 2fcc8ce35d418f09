# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every command does its work once, and says in JSON what came of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from ba_node.cli.main import COMMANDS, main

# Words that do a command's work in little time, and what its JSON holds.
CASES = {
    "calibrate": ("{bag} --out {out}/rig.yaml --refine intrinsics", "parameters"),
    "check": ("{bag}", "sessions"),
    "convert": ("{bag} {out}/a.ply", "content"),
    "cut": ("{bag} --out {out}/cut.mcap", "messages"),
    "evaluate": ("{replay}/trajectory.tum {replay}/ground_truth.tum", "relative_translation_m"),
    "info": ("{bag}", "topics"),
    "map": ("info {replay}/map.npz", "keyframes"),
    "merge": ("{bag} --out {out}/merged.mcap", "mixed"),
    "params": ("", "window.max_keyframes"),
    "regress": ("{replay}/base.yaml", "figures"),
    "replay": ("{bag} --out {out}/again --no-report", "trajectory_error_m"),
    "report": ("{replay}", "page"),
    "rig": ("{bag}", "cameras"),
    "solve": ("{bal} --iterations 2", "trace"),
    "sweep": ("{bag} --out {out}/sweep --values window.max_keyframes=5,9", "combinations"),
    "synth": ("{out}/synth.mcap --keyframes 3", "tracks"),
    "thesis": ("--list", "exit_code"),
    "tune": ("{bag} --out {out}/tune --trials 2 --parameters window.max_keyframes", "trials"),
    "view": ("{bag} --port 0 --rounds 1 --rate 0", "messages"),
}
SLOW = {"calibrate", "report", "sweep", "tune"}
# What a command cannot do without, and may be missing where colcon has built the package.
LIBRARIES = {"tune": "optuna", "view": "foxglove"}
# What may take over two seconds, and so shows a bar where somebody looks; `ba solve` prints a line an iteration.
BARS = {"calibrate", "convert", "cut", "info", "merge", "regress", "replay", "report", "sweep", "tune"}
# Tried with a node, with images or for long in tests of their own.
ELSEWHERE = {"demo", "play", "record", "robustness", "run", "sphere", "steps", "track"}


@pytest.fixture(scope="module")
def replay(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a replay, with its map and a baseline."""
    out = tmp_path_factory.mktemp("replay")
    assert main(["replay", str(bag), "--out", str(out), "--no-report", "--save-map", str(out / "map.npz")]) == 0
    assert main(["regress", str(out / "base.yaml"), "--new", str(bag)]) == 0
    return out


def test_no_command_is_left_out() -> None:
    assert {*CASES, *ELSEWHERE} == set(COMMANDS)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in CASES])
def test_a_command_gives_json(
    name: str,
    bag: Path,
    bal_file: Path,
    replay: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if name in LIBRARIES:
        pytest.importorskip(LIBRARIES[name])
    line, holds = CASES[name]
    words = line.format(bag=bag, bal=bal_file, replay=replay, out=tmp_path).split()
    capsys.readouterr()
    code = main([name, *words, "--json", "-"])
    shown = capsys.readouterr()
    alone: dict[str, Any] = json.loads(shown.out)
    assert code in (0, 3), shown.err
    assert holds in alone, sorted(alone)
    assert "\r" not in shown.err, "a bar in a file"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert main([name, *words, "--json", str(tmp_path / "result.json")]) == code
    assert json.loads((tmp_path / "result.json").read_text()).keys() == alone.keys()
    shown = capsys.readouterr()
    assert shown.out, "without JSON on it, standard output has the text"
    assert (f"\r{name}: " in shown.err) == (name in BARS), shown.err


def test_a_folder_that_is_not_there_is_told_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["params", "--json", str(tmp_path / "no" / "file.json")]) == 2
    assert "there is no folder" in capsys.readouterr().err
