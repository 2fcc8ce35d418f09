# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""From pictures to a recording and to a map: folders, the command line, and a real car."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.evaluation.metrics import absolute_error
from ba_node.io.bag_reader import BagReader
from ba_node.io.rig_file import rig_yaml
from ba_node.io.trajectory import read_tum
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from tests.front_end import world
from tests.messages.adapters import layouts

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")

IMAGE = "sensor_msgs/msg/Image"


def write_pictures(folder: Path, poses: list[Transform]) -> None:
    """Write a folder as ``ba track`` reads it, with the truth as KITTI has it."""
    rig = world.rig()
    for name in ("left", "right"):
        (folder / name).mkdir(parents=True)
    for i, pose in enumerate(poses):
        for index, name in enumerate(("left", "right")):
            cv2.imwrite(str(folder / name / f"{i:06d}.png"), world.render(rig, index, pose).grey)
    (folder / "rig.yaml").write_text(rig_yaml(rig, "own")[0])
    rows = [np.column_stack([pose.rotation, pose.translation]).reshape(-1) for pose in poses]
    np.savetxt(folder / "poses.txt", rows)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    write_pictures(folder, world.drive(12))
    return folder


@pytest.mark.slow
def test_pictures_become_a_map(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    found = tmp_path / "found.json"
    options = ["--no-report", "--track", "max_features=300", "--json", str(found)]
    assert main(["run", str(pictures), "--out", str(out), *options]) == 0
    assert json.loads(found.read_text())["exit_codes"] == {"track": 0, "check": 0, "replay": 0}
    text, errors = capsys.readouterr()
    assert "12, stereo" in text
    assert "error to ground truth" in text
    assert errors == ""
    error = absolute_error(read_tum(out / "trajectory.tum"), read_tum(out / "ground_truth.tum"))
    assert error.translation.rmse < 0.01, f"{error.translation.rmse:.4f} m"
    with BagReader(out / "tracks.mcap") as reader:
        kinds = [type(one) for _, _, one in reader.measurements()]
    assert kinds[0] is CameraRig
    assert kinds.count(FeatureTracks) == 2 * kinds.count(Keyframe) >= 6


def test_the_same_pictures_give_the_same_bytes(pictures: Path, tmp_path: Path) -> None:
    options = ["--track", "max_features=200"]
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap")]
    for path in paths:
        assert main(["track", str(pictures), str(path), *options]) == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.slow
def test_mask_and_odometry_file(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = tmp_path / "one"
    one.mkdir()
    for file in (pictures / "left").iterdir():
        (one / file.name).write_bytes(file.read_bytes())
    (one / "rig.yaml").write_text(rig_yaml(world.rig(1), "own")[0])
    mask = np.full(world.SIZE[::-1], 255, np.uint8)
    mask[:, :100] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    lines = [
        " ".join(map(str, [0.1 * i, *pose.translation, *geometry.quaternion_from_matrix(pose.rotation)]))
        for i, pose in enumerate(world.drive(12))
    ]
    (tmp_path / "odometry.tum").write_text("\n".join(reversed(lines)))
    out = tmp_path / "mono.mcap"
    words = ["track", str(one), str(out), "--mask", str(tmp_path / "mask.png")]
    assert main([*words, "--odometry", str(tmp_path / "odometry.tum")]) == 0
    assert "one camera without odometry" not in capsys.readouterr().out
    with BagReader(out) as reader:
        tracks = [one for _, _, one in reader.measurements() if isinstance(one, FeatureTracks)]
    assert min(one.uv[:, 0].min() for one in tracks) > 99.0
    assert main(words) in (0, 3)
    assert "the scale is free" in capsys.readouterr().out


@pytest.mark.slow
def test_an_odometry_in_millimetres_is_said_last_and_in_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        " ".join(map(str, [0.1 * i, *(1000.0 * pose.translation), *geometry.quaternion_from_matrix(pose.rotation)]))
        for i, pose in enumerate(world.drive(24))
    ]
    (tmp_path / "odometry.tum").write_text("\n".join(lines))
    source, out = tmp_path / "pictures", tmp_path / "out"
    write_pictures(source, world.drive(24))
    assert (
        main(["run", str(source), "--out", str(out), "--no-report", "--odometry", str(tmp_path / "odometry.tum")]) == 3
    )
    errors = capsys.readouterr().err
    last = errors.splitlines()[-1]
    assert errors.count(last.removeprefix("ba: warning: tracking: ")) == 1
    assert last.startswith("ba: warning: tracking: the odometry's steps are") and "millimetres" in last
    told = json.loads((out / "report.json").read_text())["tracking"]
    assert told["causes"]["odometry_unit"] >= 1 and told["states"] == {"tracking": 24}


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--track", "max_feature=3"], "did you mean 'max_features'"),
        (["--track", "max_features=3"], "expected a number in [50, 10000]"),
        (["--rate", "0"], "--rate 0: expected images a second"),
        (["--mask", "nowhere.png"], "nowhere.png: no picture that can be read"),
    ],
)
def test_wrong_options(
    pictures: Path, tmp_path: Path, extra: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["track", str(pictures), str(tmp_path / "x.mcap"), *extra]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_black_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.yaml").write_text(rig_yaml(world.rig(1), "own")[0])
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros(world.SIZE[::-1], np.uint8))
    assert main(["track", str(tmp_path), str(tmp_path / "x.mcap")]) == 2
    assert "no keyframe came of 3 images" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "text", "words", "code"),
    [
        ("calib.txt", "P0: no numbers", "calib.txt: 0 rows of 12 numbers", 2),
        ("calib.txt", "P0:" + " x" * 12, "could not convert string to float: 'x'", 2),
        (
            "calib.txt",
            f"P0: {' '.join(['400 0 300 0 0 400 240 0 0 0 1 0'])}",
            "check that its calibration is of this",
            3,
        ),
        ("times.txt", "0.0\nlater\n" + "1.0\n" * 10, "'later': expected a time at the beginning of each line", 2),
        ("times.txt", "0.0\n0.1", "2 lines for 12 pictures", 2),
    ],
)
def test_files_beside_pictures_that_cannot_be(
    pictures: Path, tmp_path: Path, file: str, text: str, words: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """One clear line each; a calibration of larger images is used, and said."""
    for one in (pictures / "left").iterdir():
        (tmp_path / one.name).write_bytes(one.read_bytes())
    if file != "calib.txt":
        (tmp_path / "rig.yaml").write_text(rig_yaml(world.rig(1), "own")[0])
    (tmp_path / file).write_text(text)
    assert main(["track", str(tmp_path), str(tmp_path / "x.mcap")]) == code
    assert words in capsys.readouterr().err


def segments(estimate: Path, truth: Path) -> tuple[float, float]:
    """Return the mean error of segments of 10 to 40 m as a share of them (KITTI), and the scale of the whole (sim3)."""
    ours, theirs = read_tum(estimate), read_tum(truth)
    assert np.array_equal(ours.stamp_ns, theirs.stamp_ns)
    a, b = (
        [Transform(r, p) for r, p in zip(geometry.matrix_from_quaternion(one.orientation), one.position, strict=True)]
        for one in (ours, theirs)
    )
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(theirs.position, axis=0), axis=1))])
    errors = []
    for length in (10.0, 20.0, 30.0, 40.0):
        found = []
        for i in range(len(a)):
            j = int(np.searchsorted(way, way[i] + length))
            if j < len(a):
                true, told = b[i].inverse().after(b[j]), a[i].inverse().after(a[j])
                found.append(float(np.linalg.norm(true.inverse().after(told).translation)) / length)
        errors.append(np.mean(found))
    return float(np.mean(errors)), absolute_error(ours, theirs, "sim3").alignment.scale


