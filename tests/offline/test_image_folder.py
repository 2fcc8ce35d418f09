# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Folders of pictures as people have them: which camera, which time, which rig."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from ba_node.io.bag_topics import BagError
from ba_node.io.rig_file import RigError, rig_yaml
from tests.io.test_rig_file import a_rig
from tests.offline.test_images import STEP_NS, picture, read


def folder(tmp_path: Path, names: Mapping[str, list[str]], **files: str) -> Path:
    for place, pictures in names.items():
        (tmp_path / place).mkdir(exist_ok=True)
        for i, name in enumerate(pictures):
            cv2.imwrite(str(tmp_path / place / name), picture(i))
    for name, text in files.items():
        (tmp_path / name.replace("_", ".")).write_text(text)
    return tmp_path


OF_CAMERAS = ("names", "models", "intrinsics", "distortion", "image_size", "position", "orientation")
NUMBERS = [f"{i:06d}.png" for i in range(3)]
RIG = rig_yaml(a_rig())[0]


def test_folders_of_pictures(tmp_path: Path) -> None:
    source, frames = read(folder(tmp_path, {"left": NUMBERS, "right": NUMBERS}, rig_yaml=RIG), rate_hz=20.0)
    assert (source.mode, len(frames), source.rig.position[1, 0]) == ("stereo", 3, 0.11)
    assert np.diff([images.stamp_ns for images, _ in frames]).tolist() == [STEP_NS // 2] * 2
    assert np.array_equal(frames[2][0].grey[1], picture(2))


@pytest.mark.parametrize(
    ("names", "files", "first_ns", "step_ns"),
    [
        ([f"170000000{i}000000000.png" for i in range(3)], {}, 17 * 10**17, 10**9),
        ([f"130503110{i}.250000.jpg" for i in range(3)], {}, 130503110025 * 10**7, 10**9),
        ([f"{1700000000000 + 50 * i}.png" for i in range(3)], {}, 17 * 10**17, 50_000_000),
        ([f"{1700000000000000 + 33333 * i}.png" for i in range(3)], {}, 17 * 10**17, 33_333_000),
        ([f"{123456789000 + 50_000_000 * i}.png" for i in range(3)], {}, 123_456_789_000, 50_000_000),
        ([f"rgb_{1403636579763555584 + 50_000_000 * i}.png" for i in range(3)], {}, 1403636579763555584, 50_000_000),
        (NUMBERS, {"times_txt": "0.0\n0.05\n0.1\n"}, 0, 50_000_000),
        (NUMBERS, {"times_txt": "# s\n1700000000.5\n1700000000.75\n1700000001.0\n"}, 170000000050 * 10**7, 250_000_000),
        (NUMBERS, {"times_txt": "".join(f"{17 * 10**17 + i * 10**8} a\n" for i in range(3))}, 17 * 10**17, STEP_NS),
        (["frame9.png", "frame10.png", "frame11.png"], {}, 0, STEP_NS),
        (["000000.png", "000010.png", "000020.png"], {}, 0, STEP_NS),
        (["a.png", "b.png", "c.png"], {}, 0, STEP_NS),
        (["3.png", "7000.png", "9999123.png"], {}, 0, STEP_NS),
    ],
)
def test_stamps_of_pictures(
    names: list[str], files: Mapping[str, str], first_ns: int, step_ns: int, tmp_path: Path
) -> None:
    source, frames = read(folder(tmp_path, {".": names}, rig_yaml=RIG, **files))
    assert (source.mode, len(source.rig)) == ("mono", 1)
    stamps = [images.stamp_ns for images, _ in frames]
    assert (stamps[0], np.diff(stamps).tolist()) == (first_ns, [step_ns] * 2)
    assert all(np.array_equal(images.grey[0], picture(i)) for i, (images, _) in enumerate(frames) if ".png" in names[i])


def test_a_picture_that_is_missing_leaves_a_gap(tmp_path: Path) -> None:
    """Those after it keep their partners; so do lines of times.txt."""
    for place, missing in (("left", 1), ("right", 3)):
        folder(tmp_path, {place: [f"{i:06d}.png" for i in range(6)]}, rig_yaml=RIG)
        (tmp_path / place / f"{missing:06d}.png").unlink()
    source, frames = read(tmp_path)
    assert [images.stamp_ns // STEP_NS for images, _ in frames] == [0, 2, 4, 5]
    assert all(np.array_equal(*images.grey) for images, _ in frames)
    assert source.counted == {"no right/image_raw": 1, "right/image_raw alone": 1}
    assert "-100.0 ms off" in source.notes["right/image_raw alone"]
    for line_of_both in (False, True):
        (tmp_path / "times.txt").write_text("0\n1\n2\n3\n4\n5\n")
        assert [images.stamp_ns // 10**9 for images, _ in read(tmp_path)[1]] == [0, 2, 4, 5]
        (tmp_path / "left" / "000003.png").unlink(missing_ok=line_of_both)  # now neither camera has it
    (tmp_path / "times.txt").write_text("0\n1\n2\n3\n5\n")
    assert [images.stamp_ns // 10**9 for images, _ in read(tmp_path)[1]] == [0, 2, 3, 5]
    (tmp_path / "times.txt").write_text("0\n1\n2\n3\n")
    with pytest.raises(BagError, match="4 lines for 5 pictures"):
        read(tmp_path)


@pytest.mark.parametrize("place", ["left", "right"])
def test_a_picture_that_is_named_amiss_spoils_no_other(place: str, tmp_path: Path) -> None:
    """Its number is that of another: by their order all after it would be paired with the wrong ones."""
    for camera in ("left", "right"):
        folder(tmp_path, {camera: [f"{i:06d}.png" for i in range(8)]}, rig_yaml=RIG)
    (tmp_path / place / "000004.png").rename(tmp_path / place / "0000O4.png")
    source, frames = read(tmp_path)
    assert [images.stamp_ns // STEP_NS for images, _ in frames] == [0, 1, 2, 3, 5, 6, 7]
    assert all(np.array_equal(*images.grey) for images, _ in frames)
    assert source.warnings == {"names": f"left out 1 pictures, which are not named as the others: {place}/0000O4.png"}
    assert list(source.counted.values()) == [1]
    (tmp_path / place / "000006.png").write_bytes(b"")
    source, frames = read(tmp_path)
    assert len(frames) == 6 and f"{place}/000006.png, 0 bytes" in source.notes["unreadable"]


@pytest.mark.parametrize(
    "places",
    [
        ("Left/{}.png", "Right/{}.png"),
        ("image_00/data/{}.png", "image_01/data/{}.png"),
        ("mav0/cam0/data/{}.png", "mav0/cam1/data/{}.png"),
        ("{}_left.png", "{}_right.png"),
        ("left{}.png", "right{}.png"),
        ("{}_L.png", "{}_R.png"),
        ("cam0_{}.png", "cam1_{}.png"),
    ],
)
def test_two_cameras_by_the_names_of_folders_or_pictures(places: tuple[str, str], tmp_path: Path) -> None:
    for camera, place in enumerate(places):
        for i in range(3):
            file = tmp_path / place.format(f"{i:06d}")
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), picture(10 * i + camera))
    root = tmp_path / "mav0" if places[0].startswith("mav0") else tmp_path
    (root / "rig.yaml").write_text(RIG)
    source, frames = read(tmp_path)
    assert source.mode == "stereo"
    assert [images.stamp_ns for images, _ in frames] == [0, STEP_NS, 2 * STEP_NS]
    for i, (images, _) in enumerate(frames):
        assert all(np.array_equal(grey, picture(10 * i + camera)) for camera, grey in enumerate(images.grey))


def test_euroc_tells_its_cameras(tmp_path: Path) -> None:
    for camera in range(2):
        below = tmp_path / "mav0" / f"cam{camera}"
        (below / "data").mkdir(parents=True)
        cv2.imwrite(str(below / "data" / "1403636579763555584.png"), picture(camera))
        place = [0.0, -1.0, 0.0, 0.1 * camera, 1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0]
        content = {
            "sensor_type": "camera", "T_BS": {"cols": 4, "rows": 4, "data": place}, "resolution": [64, 48],
            "camera_model": "pinhole", "intrinsics": [50.0, 51.0, 31.0, 23.0],
            "distortion_model": "radial-tangential", "distortion_coefficients": [-0.28, 0.07, 0.0002, 0.00002],
        }  # fmt: skip
        (below / "sensor.yaml").write_text(json.dumps(content))
    source, frames = read(tmp_path)
    rig = source.rig
    assert (source.mode, rig.models, frames[0][0].stamp_ns) == ("stereo", ("plumb_bob",) * 2, 1403636579763555584)
    assert rig.position.tolist() == [[0.0, 0.2, 0.3], [0.1, 0.2, 0.3]]
    assert rig.orientation[1] == pytest.approx([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    assert rig.intrinsics[1].tolist() == [50.0, 51.0, 31.0, 23.0] and rig.distortion[0][0] == -0.28
    (tmp_path / "mav0" / "cam1" / "sensor.yaml").write_text(json.dumps(content | {"distortion_model": "fisheye"}))
    with pytest.raises(RigError, match="cam1: pinhole-fisheye: expected pinhole with one of radial-tangential"):
        read(tmp_path)


def test_a_calibration_that_opencv_wrote(tmp_path: Path) -> None:
    matrix = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [ {} ]\n"
    text = "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\n"
    text += "camera_matrix: " + matrix.format(3, 3, "50., 0., 31.5, 0., 51., 23.5, 0., 0., 1.")
    text += "distortion_coefficients: " + matrix.format(1, 5, "-0.1, 0.02, 0., 0., 0.")
    source, _ = read(folder(tmp_path, {".": NUMBERS}, calib_yml=text))
    assert source.rig.intrinsics[0].tolist() == [50.0, 51.0, 31.5, 23.5]
    assert source.rig.distortion[0][:2].tolist() == [-0.1, 0.02]
    (tmp_path / "calib.yml").write_text("%YAML:1.0\nCamera.fx: 50.0\n")
    with pytest.raises(RigError, match=r"no rig: expected .* there are: Camera.fx"):
        read(tmp_path)


def test_folders_that_cannot_be_read_are_said(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no pictures"):
        read(tmp_path)
    folder(tmp_path, {"first": NUMBERS, "second": NUMBERS})
    with pytest.raises(BagError, match="there are pictures in first, second: call them left and right"):
        read(tmp_path)
    with pytest.raises(BagError, match="nothing tells the cameras"):
        read(folder(tmp_path, {"left": NUMBERS, "right": NUMBERS}))
    one = rig_yaml(dataclasses.replace(a_rig(), **{name: getattr(a_rig(), name)[:1] for name in OF_CAMERAS}))[0]
    with pytest.raises(BagError, match=r"stereo needs 2 cameras, and rig.yaml tells 1: put left.yaml and right.yaml"):
        read(folder(tmp_path, {}, rig_yaml=one))
    (tmp_path / "times.txt").write_text("0.0\n")
    with pytest.raises(BagError, match="1 lines for 3 pictures"):
        read(folder(tmp_path, {}, rig_yaml=RIG))
