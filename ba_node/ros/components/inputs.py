# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Subscribe to keyframes, tracks, guesses and cameras, and hand them to the worker."""

from __future__ import annotations

import functools
import pickle
import time
from typing import Any

from ba_node.measurements import CameraRig, Measurement
from ba_node.messages.conversion import measurement_from_message
from ba_node.messages.topics import CAMERAS, INPUT_TYPES, TOPICS
from ba_node.ros import qos
from ba_node.ros.components.base import Component, Host
from ba_node.ros.worker.worker import Notice


class Inputs(Component):
    """The inputs of the node. Cameras are taken at any time: they may be sent only once, before the node is active."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._rigs: dict[str, bytes] = {}
        self._last: dict[str, Any] = {}
        for topic, kind in INPUT_TYPES.items():
            receive = functools.partial(self._receive, topic, kind)
            # One solve may take long: as many messages as a window takes must be able to wait.
            depth = max(host.config.node.queue_depth, host.config.window.max_keyframes)
            self.subscription(TOPICS[topic], receive, qos.profile(TOPICS[topic], depth))
            if topic in CAMERAS:
                self.subscription(TOPICS[topic], receive, qos.SENSOR_DATA, **qos.at_peace())

    def _receive(self, topic: str, kind: str, message: Any) -> None:
        """Hand a message to the worker. What cannot be read is counted; it must not end the node."""
        counted = self.host.counted
        self.host.arrived[topic] += 1
        if self.host.ignoring and topic not in CAMERAS:
            counted.update(self.host.ignoring)
            return
        if topic in CAMERAS and self._came_twice(topic, message):
            return
        try:
            measurement: Measurement | None = measurement_from_message(kind, message)
            if isinstance(measurement, CameraRig):
                measurement = self._placed(measurement) if self._is_news(topic, measurement) else None
            if measurement is None:
                return
            self.host.inbox.put(measurement, time.monotonic())
        except Exception as error:
            counted["unreadable"] += 1
            name = self.host.node.resolve_topic_name(topic)
            self.host.log(Notice("unreadable", f"{name}: {error}; dropped (unreadable = {counted['unreadable']})"))

    def _placed(self, rig: CameraRig) -> CameraRig | None:
        for note in rig.notes:
            self.host.log(Notice("camera_adjusted", note))
        return rig if rig.malformed else self.host.place_cameras(rig)

    def _came_twice(self, topic: str, message: Any) -> bool:
        """Return True for what the other subscription of this topic has brought already."""
        again = bool(self._last.get(topic) == message)
        self._last[topic] = message
        return again

    def _is_news(self, topic: str, rig: CameraRig) -> bool:
        """Return False for cameras that came before (drivers repeat them with each image) or that a rig overrules."""
        content = pickle.dumps(rig)
        known = self._rigs.get(topic) == content
        if topic == "camera_info" and "camera_rig" in self._rigs:
            self.host.log(Notice("camera_info", "camera_info is ignored: camera_rig gives the cameras"))
            return False
        if not rig.malformed:
            self._rigs[topic] = content
        return not known
