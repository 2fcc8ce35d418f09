# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the node says of its command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from ba_node.ros import arguments

PROGRAM = "ba_node"


def test_what_ros_knows_is_no_stranger() -> None:
    known = [PROGRAM, "--ros-args", "-p", "window.max_keyframes:=5", "--ros-args", "--log-level", "warn"]
    assert arguments.objection(known) == ""
    assert arguments.objection([PROGRAM]) == ""
    assert "argument 'bag.mcap' is not known" in arguments.objection([PROGRAM, "bag.mcap", *known[1:]])
    assert arguments.asks_for_help([PROGRAM, "-h"])
    assert not arguments.asks_for_help([PROGRAM, "--ros-args", "-p", "frames.map_frame:=--help"])


@pytest.mark.parametrize(
    ("section", "mine"),
    [
        ("/**:", True),
        ("/*/ba_node:", True),
        ("/robot/ba_node:", True),
        ("robot:\n ba_node:", True),
        ("robot/*:", True),
        ("/**/ba_node:", True),
        ("ba_node:", False),
        ("/*:", False),
        ("/robot/other:", False),
        ("/robot/ba_node/more:", False),
    ],
)
def test_a_file_in_which_nothing_is_for_the_node(tmp_path: Path, section: str, mine: bool) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(f"{section}\n  ros__parameters:\n    solver.threads: 2\n")
    told = arguments.idle_files([PROGRAM, "--ros-args", "--params-file", str(file)], "/robot/ba_node")
    assert bool(told) != mine, told
    assert mine or str(file) in told[0]


def test_an_empty_file_is_for_nobody(tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text("")
    (told,) = arguments.idle_files([PROGRAM, "--params-file", str(file)], "/ba_node")
    assert "has parameters for nobody and none for /ba_node" in told