@pytest.mark.slow
def test_real_car(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shared_data / "kitti-stereo-images"
    assert main(["run", str(folder), "--out", str(tmp_path), "--no-report"]) == 0
    assert capsys.readouterr().err == ""
    error, scale = segments(tmp_path / "trajectory.tum", tmp_path / "ground_truth.tum")
    assert error < 0.008, f"{100 * error:.2f} % of segments of 10 to 40 m"
    assert abs(scale - 1.0) < 0.006, f"scale {scale:.4f}"


@pytest.mark.slow
def test_left_camera_of_a_real_car_with_the_true_steps(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Refined poses stay at those that were given, to what one camera's directions are off."""
    data, folder, out = shared_data / "kitti-stereo-images", tmp_path / "left", tmp_path / "out"
    folder.mkdir()
    for file in (data / "image_l").iterdir():
        (folder / file.name).symlink_to(file)
    for name in ("calib.txt", "poses.txt"):
        (folder / name).symlink_to(data / name)
    rows = np.loadtxt(data / "poses.txt")[:, :12].reshape(-1, 3, 4)
    turns = geometry.quaternion_from_matrix(geometry.nearest_rotation(rows[:, :, :3]))
    lines = [
        " ".join(map(str, [0.1 * i, *row[:, 3], *turn])) for i, (row, turn) in enumerate(zip(rows, turns, strict=True))
    ]
    (tmp_path / "odometry.tum").write_text("\n".join(lines))
    tracks = tmp_path / "tracks.mcap"
    assert main(["track", str(folder), str(tracks), "--odometry", str(tmp_path / "odometry.tum")]) == 0
    assert "51, mono" in capsys.readouterr().out
    assert main(["replay", str(tracks), "--out", str(out), "--final-optimize", "--no-report"]) == 0
    error, scale = segments(out / "trajectory.tum", out / "ground_truth.tum")
    assert 0.0 < error < 0.007, f"{100 * error:.2f} % of segments of 10 to 40 m"
    assert abs(scale - 1.0) < 0.002, f"scale {scale:.4f}"


def recording(path: Path, stamps: list[tuple[int, int]], poses: list[Transform]) -> Path:
    """Write colour images of a stereo rig, with camera_info that tells the baseline in p; stamps (ns), poses."""
    rig, sent = world.rig(), []
    fx, fy, cx, cy = rig.intrinsics[0]
    for index, name in enumerate(("left", "right")):
        info = layouts.make(
            layouts.CAMERA_INFO, header=layouts.header(1, name), width=world.SIZE[0], height=world.SIZE[1],
            distortion_model="plumb_bob", d=np.zeros(5), k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1]),
            r=np.eye(3).reshape(-1),
            p=np.array([fx, 0, cx, -fx * world.BASELINE * index, 0, fy, cy, 0, 0, 0, 1, 0]),
        )  # fmt: skip
        sent.append(layouts.Sent(f"/{name}/camera_info", layouts.CAMERA_INFO, info, 1))
    for stamp_ns, i in stamps:
        for index, name in enumerate(("left", "right")):
            grey = world.render(rig, index, poses[i]).grey
            pixels = np.repeat(grey[..., None], 3, axis=2)
            image = layouts.make(
                IMAGE, header=layouts.header(stamp_ns, name), width=world.SIZE[0], height=world.SIZE[1],
                encoding="rgb8", step=3 * world.SIZE[0], data=pixels.reshape(-1),
            )  # fmt: skip
            sent.append(layouts.Sent(f"/{name}/image_raw", IMAGE, image, stamp_ns))
    return layouts.write(path, sent)


def test_recording_with_a_long_pause(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Dropped frames and 30 s of nothing: what was seen before is found again, and it stays one map."""
    numbers = [0, 1, 2, 4, 5, 6, 7, 8]
    stamps = [(10**9 + i * 10**8 + (30 * 10**9 if i > 5 else 0), i) for i in numbers]
    bag = recording(tmp_path / "bag", stamps, world.drive(9))
    out = tmp_path / "tracks.mcap"
    assert main(["track", str(bag), str(out), "--track", "max_features=300"]) == 3
    text, errors = capsys.readouterr()
    assert "8, stereo" in text and "in 1 session" in text
    assert "30.2 s without images" in errors and errors.count("\n") == 1
    with BagReader(out) as reader:
        rig = next(one for _, _, one in reader.measurements() if isinstance(one, CameraRig))
    assert rig.position[1] == pytest.approx([world.BASELINE, 0.0, 0.0])
