# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replays of recordings whose cameras are those of a part of a sensor, or none that can be used."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.config import Config
from ba_node.io.bag_writer import BagWriter
from ba_node.io.reference import TRUTH_TOPIC
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.messages.conversion import input_message
from ba_node.messages.topics import INPUT_TYPES
from ba_node.offline.recording import TRUTH_TYPE, _true_pose
from ba_node.offline.replay import replay
from experiments.synthetic import SyntheticOptions, generate

F = ROSBAGS_FACTORY


def record_with(path: Path, change: Callable[[Any], None], lone: bool = False, **options: Any) -> Path:
    """Write a recording whose CameraInfo messages are changed; ``lone`` for camera_info instead of a rig."""
    base: dict[str, Any] = {"keyframes": 25, "landmarks": 1500, "tracks": 100, "length_m": 12.0, "seed": 2}
    if lone:
        base |= {"baseline_m": 0.0, "drift_translation": 0.01}
    data = generate(SyntheticOptions(**{**base, **options}))
    rows = {int(key): row for row, key in enumerate(data.truth.keyframe_id)}
    with BagWriter(path) as bag:
        for topic, stamp, m in data.timeline():
            if isinstance(m, CameraRig):
                message = input_message(F, m, stamp)[1]
                for info in message.cameras:
                    change(info)
                if lone:
                    bag.write("camera_info", INPUT_TYPES["camera_info"], message.cameras[0], stamp, latched=True)
                    continue
            elif isinstance(m, Keyframe):
                bag.write(TRUTH_TOPIC, TRUTH_TYPE, _true_pose(data.truth, rows[m.keyframe_id], "odom"), stamp)
                message = input_message(F, m)[1]
            elif isinstance(m, LandmarkGuesses):
                message = input_message(F, m, stamp, "odom")[1]
            else:
                assert isinstance(m, FeatureTracks)
                message = input_message(F, m, stamp, "camera")[1]
            bag.write(topic, INPUT_TYPES[topic], message, stamp, latched=isinstance(m, CameraRig))
    return path


def sensor_of(info: Any) -> None:
    """Say the same camera as the middle part of a larger sensor, its pixels binned 2 x 2."""
    info.k = (np.array(info.k).reshape(3, 3) * [[2], [2], [1]]).ravel()
    info.k[2] += 320
    info.k[5] += 200
    info.roi = dataclasses.replace(
        info.roi, x_offset=320, y_offset=200, width=2 * info.width, height=2 * info.height, do_rectify=False
    )
    info.width, info.height = 2 * info.width + 640, 2 * info.height + 400
    info.binning_x = info.binning_y = 2


def nothing(_info: Any) -> None:
    pass


@pytest.mark.slow
def test_region_and_binning_give_the_same_map(tmp_path: Path) -> None:
    plain = replay(record_with(tmp_path / "plain.mcap", nothing), tmp_path / "plain", Config())
    part = replay(record_with(tmp_path / "part.mcap", sensor_of), tmp_path / "part", Config())
    assert part["trajectory_error_m"]["refined"] == pytest.approx(plain["trajectory_error_m"]["refined"], rel=1e-6)
    assert plain["trajectory_error_m"]["refined"] < 0.5 * plain["trajectory_error_m"]["input"]
    assert part["notices"] == {**plain["notices"], "adjusted_camera": 2}
    assert part["attention"] == []


def wrong(**fields: Any) -> Callable[[Any], None]:
    def change(info: Any) -> None:
        for name, value in fields.items():
            setattr(info, name, value)

    return change


BAD = [
    (wrong(distortion_model="fisheye62"), "distortion_model 'fisheye62' is not supported: choose"),
    (wrong(d=np.ones(3)), "plumb_bob has 3 coefficients, expected 0 or 4 or 5"),
    (wrong(k=np.zeros(9)), "k is all zero, which says that the camera is not calibrated"),
    (wrong(binning_x=5000), "binning 5000 x 1"),
    (wrong(d=np.array([-3.0, 0.0, 0.0, 0.0])), "the distortion folds over"),
]


@pytest.mark.parametrize("lone", [False, True])
@pytest.mark.parametrize(("change", "words"), BAD)
def test_a_camera_that_is_refused_is_named_and_ends_with_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Any], None], words: str, lone: bool
) -> None:
    bag = record_with(tmp_path / "in.mcap", change, lone, keyframes=4)
    assert main(["replay", str(bag), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "camera 0" in error
    assert "never came" not in error
    assert not (tmp_path / "out" / "report.json").exists()


def test_a_distortion_that_folds_far_out_is_a_warning(tmp_path: Path) -> None:
    def change(info: Any) -> None:
        sensor_of(info)
        info.d = np.array([-0.42, 0.0, 0.0, 0.0])

    report = replay(record_with(tmp_path / "in.mcap", change, keyframes=4), tmp_path / "out", Config())
    assert "camera 0" in report["warnings"]["distortion_folds"] or "camera 1" in report["warnings"]["distortion_folds"]
