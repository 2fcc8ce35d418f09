# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put a rig together from ``sensor_msgs/CameraInfo``: where its cameras sit comes from their ``p``, or from tf_static.

Of a calibrated stereo pair ``p`` and ``r`` say all (REP-104, ``image_geometry``): a rectified camera i sees
``x = p_i (X, 1)`` with X in the rectified frame of the first one, and ``X_rectified = r_i X_raw``. So with
``t_i = p_i[0, 3] / p_i[0, 0]`` (m), for the right camera minus the baseline,

    first_from_camera_i = (r_1^T r_i,  r_1^T (-t_i, 0, 0))      raw images, with k and d
    first_from_camera_i = (I,          (-t_i, 0, 0))            rectified images, with p alone
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.measurements import CameraRig
from ba_node.messages.camera_info import lens_of, unplaced
from ba_node.messages.factory import ConversionError
from ba_node.messages.transforms import StaticTree

# Baselines outside of it are in other units, m.
BASELINE_RANGE_M = (1e-3, 20.0)


def rig_from_infos(
    infos: Sequence[Any], *, rectified: bool = False, tree: StaticTree | None = None, base: str = ""
) -> CameraRig:
    """Return the rig of cameras given by their CameraInfo, the first one being the left one of a stereo pair.

    The body is the first camera, or the frame ``base`` where ``tree`` knows the way to it. Extrinsics of further
    cameras are those of ``p``; where it has none, those of the tree.

    Args:
        infos: messages (rclpy, rosbags, or anything with these fields), one for each camera.
        rectified: the images are rectified: their camera is ``p``, without distortion.
        tree: what /tf_static says, None if nothing.
        base: body frame, empty for the first camera.

    Raises:
        ConversionError: a camera cannot be, left and right are swapped, or nothing tells where a camera sits.
    """
    names = tuple(str(info.header.frame_id) or f"camera{i}" for i, info in enumerate(infos))
    lenses = [lens_of(_as_rectified(info) if rectified else info) for info in infos]
    shifts = [_shift_m(info, name) for info, name in zip(infos, names, strict=True)]
    if shifts and shifts[0] != 0.0:
        raise ConversionError(
            f"p of {names[0]!r}, the first camera, has the baseline {-shifts[0]:g} m, which is that of the right one:"
            " left and right are swapped"
        )
    models = ["plumb_bob" if rectified else str(info.distortion_model) for info in infos]
    rig = unplaced(names[0], names, models, lenses)
    if all(shift != 0.0 for shift in shifts[1:]):
        return _placed(_spread(rig, infos, shifts, rectified), tree, base)
    placed, missing = tree.place(rig, base or names[0]) if tree is not None else (rig, names[1:])
    if missing:
        raise ConversionError(
            f"nothing tells where {' and '.join(map(repr, missing))} sits: p[3] is 0 and /tf_static has no way from"
            f" {base or names[0]!r} to it: calibrate the pair, publish /tf_static, or give the rig as YAML"
        )
    return placed


def _as_rectified(info: Any) -> Any:
    """Return the camera of the rectified image: p without its last column, no distortion."""
    p = _matrix(info.p, 12)
    if not p[:, :3].any():
        raise ConversionError(
            f"p of {info.header.frame_id!r} is all zero: the images are not those of a calibrated pair"
        )
    size = (info.width, info.height, getattr(info, "roi", None), info.binning_x, info.binning_y)
    return _Pinhole(p[:, :3].reshape(-1), np.zeros(0), *size)


@dataclasses.dataclass(frozen=True)
class _Pinhole:
    """The fields of a CameraInfo that :func:`lens_of` reads."""

    k: FloatArray
    d: FloatArray
    width: int
    height: int
    roi: Any
    binning_x: int
    binning_y: int


def _shift_m(info: Any, name: str) -> float:
    """Return p[0, 3] / p[0, 0], m: minus the distance along x from the first camera; 0 if p says nothing."""
    p = _matrix(info.p, 12)
    if p[0, 3] == 0.0 or p[0, 0] == 0.0:
        return 0.0
    shift = float(p[0, 3] / p[0, 0])
    low, high = BASELINE_RANGE_M
    if not low <= abs(shift) <= high:
        raise ConversionError(
            f"p of {name!r} has the baseline {-shift:g} m: expected {low:g} to {high:g} m; p[3] is -fx times metres"
        )
    return shift


def _spread(rig: CameraRig, infos: Sequence[Any], shifts: Sequence[float], rectified: bool) -> CameraRig:
    """Return the rig with its cameras where r and p put them, seen from the first."""
    rotations = np.array([np.eye(3) if rectified else _rotation(info) for info in infos])
    offsets = np.array([[-shift, 0.0, 0.0] for shift in shifts])
    first = rotations[0].T
    return dataclasses.replace(
        rig, position=offsets @ first.T, orientation=geometry.quaternion_from_matrix(first @ rotations)
    )


def _rotation(info: Any) -> FloatArray:
    matrix = _matrix(info.r, 9)
    return geometry.nearest_rotation(matrix) if matrix.any() else np.eye(3)


def _placed(rig: CameraRig, tree: StaticTree | None, base: str) -> CameraRig:
    """Return a rig seen from its first camera as it is seen from a frame, if the way there is known."""
    at = tree.find(base, rig.names[0]) if tree is not None and base else None
    if at is None:
        return rig
    rotation, position = geometry.compose(
        at.rotation, at.translation, geometry.matrix_from_quaternion(rig.orientation), rig.position
    )
    return dataclasses.replace(
        rig, frame_id=base, position=position, orientation=geometry.quaternion_from_matrix(rotation)
    )


def _matrix(values: Any, size: int) -> FloatArray:
    matrix = np.array(values, np.float64).reshape(-1)
    if len(matrix) != size or not np.isfinite(matrix).all():
        raise ConversionError(f"a matrix of camera_info has the entries {matrix}: expected {size} finite ones")
    return matrix.reshape(3, -1)
