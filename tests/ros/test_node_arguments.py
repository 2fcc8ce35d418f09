# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("-p", "window.max_keyfames:=5"), "did you mean 'window.max_keyframes'"),
        (("-p", "window.max_keyframes:=0"), "expected a number in [2, 100000]"),
        (("-p", "solver.loss:=cubic"), "choose one of squared, huber"),
        (("-p", "window.max_keyframes:=[]"), "expected int"),
        (("-r", "__ns:=9 lives"), "9 lives"),
        (("--params-file", "no/such/file.yaml"), "no/such/file.yaml"),
        (("--nonsense",), "--nonsense"),
        (("--", "-p", "window.max_keyframes:=30"), "argument '-p' is not known; parameters follow --ros-args"),
    ],
)
def test_wrong_arguments_end_with_one_line(start_node: StartNode, arguments: tuple[str, ...], words: str) -> None:
    node = start_node("--ros-args", *arguments)
    assert node.wait() == 2, node.err
    own = [line for line in node.err.splitlines() if "[rcl]" not in line]
    assert len(own) == 1, node.err
    assert words in own[0]
    assert "Traceback" not in node.err


@pytest.mark.slow
def test_help_is_given_and_a_file_for_another_node_is_told(start_node: StartNode, tmp_path: Any) -> None:
    node = start_node("--help")
    assert node.wait() == 0, node.err
    assert node.out.startswith("usage: ba_node [--ros-args [-p NAME:=VALUE]")
    file = tmp_path / "params.yaml"
    file.write_text("ba_nod:\n  ros__parameters:\n    window.max_keyframes: 4\n")
    node = start_node("--ros-args", "--params-file", str(file), "-r", "__ns:=/car")
    while "activate: done" not in node.out + node.err:
        assert node.alive, node.err
        time.sleep(0.05)
    assert f"{file} has parameters for /ba_nod and none for /car/ba_node: nothing of it is used" in node.err
    assert node.stop() == 0
