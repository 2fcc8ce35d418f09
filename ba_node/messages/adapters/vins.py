# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read what OpenVINS, VINS-Fusion and VINS-Mono publish, as their sources have it.

OpenVINS (`publish_loopclosure_information` of ov_msckf) sends, for every image and only while somebody subscribes, pose
and extrinsics of camera 0 as Odometry, its CameraInfo, and a PointCloud with one channel a point, [0, 0, u, v, id].
Points that camera 0 does not see now have u = v = 0. Its quaternions are JPL's of IMU from global and of camera from
IMU: number by number they are Hamilton's, which ROS has, of global from IMU and of IMU from camera.

VINS-Fusion (`pubKeyframe`) sends pose and PointCloud of the last keyframe but two of its window, so late, with one
channel a point, [x_n, y_n, u, v, id], and with every image the extrinsics. Stamps went through a double each on its own
way, which is good for 120 ns.

The tracker of VINS-Mono sends a PointCloud for every image with one channel for each kind of value: id * cameras +
camera, u, v and velocities; its points are normalised. Poses come from the estimator, of keyframes or of all images.
The estimator of VINS-Fusion takes such clouds of a tracker too, with id, camera, u, v and velocities.

Ids are float32 in all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.measurements import CameraRig
from ba_node.messages.adapters.sources import (
    CAMERA_INFO,
    CLOUD,
    ODOMETRY,
    Extrinsic,
    Features,
    Input,
    LayoutError,
    Piece,
    Source,
    nowhere,
    pose,
    xyz,
    xyzw,
)
from ba_node.messages.conversion import measurement_from_message
from ba_node.messages.factory import stamp_ns_from_message

_VALUES_OF_A_POINT = 5
# What the estimator of VINS-Fusion takes from a tracker has one more than VINS-Mono's, or more.
_CHANNELS_OF_INPUT = 6


class _Vins(Source):
    """What the three have in common."""

    body = "body"

    def read(self, name: str, message: Any) -> Iterator[Piece]:
        """Yield what a message says."""
        if name in ("loop_extrinsic", "extrinsic"):
            # The header names the fixed frame, or nothing: the body has no name of its own.
            yield Extrinsic(self.body, xyz(message.pose.pose.position), xyzw(message.pose.pose.orientation))
        elif name in ("loop_intrinsics", "camera_info"):
            rig = measurement_from_message(CAMERA_INFO, message)
            assert isinstance(rig, CameraRig)
            yield rig
        elif name in ("loop_pose", "keyframe_pose", "odometry"):
            yield pose(message, is_keyframe=name == "keyframe_pose")
        else:
            yield self.features(message)

    def features(self, cloud: Any) -> Features:
        """Return what is in a cloud with a channel a point."""
        n, values = len(cloud.points), [channel.values for channel in cloud.channels]
        if len(values) != n or any(len(row) < _VALUES_OF_A_POINT for row in values):
            raise LayoutError(
                f"{n} points and {len(values)} channels of {sorted({len(row) for row in values})} values: expected a"
                f" channel of {_VALUES_OF_A_POINT} for each point{'' if n < 1 or len(values) > 9 else _OTHER}"
            )
        table = np.array([row[:_VALUES_OF_A_POINT] for row in values], np.float64).reshape(-1, _VALUES_OF_A_POINT)
        unseen = (table[:, 2:4] == 0.0).all(axis=1)
        normalised = np.where(table[:, :2].any(axis=1, keepdims=True), table[:, :2], np.nan)
        return Features(
            stamp_ns_from_message(cloud.header.stamp),
            ids=table[:, 4],
            uv=table[:, 2:4],
            camera=np.zeros(n, np.int64),
            normalised=normalised,
            point=_points(cloud),
            wrong={"not_seen_by_camera_0": unseen},
        )


_OTHER = "; a channel for each kind of value is what VINS-Mono's tracker sends (--from vins_mono)"


class OpenVins(_Vins):
    """``ov_msckf``: every image, camera 0 alone."""

    inputs = (
        Input("loop_pose", ODOMETRY, "pose"),
        Input("loop_feats", CLOUD, "features"),
        Input("loop_extrinsic", ODOMETRY, "extrinsic"),
        Input("loop_intrinsics", CAMERA_INFO),
    )
    every_image = True
    body = "imu"


class VinsFusion(_Vins):
    """``vins_estimator`` of VINS-Fusion, VINS-Mono and their ports: keyframes, camera 0 alone, solved points alone."""

    inputs = (
        Input("keyframe_pose", ODOMETRY, "pose"),
        Input("keyframe_point", CLOUD, "features"),
        Input("extrinsic", ODOMETRY, "extrinsic"),
        Input("camera_info", CAMERA_INFO),
    )


class VinsMono(_Vins):
    """``feature_tracker`` of VINS-Mono with the poses of its estimator."""

    inputs = (
        Input("feature", CLOUD, "features"),
        Input("keyframe_pose", ODOMETRY, "pose"),
        Input("odometry", ODOMETRY, "pose"),
        Input("extrinsic", ODOMETRY, "extrinsic"),
        Input("camera_info", CAMERA_INFO),
    )
    every_image = True

    def features(self, cloud: Any) -> Features:
        """Return what is in a cloud with a channel a kind of value."""
        points = _points(cloud)
        n, where = len(points), _columns(cloud)
        columns = {name: cloud.channels[i].values for name, i in where.items() if i < len(cloud.channels)}
        lengths = [len(column) for column in columns.values()]
        if lengths != [n] * len(where):
            raise LayoutError(
                f"{n} points and channels of {lengths} values: expected id, u, v of each point; a channel a point is"
                " what VINS-Fusion sends (--from vins_fusion)"
            )
        of = {name: np.array(column, np.float64) for name, column in columns.items()}
        ids, camera = of["id"], of.get("camera")
        if camera is None:
            camera = ids % self.cameras
            # Beyond what a float32 holds nothing can be said of the quotient either.
            ids = np.where(ids < self.max_id, np.floor(ids / self.cameras), ids)
        return Features(
            stamp_ns_from_message(cloud.header.stamp),
            ids=ids,
            uv=np.column_stack([of["u"], of["v"]]),
            camera=np.where(np.isfinite(camera), camera, -1.0).astype(np.int64),
            normalised=points[:, :2],
            point=nowhere(n, 3),
        )


def _columns(cloud: Any) -> dict[str, int]:
    """Return which channel holds what: by their names where these tell it, else by their number."""
    names = [str(channel.name).lower().removesuffix("_of_point").removesuffix("_id") for channel in cloud.channels]
    if {"id", "u", "v"} <= set(names):
        return {name: names.index(name) for name in ("id", "camera", "u", "v") if name in names}
    if len(names) >= _CHANNELS_OF_INPUT:
        return {"id": 0, "camera": 1, "u": 2, "v": 3}
    return {"id": 0, "u": 1, "v": 2}


def _points(cloud: Any) -> FloatArray:
    return np.array([(p.x, p.y, p.z) for p in cloud.points], np.float64).reshape(-1, 3)
