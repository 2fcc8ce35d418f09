# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write rigs as YAML: our own form, Kalibr's camchain, camera_info of ROS's calibrator; read EuRoC's.

Our own form has a row for each camera, `position` and `orientation` being those of body from camera optical frame::

    frame_id: base_link
    cameras:
    - name: left
      distortion_model: plumb_bob
      intrinsics: [458.7, 457.3, 367.2, 248.4]    # fx fy cx cy, px
      distortion: [-0.28, 0.07, 0.0002, 0.00002]
      image_size: [752, 480]
      position: [0.0, 0.0, 0.0]                   # m
      orientation: [0.0, 0.0, 0.0, 1.0]           # x y z w

Kalibr has ``T_cam_imu`` (camera from IMU) or, without an IMU, ``T_cn_cnm1`` (camera n from camera n - 1); the body is
the IMU or the first camera. Of camera_info, one file is one camera; of two the second is the right one of a pair. Of
EuRoC's ``sensor.yaml`` one file is one camera too, with ``T_BS``, body from camera. Files that OpenCV has written are
read likewise.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.io.yaml_file import read_yaml
from ba_node.measurements import CameraRig
from ba_node.messages.factory import ConversionError
from ba_node.messages.rig import rig_from_infos

FORMS = ("own", "kalibr", "camera_info")
_OWN = ("intrinsics", "distortion", "image_size", "position", "orientation")
# Kalibr's and EuRoC's names of distortions, and ROS's.
_KALIBR = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": ""}
_EUROC = {"radial-tangential": "plumb_bob", "equidistant": "equidistant", "none": ""}


class RigError(ValueError):
    """A file that holds no rig, or one that the form asked for cannot hold."""


def read_rig(*paths: Path | str, rectified: bool = False) -> CameraRig:
    """Return the rig in a file of any form, or in one camera_info file a camera, the left one first.

    ``rectified``: take ``projection_matrix`` of camera_info files, for rectified images.

    Raises:
        RigError: a file cannot be read, or holds no rig; names the file and the entry.
    """
    contents = [_content(path) for path in paths]
    where = ", ".join(str(path) for path in paths)
    try:
        if all("camera_matrix" in content for content in contents):
            infos = [_info(content, f"camera{i}") for i, content in enumerate(contents)]
            return rig_from_infos(infos, rectified=rectified)
        if all("T_BS" in content for content in contents):
            return _from_euroc(contents)
        if len(contents) > 1:
            raise RigError("several files are one rig only as camera_info or EuRoC's sensor.yaml, one a camera")
        if "cameras" in contents[0]:
            return _from_own(contents[0])
        if "cam0" in contents[0]:
            return _from_kalibr(contents[0])
    except KeyError as error:
        raise RigError(f"{where}: entry {error.args[0]!r} is missing") from error
    except (RigError, ConversionError) as error:
        raise RigError(f"{where}: {error}") from error
    except (TypeError, ValueError, AttributeError) as error:  # whatever a wrong value leads numpy to
        raise RigError(f"{where}: an entry is of the wrong kind: {error}") from error
    raise RigError(
        f"{where}: no rig: expected `cameras` (our own form), `cam0` (Kalibr), `camera_matrix` (camera_info) or"
        f" `T_BS` (EuRoC); there are: {', '.join(map(str, contents[0]))}"
    )


def rig_yaml(rig: CameraRig, form: str = "own", beside: Sequence[Mapping[str, Any]] = ()) -> list[str]:
    """Return the text of each file that holds a rig in one of :data:`FORMS`: one, or one a camera for camera_info.

    ``beside`` holds more entries of each camera, for our own form alone; they are not read again.

    Raises:
        RigError: the form cannot say what the rig is.
    """
    if form == "own":
        rows = [{**_own_row(rig, i), **(beside[i] if beside else {})} for i in range(len(rig))]
        return [_dump({"frame_id": rig.frame_id, "cameras": rows})]
    if form == "kalibr":
        return [_dump({f"cam{i}": _kalibr_row(rig, i) for i in range(len(rig))})]
    return [_dump(row) for row in _info_rows(rig)]


def _content(path: Path | str) -> dict[Any, Any]:
    content = read_yaml(path, RigError)
    if not isinstance(content, dict) or not content:
        raise RigError(f"{path}: expected a mapping with a rig, got {type(content).__name__}")
    return content


def _from_own(content: Mapping[Any, Any]) -> CameraRig:
    rows = content["cameras"]
    return CameraRig(
        frame_id=str(content["frame_id"]),
        names=tuple(str(row["name"]) for row in rows),
        models=tuple(str(row.get("distortion_model", "")) for row in rows),
        intrinsics=_numbers(rows, "intrinsics", 4),
        distortion=tuple(np.array(row.get("distortion", []), np.float64).reshape(-1) for row in rows),
        image_size=_numbers(rows, "image_size", 2).astype(np.int64),
        position=_numbers(rows, "position", 3),
        orientation=_numbers(rows, "orientation", 4),
    )


