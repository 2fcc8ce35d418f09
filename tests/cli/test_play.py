# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of `ba play`; how it plays is tested in tests/ros."""

from __future__ import annotations

from pathlib import Path

import pytest

from ba_node.cli.main import main

pytest.importorskip("ba_msgs")


@pytest.mark.dds
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rate", "-1"], "--rate -1: expected a finite number, 0 or more"),
        (["--namespace", "bad name"], "bad name"),
        (["--remap", "nonsense"], "nonsense"),
        (["--topics", "/nope"], "no topic can be played; topics in the recording: /camera_rig"),
    ],
)
def test_bad_options_are_one_line(
    options: list[str], words: str, bag: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    assert main(["play", str(bag), "--wait", "0", *options]) == 2
    # ROS itself may have written a line of its log before.
    error = capfd.readouterr().err.splitlines()[-1]
    assert error.startswith("ba: error: ")
    assert words in error


@pytest.mark.dds
def test_what_was_played_is_counted(
    bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    options = ["--wait", "0", "--rate", "0", "--namespace", "robot", "--remap", "keyframes:=front/keyframes"]
    assert main(["play", str(bag), *options]) == 0
    output = capsys.readouterr()
    assert "/robot/front/keyframes: 8 messages\n" in output.out
    assert "/robot/feature_tracks: 16 messages\n" in output.out
    assert "nobody listens to" in output.err
