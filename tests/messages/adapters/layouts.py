# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make what front-ends publish of a synthetic scene, field by field as their sources have it.

The messages are those of rosbags and are written by rosbags' own writer; definitions of rtabmap_msgs are the fields
that matter here, in the order of the package.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ba_node.arrays import FloatArray
from ba_node.core import cameras, geometry
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

ODOMETRY, CLOUD = "nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
# The fields of rtabmap_msgs that matter here; the tests over a middleware are built from the same files.
DEFINITIONS = Path(__file__).resolve().parents[2] / "ros" / "interfaces" / "rtabmap_msgs" / "msg"


class Sent(NamedTuple):
    """A message on its way."""

    topic: str
    type_name: str
    message: Any
    at_ns: int  # when it is published


@functools.cache
def store() -> Typestore:
    """Return the types of Jazzy with those of rtabmap."""
    made = get_typestore(Stores.ROS2_JAZZY)
    for file in sorted(DEFINITIONS.glob("*.msg")):
        made.register(get_types_from_msg(file.read_text(), f"rtabmap_msgs/msg/{file.stem}"))
    return made


def make(type_name: str, **fields: Any) -> Any:
    """Return a message; fields that are not given are zero or empty."""
    known = store()
    values = {name: fields.pop(name) if name in fields else _zero(kind) for name, kind in
              known.fielddefs[type_name][1]}  # fmt: skip
    assert not fields, f"{type_name} has no {fields}"
    return known.types[type_name](**values)


def _zero(kind: Any) -> Any:
    code, value = int(kind[0]), kind[1]
    if code == 1:
        return "" if value[0] == "string" else known_zero(value[0])
    if code == 2:
        return make(value)
    inner, count = value
    if int(inner[0]) == 1 and inner[1][0] != "string":
        return np.zeros(count, {"bool": np.bool_}.get(inner[1][0], inner[1][0]))
    return []


def known_zero(base: str) -> Any:
    """Return the zero of a number."""
    return False if base == "bool" else 0.0 if base.startswith("float") else 0


def write(path: Path, messages: Iterable[Sent]) -> Path:
    """Write a recording with rosbags; return its folder."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        channels: dict[str, Any] = {}
        for sent in messages:
            if sent.topic not in channels:
                channels[sent.topic] = writer.add_connection(sent.topic, sent.type_name, typestore=store())
            writer.write(channels[sent.topic], sent.at_ns, store().serialize_cdr(sent.message, sent.type_name))
    return path


@functools.cache
def scene(keyframes: int = 12, distortion: str = "plumb_bob", **options: Any) -> SyntheticData:
    """Return a drive down a street without outliers, every entry an image of a source."""
    size = {"keyframes": keyframes, "length_m": 10.0, "landmarks": 4000, "tracks": 150}
    drift = {"drift_rotation_deg": 0.5, "drift_translation": 0.03}
    return generate(SyntheticOptions(seed=3, path="line", outlier_share=0.0, distortion=distortion, noise_px=0.3,
                                     **(size | drift | options)))  # fmt: skip


def header(stamp_ns: int, frame_id: str) -> Any:
    """Return a header."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    return make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec),
                frame_id=frame_id)  # fmt: skip


def pose_at(position: Any, orientation: Any) -> Any:
    """Return a geometry_msgs/Pose."""
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, position), strict=True))),
        orientation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, orientation), strict=True))),
    )


def transform_at(position: Any, orientation: Any) -> Any:
    """Return a geometry_msgs/Transform."""
    return make(
        "geometry_msgs/msg/Transform",
        translation=make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, position), strict=True))),
        rotation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, orientation), strict=True))),
    )


def odometry(
    stamp_ns: int, frame: str, position: Any, orientation: Any, child: str = "", covariance: float = 0.0
) -> Any:
    """Return a nav_msgs/Odometry."""
    with_covariance = make("geometry_msgs/msg/PoseWithCovariance", pose=pose_at(position, orientation),
                           covariance=np.eye(6).reshape(-1) * covariance)  # fmt: skip
    return make(ODOMETRY, header=header(stamp_ns, frame), child_frame_id=child, pose=with_covariance)


def camera_info(
    rig: CameraRig, i: int, stamp_ns: int, frame: str, coefficients: int = 5, *, rectified: bool = False
) -> Any:
    """Return the CameraInfo of a camera."""
    fx, fy, cx, cy = rig.intrinsics[i].tolist()
    d = np.zeros(5) if rectified else rig.distortion[i][:coefficients]
    width, height = (int(value) for value in rig.image_size[i])
    return make(
        CAMERA_INFO,
        header=header(stamp_ns, frame),
        width=width,
        height=height,
        distortion_model="plumb_bob",
        d=d,
        k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]),
        r=np.eye(3).reshape(-1),
        p=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]),
    )


