# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings in the layouts of other front-ends, by `ba convert --from`, all the way to refined keyframes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.estimate import Poses
from ba_node.io.bag_reader import BagReader
from ba_node.io.rig_file import rig_yaml
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.messages.adapters import SOURCES
from experiments.synthetic import SyntheticData
from tests.messages.adapters import layouts

EVERY = {"openvins": 12, "vins_fusion": 9, "vins_mono": 5, "rtabmap": 12, "rtabmap_map": 12}


@pytest.mark.parametrize("source", sorted(SOURCES))
def test_every_keyframe_is_refined(source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = layouts.scene(12, "none" if source.startswith("rtabmap") else "plumb_bob")
    bag = layouts.write(tmp_path / "bag", getattr(layouts, source)(data))
    out = tmp_path / "out.mcap"
    # What has mapData alone is found by the name of its package too.
    assert main(["convert", str(bag), str(out), "--from", source.removesuffix("_map")]) == 0
    assert f"{EVERY[source]} keyframes of" in capsys.readouterr().out
    assert main(["replay", str(out), "--out", str(tmp_path / "replay"), "--no-report"]) == 0
    report = json.loads((tmp_path / "replay" / "report.json").read_text())
    assert report["keyframes_refined"] == report["keyframes"] == EVERY[source]
    assert report["rms_px"]["refined"] < 0.32, report["rms_px"]


def test_few_keyframes_of_an_optical_frame_on_a_body_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five are few for a check, but all are off by 90 degrees; without a check the result explains little."""
    data = layouts.scene(12, "plumb_bob")
    rig = dataclasses.replace(data.rig, orientation=np.tile([0.0, 0.0, 0.0, 1.0], (len(data.rig), 1)))
    bag, out = layouts.write(tmp_path / "bag", layouts.vins_mono(dataclasses.replace(data, rig=rig))), tmp_path / "out"
    assert main(["convert", str(bag), f"{out}.mcap", "--from", "vins_mono"]) == 0
    replay = ["replay", f"{out}.mcap", "--out", str(out), "--no-report"]
    assert main(replay) == 3
    assert "optical and body axes confused" in capsys.readouterr().err
    assert main([*replay, "--set", "guard.check_setup=false"]) == 3
    assert "explains little of what was observed" in capsys.readouterr().err


def real_drive(path: Path) -> SyntheticData:
    """Return what a recording of a real stereo odometry holds as if it had been made up."""
    with BagReader(path) as reader:
        found = [measurement for _, _, measurement in reader.measurements()]
    (rig,) = [one for one in found if isinstance(one, CameraRig)]
    keyframes = tuple(one for one in found if isinstance(one, Keyframe))
    tracks = [one for one in found if isinstance(one, FeatureTracks)]
    by_keyframe = tuple(
        tuple(sorted((t for t in tracks if t.keyframe_id == k.keyframe_id), key=lambda t: t.camera_index))
        for k in keyframes
    )
    guesses = [one for one in found if isinstance(one, LandmarkGuesses)]
    ids = np.concatenate([one.track_id for one in guesses])
    points = np.concatenate([one.position for one in guesses])
    poses = Poses.of(keyframes)
    return SyntheticData(rig, keyframes, by_keyframe, (None,) * len(keyframes), poses, points, ids, np.arange(len(ids)))


@pytest.mark.slow
@pytest.mark.parametrize("source", ["openvins", "vins_fusion", "rtabmap", "rtabmap_map"])
def test_a_real_drive_in_each_layout(source: str, shared_data: Path, tmp_path: Path) -> None:
    """KITTI, 26 keyframes, left camera alone with the odometry's steps; ids below 2^24 as they are there."""
    data = real_drive(shared_data / "kitti-stereo-vo" / "kitti_stereo.mcap")
    options: dict[str, dict[str, Any]] = {
        "rtabmap": {"added": 10**6},
        "vins_fusion": {"late": 0},
        "rtabmap_map": {"stereo": True},
    }
    bag = layouts.write(tmp_path / "bag", getattr(layouts, source)(data, **options.get(source, {})))
    out = tmp_path / "out.mcap"
    assert main(["convert", str(bag), str(out), "--from", source, "--parallax", "0"]) == 0
    assert main(["replay", str(out), "--out", str(tmp_path / "replay"), "--no-report"]) == 0
    report = json.loads((tmp_path / "replay" / "report.json").read_text())
    assert report["keyframes_refined"] == report["keyframes"] == 26
    assert report["rms_px"]["refined"] < 0.4, report["rms_px"]


def test_the_last_calibration_is_taken(tmp_path: Path) -> None:
    messages = list(layouts.openvins(layouts.scene(6)))
    for sent in messages[:-8]:
        if sent.topic.endswith("intrinsics"):
            sent.message.k[0] *= 1.05
    bag = layouts.write(tmp_path / "bag", messages)
    out = tmp_path / "out.mcap"
    assert main(["convert", str(bag), str(out), "--from", "openvins"]) == 0
    with BagReader(out) as reader:
        topic, _, _, data = next(reader.messages(["/camera_rig"]))
        k = reader.decode(topic, data).cameras[0].k
    assert k[0] == pytest.approx(layouts.scene(6).rig.intrinsics[0, 0], rel=1e-9)


def test_without_local_bundle_adjustment_the_rig_is_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = layouts.scene(12, "none")
    bag = layouts.write(tmp_path / "bag", layouts.rtabmap(data, bundle=False))
    out, rig = tmp_path / "out.mcap", tmp_path / "rig.yaml"
    assert main(["convert", str(bag), str(out), "--from", "rtabmap"]) == 2
    assert "give it as YAML (--rig FILE)" in capsys.readouterr().err
    assert not out.exists()
    rig.write_text(rig_yaml(data.rig)[0])
    assert main(["convert", str(bag), str(out), "--from", "rtabmap", "--rig", str(rig)]) == 0


def test_topics_of_other_names_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    renamed = [
        sent._replace(topic=sent.topic.replace("keyframe_pose", "kf")) for sent in layouts.vins_fusion(layouts.scene())
    ]
    bag = layouts.write(tmp_path / "bag", renamed)
    command = ["convert", str(bag), str(tmp_path / "out.mcap"), "--from", "vins_fusion"]
    assert main(command) == 2
    assert "no keyframe_pose (nav_msgs/msg/Odometry): say --topic keyframe_pose=TOPIC" in capsys.readouterr().err
    assert main([*command, "--topic", "keyframe_pose=/vins_estimator/kf"]) == 0
    assert main([*command, "--topic", "keyframe_pose"]) == 2


def test_nothing_that_can_be_used_leaves_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    messages = list(layouts.vins_fusion(layouts.scene(), apart_ns=5_000_000))
    bag = layouts.write(tmp_path / "bag", messages)
    command = ["convert", str(bag), str(tmp_path / "out.mcap"), "--from", "vins_fusion"]
    assert main(command) == 2
    words = capsys.readouterr().err
    assert "no keyframe comes of 9 images" in words and "no_pose = 9" in words
    assert not (tmp_path / "out.mcap").exists()
    assert main([*command, "--tolerance", "0.01"]) == 0


def test_faults_of_the_recording_are_in_the_exit_code(tmp_path: Path) -> None:
    messages = list(layouts.openvins(layouts.scene(6)))
    messages[3].message.channels[0].values = np.zeros(2, np.float32)
    bag = layouts.write(tmp_path / "bag", messages)
    assert main(["convert", str(bag), str(tmp_path / "out.mcap"), "--from", "openvins"]) == 3


def test_stamps_that_are_all_alike_are_in_the_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sent = list(layouts.openvins(layouts.scene(6)))
    for one in sent:
        one.message.header.stamp.sec = one.message.header.stamp.nanosec = 0
    bag = layouts.write(tmp_path / "bag", sent)
    assert main(["convert", str(bag), str(tmp_path / "out.mcap"), "--from", "openvins"]) == 3
    assert "repeated_keyframe = 5 (keyframe 0 came again)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--tolerance", "nan"], "--tolerance nan: expected a number, 0 or more"),
        (["--parallax", "-1"], "--parallax -1: expected"),
        (["--cameras", "-2"], "--cameras -2: expected"),
        (["--topic", "loop_pos=/pose"], "--topic loop_pos: openvins has no such input; it has: loop_extrinsic"),
    ],
)
def test_options_that_mean_nothing_are_said(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = layouts.write(tmp_path / "bag", layouts.openvins(layouts.scene(6)))
    assert main(["convert", str(bag), str(tmp_path / "out.mcap"), "--from", "openvins", *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
