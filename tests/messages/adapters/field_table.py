# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Record a drive as each front-end publishes it, by the table of their fields alone; a second hand beside layouts.py.

The drive, its camera and its lens are made here with numpy, and share no code with what reads the recordings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.messages.adapters.layouts import CAMERA_INFO, CLOUD, ODOMETRY, Sent, make

Array = NDArray[np.float64]
F, CX, CY, WIDTH, HEIGHT = 420.0, 322.5, 241.0, 640, 480
LENS = (-0.21, 0.05, 0.0007, -0.0004)  # k1 k2 p1 p2
STEP_NS = 100_000_000
BEGIN_NS = 1_700_000_000_123_456_789
COUNT = 24
# Camera in the body: it looks along the body's x axis, which points ahead.
BODY_FROM_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
CAMERA_AT = np.array([0.3, 0.05, 0.4])


@dataclass
class Seen:
    """One image."""

    stamp_ns: int
    true: tuple[Array, Array]  # world from body: rotation, position
    told: tuple[Array, Array]  # as an odometry that drifts has it
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    uv: Array = field(default_factory=lambda: np.zeros((0, 2)))  # with the lens
    flat: Array = field(default_factory=lambda: np.zeros((0, 2)))  # x / z, y / z without it
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))  # in the fixed frame of the odometry


def turn(yaw: float) -> Array:
    """Return a rotation about the vertical axis."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def quaternion(rotation: Array) -> list[float]:
    """Return x, y, z, w of a rotation, by its eigenvector of eigenvalue 1 and its trace."""
    angle = np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0))
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    length = np.linalg.norm(axis)
    axis = axis / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
    return [*(np.sin(0.5 * angle) * axis).tolist(), float(np.cos(0.5 * angle))]


def bend(flat: Array) -> Array:
    """Return normalised points as the lens moves them (Brown's model)."""
    k1, k2, p1, p2 = LENS
    x, y = flat.T
    r = x * x + y * y
    radial = 1.0 + k1 * r + k2 * r * r
    return np.column_stack(
        [x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y]
    )


def drive(count: int = COUNT, *, lens: bool = True) -> list[Seen]:
    """Return a drive of 0.5 m an image past 1200 points, with an odometry that drifts by some per cent."""
    rng = np.random.default_rng(11)
    world = np.column_stack([rng.uniform(2, 30, 1200), rng.uniform(-9, 9, 1200), rng.uniform(-3, 4, 1200)])
    rotation, position = np.eye(3), np.zeros(3)
    told = rotation, position
    found = []
    for i in range(count):
        one = Seen(BEGIN_NS + i * STEP_NS, (rotation, position), told)
        camera = (world - position) @ rotation - CAMERA_AT
        camera = camera @ BODY_FROM_CAMERA
        ahead = camera[:, 2] > 0.5
        flat = camera[ahead, :2] / camera[ahead, 2:]
        uv = F * (bend(flat) if lens else flat) + [CX, CY] + rng.normal(0, 0.3, flat.shape)
        inside = (np.abs(uv - [320, 240]) < [315, 235]).all(axis=1) & (np.abs(flat) < 0.9).all(axis=1)
        one.ids, one.uv, one.flat = np.flatnonzero(ahead)[inside] + 1, uv[inside], flat[inside]
        body = (world[one.ids - 1] - position) @ rotation
        one.points = body @ told[0].T + told[1]
        found.append(one)
        step, move = turn(0.02 * np.sin(0.5 * i)), np.array([0.5, 0.0, 0.0])
        off = turn(rng.normal(0, 0.003)), move * (1.0 + rng.normal(0, 0.02)) + rng.normal(0, 0.004, 3)
        position, rotation = position + rotation @ move, rotation @ step
        told = told[0] @ step @ off[0], told[1] + told[0] @ off[1]
    return found


def header(stamp_ns: int, frame: str) -> Any:
    """Return a header."""
    stamp = make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def pose(at: tuple[Array, Array]) -> Any:
    """Return a geometry_msgs/Pose of a rotation and a position."""
    turned = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion(at[0]), strict=True)))
    placed = make("geometry_msgs/msg/Point", **dict(zip("xyz", at[1].tolist(), strict=True)))
    return make("geometry_msgs/msg/Pose", position=placed, orientation=turned)


