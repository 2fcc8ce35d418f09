# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What `ba track` and `ba run` say of recordings that are sound, and yet not what a user took them for."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.io.bag_reader import BagReader
from ba_node.io.rig_file import rig_yaml
from ba_node.measurements import Keyframe
from tests.front_end import world
from tests.messages.adapters import layouts

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")

FEW = ["--track", "max_features=200"]


def folder(path: Path, poses: list[Transform], sides: tuple[str, ...] = ("left", "right")) -> Path:
    """Write what a rig sees from each pose, by number; of one camera too, whose folder has no sides."""
    rig = world.rig(len(sides))
    for index, side in enumerate(sides):
        below = path / side if len(sides) > 1 else path
        below.mkdir(parents=True, exist_ok=True)
        for i, pose in enumerate(poses):
            cv2.imwrite(str(below / f"{i:06d}.png"), world.render(rig, index, pose).grey)
    (path / "rig.yaml").write_text(rig_yaml(rig, "own")[0])
    return path


def test_how_long_the_camera_stood_still(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    way = world.drive(6)
    source = folder(tmp_path / "source", way[:3] + 12 * way[2:3] + way[3:])
    assert main(["track", str(source), str(tmp_path / "out.mcap"), *FEW]) == 0
    text, errors = capsys.readouterr()
    assert "stood still" in text and "in 13 of 18 images, 1.2 s" in text and errors == ""


@pytest.mark.parametrize(
    ("sides", "code", "words"),
    [
        (("left", "right"), 3, "the camera did not move enough in 5 images (0.4 s) for a second keyframe"),
        (("left",), 2, "the camera did not move enough in 5 images (0.4 s) for a map to begin"),
    ],
)
def test_a_camera_that_never_moves(
    sides: tuple[str, ...], code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = folder(tmp_path / "source", 5 * world.drive(1), sides)
    assert main(["track", str(source), str(tmp_path / "out.mcap"), *FEW]) == code
    assert words in capsys.readouterr().err


def test_the_same_picture_twice_has_no_baseline(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = folder(tmp_path / "source", world.drive(8))
    for file in (source / "left").iterdir():
        (source / "right" / file.name).write_bytes(file.read_bytes())
    assert main(["track", str(source), str(tmp_path / "out.mcap"), *FEW]) == 3
    text, errors = capsys.readouterr()
    assert "first step, 1 long" in text and "the scale is free" in text and "baseline" not in text
    assert "are the same picture" in errors


def one_camera(path: Path, poses: list[Transform], ahead: range = range(0)) -> Path:
    """Write a recording of one camera and of an odometry beside it, whose stamps of some images are far ahead."""
    kind, (fx, fy, cx, cy), (width, height) = "sensor_msgs/msg/Image", world.rig(1).intrinsics[0], world.SIZE
    info = layouts.make(
        layouts.CAMERA_INFO, header=layouts.header(1, "cam"), width=width, height=height, distortion_model="plumb_bob",
        d=np.zeros(5), k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1]), r=np.eye(3).ravel(),
        p=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
    )  # fmt: skip
    sent = [layouts.Sent("/camera_info", layouts.CAMERA_INFO, info, 1)]
    for i, pose in enumerate(poses):
        stamp = 10**9 + i * world.STEP_NS + 10**15 * (i in ahead)
        image = layouts.make(
            kind, header=layouts.header(stamp, "cam"), width=width, height=height, encoding="mono8", step=width,
            data=world.render(world.rig(1), 0, pose).grey.ravel(),
        )  # fmt: skip
        odometry = layouts.odometry(stamp, "odom", pose.translation, geometry.quaternion_from_matrix(pose.rotation))
        sent.append(layouts.Sent("/odom", layouts.ODOMETRY, odometry, 10**9 * i))
        sent.append(layouts.Sent("/image_raw", kind, image, 10**9 * i))
    return layouts.write(path, sent)


def test_an_odometry_in_the_recording_is_named_where_the_scale_is_free(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["track", str(one_camera(tmp_path / "bag", world.drive(16, 0.1, 0.004))), str(tmp_path / "out.mcap"), *FEW]
    assert main(words) == 0
    assert "/odom (nav_msgs/Odometry): --topic odometry=/odom takes the scale from it" in capsys.readouterr().out
    assert main([*words, "--topic", "odometry=/odom"]) == 0
    text = capsys.readouterr().out
    assert "the odometry: one camera cannot tell" in text and "takes the scale" not in text


def test_tracks_are_written_in_the_order_of_tracking(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Stamps that run ahead for some images and go back: each session comes once, and the sound one is the result."""
    source, out = tmp_path / "bag", tmp_path / "tracks.mcap"
    one_camera(source, world.drive(24), ahead=range(10, 14))
    assert main(["track", str(source), str(out), "--topic", "odometry=/odom", *FEW]) == 3
    assert "4 of 24 images have stamps" in capsys.readouterr().err
    with BagReader(out) as reader:
        came = [(at, one) for _, at, one in reader.measurements()]
    keyframes = [one for _, one in came if isinstance(one, Keyframe)]
    assert [one.session_id for one in keyframes] == sorted(one.session_id for one in keyframes)
    assert keyframes[-1].session_id == 2 and keyframes[-1].stamp_ns < 10**10 < max(one.stamp_ns for one in keyframes)
    assert [at for at, _ in came] == sorted(at for at, _ in came)
    assert main(["replay", str(out), "--out", str(tmp_path / "run"), "--no-report"]) in (0, 3)
    text, errors = capsys.readouterr()
    assert "session_1" in text and "restarts" not in errors and "stale" not in errors


def test_what_is_wrong_with_the_images_is_said_once_and_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = folder(tmp_path / "source", 5 * world.drive(1))
    words = ["run", str(source), "--out", str(tmp_path / "out"), "--no-report", *FEW]
    assert main(words) == 3
    errors = capsys.readouterr().err
    assert errors.splitlines()[-1].startswith("ba: warning: tracking: the camera did not move enough")
    assert errors.count("the camera did not move") == 1
    assert main([*words, "--set", "solver.none=1"]) == 2  # what comes after tracking fails
    assert capsys.readouterr().err.count("ba: warning: tracking: the camera did not move") == 1