def cloud(stamp_ns: int, frame: str, points: FloatArray, channels: Sequence[tuple[str, Any]]) -> Any:
    """Return a sensor_msgs/PointCloud; values become float32."""
    return make(
        CLOUD,
        header=header(stamp_ns, frame),
        points=[make("geometry_msgs/msg/Point32", x=float(x), y=float(y), z=float(z)) for x, y, z in points],
        channels=[
            make("sensor_msgs/msg/ChannelFloat32", name=name, values=np.array(values, np.float32))
            for name, values in channels
        ],
    )


def normalised(data: SyntheticData, tracks: FeatureTracks) -> FloatArray:
    """Return the undistorted x / z, y / z of tracks, (n, 2)."""
    rig, i = data.rig, tracks.camera_index
    model, params = cameras.parameters(rig.models[i], rig.intrinsics[i], rig.distortion[i])
    n = len(tracks.uv)
    return cameras.normalise(tracks.uv, np.full(n, int(model), np.uint8), np.tile(params, (n, 1)))


def points(data: SyntheticData, tracks: FeatureTracks) -> FloatArray:
    """Return the points of tracks in the fixed frame, (n, 3) m."""
    of_track = dict(zip(data.track_id.tolist(), data.track_landmark.tolist(), strict=True))
    return data.landmarks[[of_track[int(track)] for track in tracks.track_id]]


def images(data: SyntheticData) -> Iterator[tuple[Keyframe, FeatureTracks]]:
    """Yield each image's pose and what camera 0 saw."""
    for keyframe, tracks in zip(data.keyframes, data.tracks, strict=True):
        yield keyframe, tracks[0]


def openvins(data: SyntheticData, space: str = "/ov_msckf") -> Iterator[Sent]:
    """Yield what OpenVINS publishes: three points a cloud are not seen by camera 0."""
    rig = data.rig
    for keyframe, tracks in images(data):
        stamp = keyframe.stamp_ns
        pose = odometry(stamp, "global", keyframe.position, keyframe.orientation)
        yield Sent(f"{space}/loop_pose", ODOMETRY, pose, stamp)
        place = odometry(stamp, "imu", rig.position[0], rig.orientation[0])
        yield Sent(f"{space}/loop_extrinsic", ODOMETRY, place, stamp)
        yield Sent(f"{space}/loop_intrinsics", CAMERA_INFO, camera_info(rig, 0, stamp, "cam0", 4), stamp)
        xyz = np.concatenate([np.ones((3, 3)), points(data, tracks)])
        rows = [[0.0, 0.0, 0.0, 0.0, 90000.0 + i] for i in range(3)]
        rows += [[0.0, 0.0, u, v, float(i)] for (u, v), i in zip(tracks.uv, tracks.track_id, strict=True)]
        yield Sent(f"{space}/loop_feats", CLOUD, cloud(stamp, "global", xyz, [("", row) for row in rows]), stamp)


def vins_fusion(data: SyntheticData, late: int = 3, apart_ns: int = 120) -> Iterator[Sent]:
    """Yield what VINS-Fusion publishes: keyframes some images late, stamps of pose and cloud apart."""
    rig, seen = data.rig, list(images(data))
    for now, (image, _) in enumerate(seen):
        at = image.stamp_ns
        place = odometry(at, "world", rig.position[0], rig.orientation[0])
        yield Sent("/vins_estimator/extrinsic", ODOMETRY, place, at)
        if now < late:
            continue
        keyframe, tracks = seen[now - late]
        pose = odometry(keyframe.stamp_ns, "world", keyframe.position, keyframe.orientation)
        yield Sent("/vins_estimator/keyframe_pose", ODOMETRY, pose, at)
        table = zip(normalised(data, tracks), tracks.uv, tracks.track_id, strict=True)
        rows = [("", [*ray, *pixel, float(i)]) for ray, pixel, i in table]
        message = cloud(keyframe.stamp_ns + apart_ns * (-1) ** now, "world", points(data, tracks), rows)
        yield Sent("/vins_estimator/keyframe_point", CLOUD, message, at)


def vins_mono(data: SyntheticData, cameras: int = 1, late: int = 3) -> Iterator[Sent]:
    """Yield what VINS-Mono publishes: a cloud of every image, and keyframes of every second one, late."""
    rig, seen = data.rig, list(zip(data.keyframes, data.tracks, strict=True))
    for now, (image, all_tracks) in enumerate(seen):
        at = image.stamp_ns
        own = all_tracks[:cameras]
        rays = np.concatenate([normalised(data, tracks) for tracks in own])
        pixels = np.concatenate([tracks.uv for tracks in own])
        ids = np.concatenate([tracks.track_id.astype(float) * cameras + tracks.camera_index for tracks in own])
        columns = [("id", ids), ("u", pixels[:, 0]), ("v", pixels[:, 1]), ("vx", 0.0 * ids), ("vy", 0.0 * ids)]
        flat = np.column_stack([rays, np.ones(len(rays))])
        yield Sent("/feature_tracker/feature", CLOUD, cloud(at, "world", flat, columns), at)
        place = odometry(at, "world", rig.position[0], rig.orientation[0])
        yield Sent("/vins_estimator/extrinsic", ODOMETRY, place, at)
        if now >= late and (now - late) % 2 == 0:
            keyframe = seen[now - late][0]
            pose = odometry(keyframe.stamp_ns, "world", keyframe.position, keyframe.orientation)
            yield Sent("/vins_estimator/keyframe_pose", ODOMETRY, pose, at)