def odometry(stamp_ns: int, frame: str, child: str, at: tuple[Array, Array]) -> Any:
    """Return a nav_msgs/Odometry."""
    with_covariance = make("geometry_msgs/msg/PoseWithCovariance", pose=pose(at), covariance=0.01 * np.eye(6).ravel())
    return make(ODOMETRY, header=header(stamp_ns, frame), child_frame_id=child, pose=with_covariance)


def camera_info(stamp_ns: int, frame: str, d: tuple[float, ...]) -> Any:
    """Return the camera's CameraInfo."""
    k = np.array([F, 0, CX, 0, F, CY, 0, 0, 1.0])
    p = np.insert(k, [3, 6, 9], 0.0)
    return make(
        CAMERA_INFO, header=header(stamp_ns, frame), width=WIDTH, height=HEIGHT, distortion_model="plumb_bob",
        d=np.array(d, float), k=k, r=np.eye(3).ravel(), p=p,
    )  # fmt: skip


def cloud(stamp_ns: int, frame: str, points: Array, channels: list[Any]) -> Any:
    """Return a sensor_msgs/PointCloud with unnamed channels."""
    of = [make("geometry_msgs/msg/Point32", **dict(zip("xyz", point, strict=True))) for point in points.tolist()]
    values = [make("sensor_msgs/msg/ChannelFloat32", values=np.array(one, np.float32)) for one in channels]
    return make(CLOUD, header=header(stamp_ns, frame), points=of, channels=values)


EXTRINSIC = (BODY_FROM_CAMERA, CAMERA_AT)


def openvins(seen: list[Seen], space: str = "/ov") -> Iterator[Sent]:
    """Every image; of points that camera 0 does not see, u = v = 0."""
    for i, one in enumerate(seen):
        at = one.stamp_ns
        yield Sent(f"{space}/loop_pose", ODOMETRY, odometry(at, "global", "imu", one.told), at)
        yield Sent(f"{space}/loop_extrinsic", ODOMETRY, odometry(at, "imu", "cam0", EXTRINSIC), at)
        yield Sent(f"{space}/loop_intrinsics", CAMERA_INFO, camera_info(at, "cam0", LENS), at)
        table = np.column_stack([0 * one.uv, one.uv, one.ids])
        table[i % 7 :: 11, 2:4] = 0.0
        yield Sent(f"{space}/loop_feats", CLOUD, cloud(at, "global", one.points, table.tolist()), at)


def through_a_double(stamp_ns: int) -> int:
    """Return a stamp that went through a number of seconds: good for 120 ns."""
    seconds = stamp_ns / 1e9
    return int(seconds) * 10**9 + int((seconds - int(seconds)) * 1e9)


def vins_fusion(seen: list[Seen], late: int = 8) -> Iterator[Sent]:
    """Keyframes, 8 images late (WINDOW_SIZE - 2 of 10); solved points alone; two stamps of one image."""
    for i, now in enumerate(seen):
        yield Sent("/extrinsic", ODOMETRY, odometry(now.stamp_ns, "world", "", EXTRINSIC), now.stamp_ns)
        if i < late:
            continue
        one = seen[i - late]
        at = through_a_double(one.stamp_ns)
        yield Sent("/keyframe_pose", ODOMETRY, odometry(at, "world", "", one.told), now.stamp_ns)
        solved = np.arange(len(one.ids)) % 5 > 0
        table = np.column_stack([one.flat, one.uv, one.ids])[solved]
        content = cloud(one.stamp_ns, "world", one.points[solved], table.tolist())
        yield Sent("/keyframe_point", CLOUD, content, now.stamp_ns)


