# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba rig`: what it shows, that forms become one another, and that a rig is published."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.io.rig_file import read_rig
from ba_node.ros import qos
from ba_node.ros.message_factory import message_class
from experiments.demo.domain import free_domain, isolation
from tests.io.test_rig_file import CAMCHAIN, INFO
from tests.messages.adapters import layouts
from tests.ros.harness import Peer

MakePeer = Callable[..., Any]


@pytest.fixture
def camchain(tmp_path: Path) -> Path:
    path = tmp_path / "camchain.yaml"
    path.write_text(CAMCHAIN)
    return path


def test_it_is_shown(camchain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rig", str(camchain)]) == 0
    shown = capsys.readouterr().out
    for words in ("body     imu", "752 x 480 px, fx 458.654", "0.110000 m from cam0", "plumb_bob [-0.283408,"):
        assert words in shown, shown


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ("plumb_bob", "banana", "banana"),
        ("[0,0,0,0,0]", "[0,0,1]", "3"),
        ("[0,0,0,0,0]", "[-90,0,0,0,0]", "folds over"),
    ],
)
def test_cameras_that_a_replay_turns_away_are_no_rig(
    right: str, wrong: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(INFO)
    assert main(["rig", str(path)]) == 0
    path.write_text(INFO.replace(right, wrong))
    assert main(["rig", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"ba: error: {path}: camera 0 ") and words in error


def test_forms_become_one_another(camchain: Path, tmp_path: Path) -> None:
    own, left, right, back = (tmp_path / name for name in ("own.yaml", "left.yaml", "right.yaml", "back.yaml"))
    assert main(["rig", str(camchain), "--to", "own", "--out", str(own)]) == 0
    assert main(["rig", str(own), "--to", "camera_info", "--out", str(left), str(right)]) == 0
    assert main(["rig", str(left), str(right), "--to", "kalibr", "--out", str(back)]) == 0
    first, last = read_rig(camchain), read_rig(back)
    assert np.allclose(first.intrinsics, last.intrinsics)
    assert np.linalg.norm(last.position[1] - last.position[0]) == pytest.approx(0.11, abs=1e-9)
    assert main(["rig", str(own), "--to", "camera_info", "--out", str(left)]) == 2


def test_a_recording_has_a_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = Path(__file__).resolve().parents[2]
    assert main(["rig", str(root / "bags" / "stereo_loop.mcap"), "--to", "own"]) == 0
    assert "frame_id: base_link" in capsys.readouterr().out
    data = layouts.scene(4)
    infos = [layouts.camera_info(data.rig, i, 0, name, rectified=True) for i, name in enumerate(("left", "right"))]
    infos[1].p[3] = -0.12 * infos[1].p[0]
    names = ("/left/camera_info", "/right/camera_info")
    sent = [layouts.Sent(topic, layouts.CAMERA_INFO, info, 1) for topic, info in zip(names, infos, strict=True)]
    bag = layouts.write(tmp_path / "bag", sent)
    assert main(["rig", str(bag), "--rectified"]) == 0
    assert "0.120000 m from left" in capsys.readouterr().out
    infos[0].p[3], infos[1].p[3] = infos[1].p[3], 0.0
    assert main(["rig", str(layouts.write(tmp_path / "swapped", sent))]) == 2
    assert "left and right are swapped" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.dds
def test_it_is_published(camchain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ba_msgs")
    for name, value in isolation(free_domain()).items():
        monkeypatch.setenv(name, value)
    command = [sys.executable, "-m", "ba_node.cli.main", "rig", str(camchain), "--publish", "--namespace", "robot"]
    peer = Peer()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ)) as process:
        assert process.stdout is not None
        # Who comes later gets it too.
        while "published on /robot/camera_rig" not in (line := process.stdout.readline()):
            assert line, "it ended"
        kind, got = message_class("ba_msgs/msg/CameraRig"), peer.received["camera_rig"]
        peer.node.create_subscription(kind, "/robot/camera_rig", got.append, qos.latched())
        peer.until(lambda: got, "the rig")
        assert (got[0].header.frame_id, len(got[0].cameras)) == ("imu", 2)
        process.send_signal(signal.SIGINT)
        peer.close()
    assert process.returncode == 130