def rtabmap(data: SyntheticData, *, bundle: bool = True, added: int = 1000) -> Iterator[Sent]:
    """Yield what rtabmap_odom publishes: some words are new and not in the local map, some are outliers."""
    for now, (keyframe, tracks) in enumerate(images(data)):
        stamp = keyframe.stamp_ns
        pose = odometry(stamp, "odom", keyframe.position, keyframe.orientation, "base_link", 1e-3)
        yield Sent("/odom", ODOMETRY, pose, stamp)
        keys = tracks.track_id.astype(np.int32) + 1
        fresh = np.arange(5, dtype=np.int32) + added  # given to other points in the next image
        pixels = np.concatenate([tracks.uv, np.random.default_rng(now).uniform(0, 400, (5, 2))])
        pixels[0] += 60.0  # matched, and no inlier
        models = make("rtabmap_msgs/msg/CameraModels", models=[_model(data.rig, stamp)])
        message = make(
            "rtabmap_msgs/msg/OdomInfo",
            header=header(stamp, "odom"),
            key_frame_added=now % 4 == 0,
            local_bundle_ids=np.array([now] if bundle else [], np.int32),
            local_bundle_models=[models] if bundle else [],
            local_bundle_poses=[pose_at(keyframe.position, keyframe.orientation)] if bundle else [],
            words_keys=np.concatenate([keys, fresh]),
            words_values=[_keypoint(uv) for uv in pixels],
            word_matches=keys,
            word_inliers=keys[1:],
            local_map_keys=keys,
            local_map_values=[_point(xyz) for xyz in points(data, tracks)],
        )
        yield Sent("/odom_info", "rtabmap_msgs/msg/OdomInfo", message, stamp)


def rtabmap_map(data: SyntheticData, *, stereo: bool = False) -> Iterator[Sent]:
    """Yield what rtabmap_slam publishes: a node an image, one of them twice; one word is there twice, one is none."""
    before = None
    for now, (keyframe, tracks) in enumerate(images(data)):
        rotation = geometry.matrix_from_quaternion(keyframe.orientation)
        body = (points(data, tracks) - keyframe.position) @ rotation
        keys = np.concatenate([[-1, 500, 500], tracks.track_id.astype(np.int64) + 1]).astype(np.int32)
        pixels = np.concatenate([np.full((3, 2), 100.0), tracks.uv])
        xyz = np.concatenate([np.full((3, 3), np.nan), body])
        rows = np.random.default_rng(now).permutation(len(keys)).astype(np.int32)  # keypoints come in another order
        data_of = make(
            "rtabmap_msgs/msg/SensorData",
            left_camera_info=[camera_info(data.rig, 0, keyframe.stamp_ns, "", rectified=True)],
            right_camera_info=[camera_info(data.rig, 1, keyframe.stamp_ns, "", rectified=True)] if stereo else [],
            local_transform=[transform_at(data.rig.position[0], data.rig.orientation[0])],
        )
        back = np.argsort(rows)
        node = make(
            "rtabmap_msgs/msg/Node",
            id=now + 7,
            stamp=keyframe.stamp_ns / 1e9,
            pose=pose_at(keyframe.position, keyframe.orientation),
            word_id_keys=keys,
            word_id_values=rows,
            word_kpts=[_keypoint(pixels[i]) for i in back],
            word_pts=[_point(xyz[i]) for i in back],
            data=data_of,
        )
        nodes = [node] if before is None else [before, node]
        message = make("rtabmap_msgs/msg/MapData", header=header(keyframe.stamp_ns, "map"), nodes=nodes)
        yield Sent("/rtabmap/mapData", "rtabmap_msgs/msg/MapData", message, keyframe.stamp_ns + 10**8)
        before = node


def _model(rig: CameraRig, stamp_ns: int) -> Any:
    return make("rtabmap_msgs/msg/CameraModel", camera_info=camera_info(rig, 0, stamp_ns, "", rectified=True),
                local_transform=transform_at(rig.position[0], rig.orientation[0]))  # fmt: skip


def _keypoint(uv: FloatArray) -> Any:
    pt = make("rtabmap_msgs/msg/Point2f", x=float(uv[0]), y=float(uv[1]))
    return make("rtabmap_msgs/msg/KeyPoint", pt=pt, size=7.0, octave=0)


def _point(xyz: FloatArray) -> Any:
    return make("rtabmap_msgs/msg/Point3f", x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))