def _numbers(rows: Sequence[Mapping[Any, Any]], name: str, size: int) -> FloatArray:
    """Return an entry of each camera, (n, size)."""
    for i, row in enumerate(rows):
        values = np.array(row[name], np.float64)
        if values.shape != (size,) or not np.isfinite(values).all():
            raise RigError(f"camera {i}: {name} = {row[name]}: expected {size} finite numbers")
    return np.array([row[name] for row in rows], np.float64).reshape(-1, size)


def _from_kalibr(content: Mapping[Any, Any]) -> CameraRig:
    names = list(itertools.takewhile(content.__contains__, (f"cam{i}" for i in range(len(content)))))
    more = sorted(name for name in map(str, content) if re.fullmatch(r"cam\d+", name) and name not in names)
    if more:
        raise RigError(f"{', '.join(more)} but no cam{len(names)}: cameras are numbered cam0, cam1, ... without a gap")
    rows = [content[name] for name in names]
    for name, row in zip(names, rows, strict=True):
        if row["camera_model"] != "pinhole" or row["distortion_model"] not in _KALIBR:
            model = f"{row['camera_model']}-{row['distortion_model']}"
            raise RigError(f"{name}: {model}: expected pinhole with one of {', '.join(_KALIBR)}")
    with_imu = all("T_cam_imu" in row for row in rows)
    steps = [_pose(row, "T_cam_imu" if with_imu else "T_cn_cnm1", name) for name, row in zip(names, rows, strict=True)]
    placed = list(steps if with_imu else itertools.accumulate(steps, lambda before, step: step @ before))
    body_from_camera = np.linalg.inv(np.array(placed))
    return CameraRig(
        frame_id="imu" if with_imu else names[0],
        names=tuple(names),
        models=tuple(_KALIBR[row["distortion_model"]] for row in rows),
        intrinsics=_numbers(rows, "intrinsics", 4),
        distortion=tuple(np.array(row.get("distortion_coeffs") or [], np.float64) for row in rows),
        image_size=_numbers(rows, "resolution", 2).astype(np.int64),
        position=body_from_camera[:, :3, 3],
        orientation=geometry.quaternion_from_matrix(body_from_camera[:, :3, :3]),
    )


def _from_euroc(contents: Sequence[Mapping[Any, Any]]) -> CameraRig:
    """Return the rig of EuRoC's sensor.yaml of each camera; the body is that of ``T_BS``, body from camera."""
    names = tuple(f"cam{i}" for i in range(len(contents)))
    for name, row in zip(names, contents, strict=True):
        if row["camera_model"] != "pinhole" or row["distortion_model"] not in _EUROC:
            model = f"{row['camera_model']}-{row['distortion_model']}"
            raise RigError(f"{name}: {model}: expected pinhole with one of {', '.join(_EUROC)}")
    flat = [{"T_BS": np.array(row["T_BS"]["data"], np.float64).reshape(4, 4)} for row in contents]
    body_from_camera = np.array([_pose(row, "T_BS", name) for row, name in zip(flat, names, strict=True)])
    return CameraRig(
        frame_id="body",
        names=names,
        models=tuple(_EUROC[row["distortion_model"]] for row in contents),
        intrinsics=_numbers(contents, "intrinsics", 4),
        distortion=tuple(np.array(row["distortion_coefficients"], np.float64).reshape(-1) for row in contents),
        image_size=_numbers(contents, "resolution", 2).astype(np.int64),
        position=body_from_camera[:, :3, 3],
        orientation=geometry.quaternion_from_matrix(body_from_camera[:, :3, :3]),
    )


def _pose(row: Mapping[Any, Any], key: str, name: str) -> FloatArray:
    """Return a transform of Kalibr, (4, 4); the first camera has no camera before it."""
    if key == "T_cn_cnm1" and name == "cam0":
        return np.eye(4)
    matrix = np.array(row[key], np.float64)
    rigid = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all()) and _is_rotation(matrix[:3, :3])
    if not rigid or not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise RigError(f"{name}: {key} is no rigid transform of 4 x 4 finite numbers, the last row being 0 0 0 1")
    return np.block([[geometry.nearest_rotation(matrix[:3, :3]), matrix[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]])


def _is_rotation(matrix: FloatArray) -> bool:
    return np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) and float(np.linalg.det(matrix)) > 0.0


