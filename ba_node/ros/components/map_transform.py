# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish map -> odom on /tf, after each solve and between them, so that a lookup always finds it."""

from __future__ import annotations

from ba_node.estimate import Refinement
from ba_node.messages.cdr import tf_message
from ba_node.messages.topics import TF, TOPICS
from ba_node.ros import qos
from ba_node.ros.components.base import Component, Host
from ba_node.ros.log import Severity, log

_DEPTH = 100
_NS = 1e9


class MapTransform(Component):
    """The transform, stamped ahead of the data by the tolerance.

    The time of the data goes on from the newest keyframe as the node's clock does: so the stamps fit the data whether
    it comes from a robot, from a recording with its old stamps, or with simulated time. Within a session they only
    rise, as tf asks; a session that began because the clock was set back has stamps of its own.
    """

    def __init__(self, host: Host) -> None:
        """Advertise /tf; without tf2_msgs say that there is none."""
        super().__init__(host)
        self._taken: Refinement | None = None
        self._taken_ns = 0
        self._last_stamp_ns: int | None = None
        try:
            self._publisher = self.publisher(TOPICS[TF], qos.reliable(_DEPTH))
        except LookupError:
            self._publisher = None
            self._say("off: tf2_msgs is not installed")
            return
        self._say("")
        period_s = host.config.frames.publish_period_s
        if period_s > 0.0:
            self.timer(period_s, self._repeat)

    def deactivate(self) -> None:
        """Say nothing any more; what was said grows old."""
        self._taken = None

    def take_poses(self, taken: Refinement, _arrived_s: float) -> None:
        """Take the newest correction; that of another map ends with it, though the new one has none yet."""
        if self._taken is not None and self._taken.map_index != taken.map_index:
            self._taken = self._last_stamp_ns = None
        if not taken.replaces_map:
            return
        if taken.correction is None:  # all was forgotten
            self._taken = self._last_stamp_ns = None
            return
        if self._taken is None:
            self._last_stamp_ns = None
        self._taken, self._taken_ns = taken, self._now_ns()
        self._send(news=True)

    def _repeat(self) -> None:
        with self.host.leaving:
            self._send(news=False)

    def _send(self, *, news: bool) -> None:
        """Publish the correction with the time that the data has now."""
        taken = self._taken
        if taken is None or taken.correction is None or self._publisher is None:
            return
        if not self.host.config.frames.publish_tf:
            self._say("off: frames.publish_tf = false")
            return
        if taken.correction.odom_frame == taken.frame_id:
            self._say(f"off: keyframes are in {taken.frame_id!r} too; give frames.map_frame another name")
            return
        elapsed_ns = max(0, self._now_ns() - self._taken_ns)
        stamp_ns = taken.stamp_ns + elapsed_ns + int(self.host.config.frames.transform_tolerance * _NS)
        if self._last_stamp_ns is not None and stamp_ns <= self._last_stamp_ns:
            if not news:
                return
            stamp_ns = self._last_stamp_ns + 1
        self._last_stamp_ns = stamp_ns
        self._publisher.publish(tf_message(taken.correction, taken.frame_id, stamp_ns))
        self._say(f"{taken.frame_id} -> {taken.correction.odom_frame}")

    def _now_ns(self) -> int:
        return int(self.host.node.get_clock().now().nanoseconds)

    def _say(self, words: str) -> None:
        """Tell /diagnostics, and the log when it changes to a reason why there is none."""
        if words.startswith("off") and words != self.host.tf:
            log(self.host.node, Severity.WARNING, f"map -> odom on /tf is {words}")
        self.host.tf = words
