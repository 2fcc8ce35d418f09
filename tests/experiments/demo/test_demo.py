# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The demo from end to end: node, player and listener in three processes."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from ba_node.cli.main import main
from ba_node.io.trajectory import read_tum
from tests.ply import read_ply

pytest.importorskip("ba_msgs")
demo = pytest.importorskip("experiments.demo.demo", reason="needs ROS 2")

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.dds
@pytest.mark.slow
def test_demo_improves_the_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, output = main(["demo", "--out", str(tmp_path)]), capsys.readouterr()
    assert code == 0, output.out + output.err
    error = {
        name: float(re.search(rf"translation {name} \[m\]\s+(\S+)", output.out)[1])  # type: ignore[index]
        for name in ("before", "after")
    }
    assert error["after"] < 0.25 * error["before"], output.out
    assert "60 of 60 came back refined" in output.out
    assert len(read_tum(tmp_path / "trajectory.tum")) == 60
    assert len(read_tum(tmp_path / "ground_truth.tum")) == 60
    points, frame = read_ply(tmp_path / "points.ply")
    assert (len(points) > 500, frame) == (True, "map")
    assert (tmp_path / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    assert "stopped: 60 keyframes refined" in (tmp_path / "node.log").read_text(), "the node ends by SIGINT"


def test_recording_without_truth_is_refused(
    tmp_path: Path, shared_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = shared_data / "kitti-stereo-vo" / "kitti_stereo.mcap"
    assert main(["demo", "--out", str(tmp_path), "--bag", str(bag)]) == 2
    error = capsys.readouterr().err
    assert "no keyframes with ground_truth/pose" in error
    assert error.count("\n") == 1


@pytest.mark.dds
def test_a_node_that_fails_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = tmp_path / "broken_node.py"
    module.write_text("import sys\nprint('no such luck')\nsys.exit(3)\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{ROOT}")
    monkeypatch.setattr(demo, "NODE_MODULE", "broken_node")
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(name, os.environ.get(name, ""))
    with pytest.raises(demo.DemoError, match=r"broken_node ended with code 3: .*node.log: no such luck"):
        demo.run(ROOT / "bags" / "stereo_loop.mcap", tmp_path / "out", lambda _: None)
