# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Take the places of the cameras on the body from /tf_static, where ``frames.extrinsics`` asks for it."""

from __future__ import annotations

import time
from typing import Any

from ba_node.measurements import CameraRig
from ba_node.messages.topics import TF_STATIC, TOPICS
from ba_node.messages.transforms import StaticTree
from ba_node.ros import qos
from ba_node.ros.components.base import Component, Host
from ba_node.ros.log import Severity, log
from ba_node.ros.worker.worker import Notice

_DEPTH = 100


class StaticFrames(Component):
    """Places cameras. A rig waits until the way from the body to every camera of it is known."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._tree = StaticTree()
        self._waiting: CameraRig | None = None
        if host.config.frames.extrinsics != "tf_static":
            return
        try:
            self.subscription(TOPICS[TF_STATIC], self._receive, qos.latched(_DEPTH))
        except LookupError:
            text = "frames.extrinsics = tf_static: tf2_msgs is not installed; cameras sit where camera_rig says"
            log(host.node, Severity.WARNING, text)
            return
        host.place_cameras = self._place

    def _receive(self, message: Any) -> None:
        """Take in transforms, and let a rig go on that has waited for them."""
        self._tree.add(message)
        waiting = self._waiting
        if waiting is not None and (placed := self._place(waiting)) is not None:
            self.host.inbox.put(placed, time.monotonic())

    def _place(self, rig: CameraRig) -> CameraRig | None:
        base = self.host.config.frames.base_frame
        placed, missing = self._tree.place(rig, base)
        self._waiting = rig if missing else None
        if missing:
            names = ", ".join(map(repr, missing))
            self.host.log(Notice(TF_STATIC, f"cameras wait for {TF_STATIC}: no way from {base!r} to {names}"))
            return None
        return placed