def vins_mono(seen: list[Seen], cameras: int = 1) -> Iterator[Sent]:
    """The tracker's cloud: a channel each of id * NUM_OF_CAM + cam, u, v, vx, vy; normalised points."""
    for one in seen:
        at, nothing = one.stamp_ns, 0.0 * one.ids
        channels = [one.ids * cameras, one.uv[:, 0], one.uv[:, 1], nothing, nothing]
        flat = np.column_stack([one.flat, 1.0 + nothing])
        yield Sent("/feature_tracker/feature", CLOUD, cloud(at, "world", flat, channels), at)
        yield Sent("/vins_estimator/odometry", ODOMETRY, odometry(at, "world", "world", one.told), at)
        yield Sent("/vins_estimator/extrinsic", ODOMETRY, odometry(at, "world", "", EXTRINSIC), at)


def _keypoints(uv: Array) -> list[Any]:
    return [
        make("rtabmap_msgs/msg/KeyPoint", pt=make("rtabmap_msgs/msg/Point2f", x=float(u), y=float(v))) for u, v in uv
    ]


def _points(points: Array) -> list[Any]:
    return [make("rtabmap_msgs/msg/Point3f", **dict(zip("xyz", one, strict=True))) for one in points.tolist()]


def _transform() -> Any:
    place = pose(EXTRINSIC)
    move = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", CAMERA_AT.tolist(), strict=True)))
    return make("geometry_msgs/msg/Transform", translation=move, rotation=place.orientation)


def rtabmap(seen: list[Seen]) -> Iterator[Sent]:
    """`odom` and `odom_info` of F2M odometry with FillInfoData; the last ids of an image are not of the local map."""
    for i, one in enumerate(seen):
        at, ids = one.stamp_ns, one.ids.astype(np.int32)
        yield Sent("/rtabmap/odom", ODOMETRY, odometry(at, "odom", "base_link", one.told), at)
        known = np.arange(len(ids)) < len(ids) - 6
        model = make("rtabmap_msgs/msg/CameraModel", camera_info=camera_info(at, "", ()), local_transform=_transform())
        info = make(
            "rtabmap_msgs/msg/OdomInfo",
            header=header(at, "odom"),
            key_frame_added=i % 5 == 0,
            words_keys=np.where(known, ids, 100_000 + ids).astype(np.int32),
            words_values=_keypoints(one.uv),
            word_inliers=ids[known],
            local_bundle_ids=np.array([i + 1], np.int32),
            local_bundle_poses=[pose(one.told)],
            local_bundle_models=[make("rtabmap_msgs/msg/CameraModels", models=[model])],
            local_map_keys=ids[known],
            local_map_values=_points(one.points[known]),
        )
        yield Sent("/rtabmap/odom_info", "rtabmap_msgs/msg/OdomInfo", info, at)


def rtabmap_map(seen: list[Seen]) -> Iterator[Sent]:
    """`mapData`: a node an image, whose words are of a vocabulary; every 30th word is one of something else."""
    for i, one in enumerate(seen):
        n = len(one.ids)
        order = np.random.default_rng(i).permutation(n)
        words = np.where(np.arange(n) % 30 == i % 30, 1 + (one.ids + 600) % 1200, one.ids)
        body = (one.points - one.told[1]) @ one.told[0]
        data = make(
            "rtabmap_msgs/msg/SensorData", left_camera_info=[camera_info(one.stamp_ns, "", ())],
            local_transform=[_transform()],
        )  # fmt: skip
        node = make(
            "rtabmap_msgs/msg/Node", id=i + 1, stamp=one.stamp_ns / 1e9, pose=pose(one.told),
            word_id_keys=words.astype(np.int32), word_id_values=np.argsort(order).astype(np.int32),
            word_kpts=_keypoints(one.uv[order]), word_pts=_points(body[order]), data=data,
        )  # fmt: skip
        content = make("rtabmap_msgs/msg/MapData", header=header(one.stamp_ns, "map"), nodes=[node])
        yield Sent("/rtabmap/mapData", "rtabmap_msgs/msg/MapData", content, one.stamp_ns + 2 * 10**8)
