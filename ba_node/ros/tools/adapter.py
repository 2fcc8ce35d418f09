# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn feature clouds and keyframe odometry, as VINS-Fusion publishes them, into keyframes and tracks: `ba_adapter`.

Takes ``features`` (sensor_msgs/PointCloud, one of all cameras for each image), ``odometry`` (nav_msgs/Odometry, the
pose of the body at keyframes) and ``restart`` (std_msgs/Bool); gives ``keyframes`` and ``feature_tracks``. Features and
odometry are paired by equal stamps; features of images that are no keyframes find no partner and are dropped.

Channels are found by their names id, camera, u, v (px), or without names in that order, which is VINS-Fusion's. An id
is a float32 there, exact below 2^24; larger ones are dropped and counted. The stamp in ns is the keyframe's id.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from ba_node.measurements import FeatureTracks, Keyframe
from ba_node.messages import conversion
from ba_node.messages.factory import stamp_ns_from_message
from ba_node.messages.topics import INPUT_TYPES
from ba_node.ros import qos
from ba_node.ros.convert import RclpyFactory, message_class
from ba_node.ros.log import Throttle

NODE_NAME = "ba_adapter"
CHANNELS = ("id", "camera", "u", "v")
MAX_ID = 2**24
MAX_CAMERA = 2**16
_DEPTH = 100
# Images that wait for their pose, and poses that wait for their image.
MAX_WAITING = 200
_LOG_PERIOD_S = 5.0


class FeatureError(ValueError):
    """A feature cloud that cannot be read."""


def tracks_from_cloud(cloud: Any, session_id: int, counted: Counter[str]) -> list[FeatureTracks]:
    """Return what each camera saw, from a ``sensor_msgs/PointCloud``; unusable rows are left out and counted.

    Raises:
        FeatureError: channels are missing or differ in length.
    """
    named = {channel.name: channel.values for channel in cloud.channels}
    values = [named[name] for name in CHANNELS] if named.keys() >= set(CHANNELS) else []
    values = values or [channel.values for channel in cloud.channels[: len(CHANNELS)]]
    lengths = [len(column) for column in values]
    if len(values) < len(CHANNELS) or len(set(lengths)) != 1:
        raise FeatureError(f"{len(cloud.channels)} channels of lengths {lengths}: expected id, camera, u, v")
    ids, cameras, u, v = (np.asarray(column, np.float64) for column in values)
    good = (ids >= 0) & (ids < MAX_ID) & (ids % 1 == 0) & (cameras >= 0) & (cameras < MAX_CAMERA) & (cameras % 1 == 0)
    counted["inexact_id"] += int(np.count_nonzero(~good))
    return [
        FeatureTracks(
            session_id,
            stamp_ns_from_message(cloud.header.stamp),
            int(camera),
            ids[rows].astype(np.uint64),
            np.column_stack([u[rows], v[rows]]),
        )
        for camera in np.unique(cameras[good])
        for rows in [good & (cameras == camera)]
    ]


def keyframe_from_odometry(odometry: Any, session_id: int) -> Keyframe:
    """Return the pose of a ``nav_msgs/Odometry`` as a keyframe whose id is its stamp, ns."""
    stamp_ns = stamp_ns_from_message(odometry.header.stamp)
    p, q = odometry.pose.pose.position, odometry.pose.pose.orientation
    position, orientation = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
    return Keyframe(session_id, stamp_ns, stamp_ns, odometry.header.frame_id, position, orientation)


class Adapter(Node):  # type: ignore[misc]  # rclpy is not typed
    """The converter node."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__(NODE_NAME, **node_options)
        self.sent = 0  # keyframes that were sent on
        self.counted: Counter[str] = Counter()  # what was dropped, by reason
        self._session_id = 0
        # By stamp, ns; the newest of them.
        self._features: dict[int, Any] = {}
        self._odometry: dict[int, Any] = {}
        self._factory = RclpyFactory()
        self._throttle = Throttle(_LOG_PERIOD_S)
        self._out = {
            topic: self.create_publisher(message_class(INPUT_TYPES[topic]), topic, qos.reliable(_DEPTH))
            for topic in ("keyframes", "feature_tracks")
        }
        for topic, kind, receive in (
            ("features", "sensor_msgs/msg/PointCloud", self._on_features),
            ("odometry", "nav_msgs/msg/Odometry", self._on_odometry),
            ("restart", "std_msgs/msg/Bool", self._on_restart),
        ):
            self.create_subscription(message_class(kind), topic, receive, qos.reliable(_DEPTH))

    def _on_features(self, cloud: Any) -> None:
        stamp_ns = stamp_ns_from_message(cloud.header.stamp)
        odometry = self._odometry.pop(stamp_ns, None)
        if odometry is None:
            self.counted["no_keyframe"] += keep(self._features, stamp_ns, cloud)
        else:
            self._send(odometry, cloud)

    def _on_odometry(self, odometry: Any) -> None:
        stamp_ns = stamp_ns_from_message(odometry.header.stamp)
        cloud = self._features.pop(stamp_ns, None)
        if cloud is not None:
            self._send(odometry, cloud)
        elif keep(self._odometry, stamp_ns, odometry):
            self._drop("no_features", f"{MAX_WAITING} poses wait for features of the same stamp")

    def _on_restart(self, restart: Any) -> None:
        """Begin a new session: ids of features begin anew."""
        if restart.data:
            self._session_id += 1
            self._features.clear()
            self._odometry.clear()
            self.get_logger().info(f"restart: session {self._session_id}")

    def _send(self, odometry: Any, cloud: Any) -> None:
        try:
            tracks = tracks_from_cloud(cloud, self._session_id, self.counted)
        except FeatureError as error:
            self._drop("malformed", f"features: {error}")
            return
        keyframe = keyframe_from_odometry(odometry, self._session_id)
        self._out["keyframes"].publish(conversion.keyframe_message(self._factory, keyframe))
        for image in tracks:
            message = conversion.tracks_message(self._factory, image, keyframe.stamp_ns, f"camera{image.camera_index}")
            self._out["feature_tracks"].publish(message)
        self.sent += 1

    def _drop(self, reason: str, what: str) -> None:
        self.counted[reason] += 1
        if self._throttle.passes(reason, time.monotonic()):
            self.get_logger().warning(f"{what}; dropped ({reason} = {self.counted[reason]})")


def keep(waiting: dict[int, Any], stamp_ns: int, message: Any) -> int:
    """Have a message wait for the other one of its pair; return how many were dropped for it."""
    waiting[stamp_ns] = message
    if len(waiting) <= MAX_WAITING:
        return 0
    del waiting[next(iter(waiting))]
    return 1


def main(args: Sequence[str] | None = None) -> int:
    """Run the converter until SIGINT or SIGTERM."""
    rclpy.init(args=None if args is None else list(args))
    node = Adapter()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        dropped = ", ".join(f"{reason} = {n}" for reason, n in sorted(node.counted.items()) if n) or "nothing"
        print(f"stopped: {node.sent} keyframes sent on, dropped: {dropped}", flush=True)
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