def _info(content: Mapping[Any, Any], name: str) -> SimpleNamespace:
    """Return a camera_info file with the fields of the message."""

    def data(key: str, default: Sequence[float]) -> FloatArray:
        entry = content.get(key, {"data": default})
        if not isinstance(entry, Mapping) or "data" not in entry:
            raise RigError(f"{name}: {key} = {entry}: expected a mapping with rows, cols and data")
        return np.array(entry["data"], np.float64).reshape(-1)

    size = content["image_width"], content["image_height"]
    if not all(type(length) is int and length > 0 for length in size):
        raise RigError(f"{name}: image_width, image_height = {size[0]}, {size[1]}: expected positive whole numbers")
    r = data("rectification_matrix", np.eye(3).reshape(-1).tolist())
    if r.size != 9 or not np.isfinite(r).all() or not _is_rotation(r.reshape(3, 3)):
        raise RigError(f"{name}: rectification_matrix = {r.tolist()}: expected a rotation of 3 x 3 numbers")
    header = SimpleNamespace(frame_id=str(content.get("camera_name") or name))
    return SimpleNamespace(
        header=header,
        width=size[0],
        height=size[1],
        k=data("camera_matrix", ()),
        d=data("distortion_coefficients", ()),
        r=r,
        p=data("projection_matrix", [0.0] * 12),
        distortion_model=str(content.get("distortion_model", "")),
        binning_x=0,
        binning_y=0,
    )


def _own_row(rig: CameraRig, i: int) -> dict[str, Any]:
    return {
        "name": rig.names[i],
        "distortion_model": rig.models[i],
        **{name: getattr(rig, name)[i].tolist() for name in _OWN},
    }


def _kalibr_row(rig: CameraRig, i: int) -> dict[str, Any]:
    distortion = rig.distortion[i]
    model = next((name for name, ours in _KALIBR.items() if ours == rig.models[i]), "")
    if not distortion.any():
        model, distortion = "none", distortion[:0]
    elif not model or distortion[4:].any():
        raise RigError(f"camera {rig.names[i]!r}: Kalibr has no {rig.models[i]} with {len(distortion)} coefficients")
    row = {
        "camera_model": "pinhole",
        "intrinsics": rig.intrinsics[i].tolist(),
        "distortion_model": model,
        "distortion_coeffs": distortion[:4].tolist(),
        "resolution": rig.image_size[i].tolist(),
        "T_cam_imu": np.linalg.inv(_body_from_camera(rig, i)).tolist(),
    }
    if i > 0:
        row["T_cn_cnm1"] = (np.linalg.inv(_body_from_camera(rig, i)) @ _body_from_camera(rig, i - 1)).tolist()
    return row


def _body_from_camera(rig: CameraRig, i: int) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3] = geometry.matrix_from_quaternion(rig.orientation[i])
    matrix[:3, 3] = rig.position[i]
    return matrix


def _info_rows(rig: CameraRig) -> list[dict[str, Any]]:
    """Return a camera_info for each camera; where others sit relative to the first is in r and p (REP-104).

    The rectified frame has its x axis from the first to the second camera, and its z axis as near as may be to that of
    the first.
    """
    if len(rig) > 2:
        raise RigError(f"camera_info says where one camera or the two of a pair sit, not {len(rig)}: choose own")
    first_from = [np.linalg.inv(_body_from_camera(rig, 0)) @ _body_from_camera(rig, i) for i in range(len(rig))]
    rectified = np.eye(3)
    baseline = 0.0
    if len(rig) == 2:
        offset = first_from[1][:3, 3]
        baseline = float(np.linalg.norm(offset))
        if baseline == 0.0 or offset[0] <= np.abs(offset[1:]).max():
            raise RigError(f"the second camera is at {offset} m from the first, not to its right: choose own")
        y = np.cross([0.0, 0.0, 1.0], offset)
        y /= np.linalg.norm(y)
        rectified = np.array([offset / baseline, y, np.cross(offset / baseline, y)])
    focal, centre = float(rig.intrinsics[0, 1]), rig.intrinsics[0, 2:].tolist()
    rows = []
    for i, pose in enumerate(first_from):
        fx, fy, cx, cy = rig.intrinsics[i].tolist()
        shift = -focal * baseline if i else 0.0
        p = [focal, 0.0, centre[0], shift, 0.0, focal, centre[1], 0.0, 0.0, 0.0, 1.0, 0.0]
        rows.append(
            {
                "image_width": int(rig.image_size[i, 0]),
                "image_height": int(rig.image_size[i, 1]),
                "camera_name": rig.names[i],
                "camera_matrix": _matrix([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], 3),
                "distortion_model": rig.models[i],
                "distortion_coefficients": _matrix(rig.distortion[i].tolist(), 1),
                "rectification_matrix": _matrix((rectified @ pose[:3, :3]).reshape(-1).tolist(), 3),
                "projection_matrix": _matrix(p, 3),
            }
        )
    return rows


def _matrix(data: Sequence[float], rows: int) -> dict[str, Any]:
    return {"rows": rows, "cols": len(data) // rows, "data": list(data)}


def _dump(content: Mapping[str, Any]) -> str:
    return str(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))
