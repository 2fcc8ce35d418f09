# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Rigs as YAML: each form there and back, Kalibr's own words, and files that hold none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.io.rig_file import FORMS, RigError, read_rig, rig_yaml
from ba_node.measurements import CameraRig

# As Kalibr writes it: the second camera 0.11 m to the right of the first, the IMU turned about z by 90 degrees.
CAMCHAIN = """\
cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.01]
  - [-1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0
cam1:
  T_cam_imu:
  - [0.0, 1.0, 0.0, -0.1]
  - [-1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05]
  distortion_model: radtan
  intrinsics: [457.587, 456.134, 379.999, 255.238]
  resolution: [752, 480]
"""

INFO = """
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [400,0,320,0,400,240,0,0,1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0,0,0,0,0]}
rectification_matrix: {rows: 3, cols: 3, data: [1,0,0,0,1,0,0,0,1]}
"""


def a_rig(frame_id: str = "left") -> CameraRig:
    """Return a pair whose right camera is turned a little; the body is the left one."""
    turned = geometry.quaternion_from_matrix(geometry.so3_exp(np.array([0.01, -0.02, 0.03])))
    return CameraRig(
        frame_id=frame_id,
        names=("left", "right"),
        models=("plumb_bob", "plumb_bob"),
        intrinsics=np.array([[458.0, 457.0, 367.0, 248.0], [459.0, 456.0, 380.0, 255.0]]),
        distortion=(np.array([-0.28, 0.07, 1e-4, 2e-5]), np.array([-0.29, 0.08, -1e-4, -3e-5])),
        image_size=np.array([[752, 480], [752, 480]]),
        position=np.array([[0.0, 0.0, 0.0], [0.11, 0.001, -0.002]]),
        orientation=np.array([[0.0, 0.0, 0.0, 1.0], turned]),
    )


def read_back(texts: list[str], tmp_path: Path) -> CameraRig:
    paths = [tmp_path / f"{i}.yaml" for i in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return read_rig(*paths)


@pytest.mark.parametrize("form", FORMS)
def test_each_form_comes_back(form: str, tmp_path: Path) -> None:
    rig = a_rig()
    back = read_back(rig_yaml(rig, form), tmp_path)
    assert len(back) == 2
    assert np.allclose(back.intrinsics, rig.intrinsics, rtol=0, atol=1e-9)
    assert all(np.allclose(a, b, atol=1e-12) for a, b in zip(back.distortion, rig.distortion, strict=True))
    assert np.array_equal(back.image_size, rig.image_size)
    assert np.allclose(back.position, rig.position, atol=1e-12)
    assert np.allclose(np.abs(np.sum(back.orientation * rig.orientation, axis=1)), 1.0, atol=1e-12)


def test_our_own_form_keeps_names_and_body(tmp_path: Path) -> None:
    back = read_back(rig_yaml(a_rig("base_link")), tmp_path)
    assert (back.frame_id, back.names, back.models) == ("base_link", ("left", "right"), ("plumb_bob", "plumb_bob"))


def test_kalibr_is_read_with_the_imu_as_body(tmp_path: Path) -> None:
    rig = read_back([CAMCHAIN], tmp_path)
    assert (rig.frame_id, rig.names, rig.models) == ("imu", ("cam0", "cam1"), ("plumb_bob", "plumb_bob"))
    # p_imu = R^T (0 - t) with R, t of T_cam_imu.
    assert np.allclose(rig.position, [[0.02, -0.01, -0.03], [0.02, 0.1, -0.03]], atol=1e-12)
    apart = geometry.matrix_from_quaternion(rig.orientation[0]).T @ (rig.position[1] - rig.position[0])
    assert np.allclose(apart, [0.11, 0.0, 0.0], atol=1e-12)


def test_kalibr_without_an_imu_chains_the_cameras(tmp_path: Path) -> None:
    lines, keep = [], True
    for line in CAMCHAIN.splitlines():
        keep = "T_cam_imu" not in line if line.startswith("  T_") or not line.startswith("  -") else keep
        lines += [line] if keep else []
    rig = read_back(["\n".join(lines)], tmp_path)
    assert rig.frame_id == "cam0"
    assert np.allclose(rig.position, [[0.0, 0.0, 0.0], [0.11, 0.0, 0.0]], atol=1e-12)


def test_three_cameras_have_no_camera_info() -> None:
    rig = a_rig()
    twice = [np.concatenate([a, a[1:]]) for a in (rig.intrinsics, rig.position, rig.orientation, rig.image_size)]
    three = CameraRig("b", (*rig.names, "c"), (*rig.models, ""), twice[0], (*rig.distortion, rig.distortion[0]),
                      twice[3], twice[1], twice[2])  # fmt: skip
    with pytest.raises(RigError, match="not 3"):
        rig_yaml(three, "camera_info")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a mapping with a rig, got NoneType"),
        ("a: 1", "no rig: expected `cameras`"),
        ("cameras: [{name: a}]\nframe_id: b", "entry 'intrinsics' is missing"),
        ("cameras: 3\nframe_id: b", "of the wrong kind"),
        ("frame_id: b\ncameras: [{name: a, intrinsics: [1, 2, 3]}]", "expected 4 finite numbers"),
        (CAMCHAIN.replace("radtan", "fov"), "pinhole-fov: expected pinhole with one of radtan, equidistant, none"),
        (CAMCHAIN.replace("camera_model: pinhole", "camera_model: omni"), "omni-radtan"),
        (CAMCHAIN.replace("[0.0, 1.0, 0.0, 0.01]", "[0.0, 2.0, 0.0, 0.01]"), "T_cam_imu is no rigid transform"),
        (CAMCHAIN.replace("[0.0, 1.0, 0.0, -0.1]", "[0.0, 1.0, 0.0, .inf]"), "cam1: T_cam_imu is no rigid transform"),
        (CAMCHAIN.replace("[0.0, 0.0, 0.0, 1.0]", "[1.0, 0.0, 0.0, 1.0]"), "the last row being 0 0 0 1"),
        (CAMCHAIN.replace("cam1:", "cam7:"), "cam7 but no cam1: cameras are numbered cam0, cam1, ... without a gap"),
        (INFO.replace("image_width: 640", "image_width: -640"), "image_width, image_height = -640, 480: expected"),
        (INFO.replace("image_width: 640", "image_width: 640.5"), "= 640.5, 480: expected positive whole numbers"),
        (INFO.replace("data: [1,0,0,0,1,0,0,0,1]", "data: [0,0,0,0,0,0,0,0,0]"), "rectification_matrix = .*a rotation"),
        (INFO.replace("camera_matrix: {", "camera_matrix: 3 # {"), "camera_matrix = 3: expected a mapping with rows"),
        ("{", "not YAML"),
    ],
)
def test_what_is_no_rig_is_said(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(RigError, match=words) as error:
        read_rig(path)
    assert str(error.value).startswith(f"{path}: ")


def test_a_file_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="cannot be opened: No such file"):
        read_rig(tmp_path / "none.yaml")


def test_the_rig_that_the_documentation_shows_is_one(tmp_path: Path) -> None:
    """What a user copies beside the pictures."""
    page = Path(__file__).resolve().parents[2] / "docs" / "from_images.md"
    shown = page.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]
    (tmp_path / "rig.yaml").write_text(shown)
    rig = read_rig(tmp_path / "rig.yaml")
    assert (rig.names, rig.models, rig.malformed) == (("left", "right"), ("plumb_bob",) * 2, "")
    assert rig.image_size.tolist() == [[1226, 370]] * 2 and rig.position[1].tolist() == [0.537, 0.0, 0.0]
