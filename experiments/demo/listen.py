# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Listen to a node: collect what it publishes about keyframes, points and solves."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.estimate import Poses
from ba_node.messages.factory import stamp_ns_from_message
from ba_node.messages.outputs import POINT_DTYPE
from ba_node.messages.topics import TOPICS, WHOLE_MAP
from ba_node.ros import qos
from ba_node.ros.message_factory import message_class
from ba_node.ros.tools.node import node_apart

_POLL_S = 0.05


class NodeListener:
    """Subscribe to the outputs of a node in a ROS context of its own. Use it as a context manager."""

    def __init__(self, node_name: str, domain: int | None = None) -> None:
        self.reports: list[Any] = []  # ``ba_msgs/SolverReport`` of every solve, oldest first
        self.points: NDArray[np.void] = np.empty(0, dtype=POINT_DTYPE)  # newest cloud as ``POINT_DTYPE`` records
        self.points_stamp_ns: int | None = None  # its stamp, ns
        self.points_frame = ""  # its frame
        self._node_name = node_name
        self._apart = node_apart("ba_listener", domain=domain)
        self._poses: dict[int, tuple[int, NDArray[np.float64], NDArray[np.float64]]] = {}

    def __enter__(self) -> NodeListener:
        node, self._executor = self._apart.__enter__()
        receivers = {"refined_keyframes": self._on_keyframes, "points": self._on_points, "report": self.reports.append}
        self._subscriptions = []
        for name, receive in receivers.items():
            topic = TOPICS[name]
            kind, full_name = message_class(topic.type_name), f"{self._node_name}/{name}"
            profile = qos.profile(topic) if name in WHOLE_MAP else qos.reliable(qos.OUTPUT_DEPTH)
            self._subscriptions.append(node.create_subscription(kind, full_name, receive, profile))
        return self

    def __exit__(self, *_: object) -> None:
        self._apart.__exit__(None, None, None)

    @property
    def connected(self) -> bool:
        """Return True if every subscription has found its publisher."""
        return all(subscription.get_publisher_count() for subscription in self._subscriptions)

    @property
    def keyframe_ids(self) -> set[int]:
        """Return the keyframes that have come back so far."""
        return set(self._poses)

    def poses(self) -> Poses:
        """Return the newest pose of every keyframe that came back, by time."""
        ids = sorted(self._poses, key=lambda key: self._poses[key][0])
        rows = [self._poses[key] for key in ids]
        return Poses(
            np.array(ids, dtype=np.uint64),
            np.array([row[0] for row in rows], dtype=np.int64),
            np.array([row[1] for row in rows]).reshape(-1, 3),
            np.array([row[2] for row in rows]).reshape(-1, 4),
        )

    def spin_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Receive until ``done()``; return False if that took longer than the timeout."""
        end = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=_POLL_S)
        return True

    def _on_keyframes(self, message: Any) -> None:
        positions = np.asarray(message.position).reshape(-1, 3)
        orientations = np.asarray(message.orientation).reshape(-1, 4)
        for row, (key, stamp_ns) in enumerate(zip(message.keyframe_id, message.stamp_ns, strict=True)):
            self._poses[int(key)] = (int(stamp_ns), positions[row], orientations[row])

    def _on_points(self, message: Any) -> None:
        self.points = np.frombuffer(bytes(message.data), dtype=POINT_DTYPE)
        self.points_stamp_ns = stamp_ns_from_message(message.header.stamp)
        self.points_frame = str(message.header.frame_id)
