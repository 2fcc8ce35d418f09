# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say so when no data comes: which topics, as resolved, and who publishes on them."""

from __future__ import annotations

import time
from collections import Counter

from rclpy.clock import Clock, ClockType

from ba_node.messages.topics import CAMERAS, INPUT_TYPES
from ba_node.ros.components.base import Component, Host
from ba_node.ros.worker.worker import Notice

_CHECK_S = 0.5
_NEEDED = ("keyframes", "feature_tracks")


class Silence(Component):
    """Warn when ``node.silence_s`` has passed without keyframes or tracks, and again each time it has doubled."""

    def __init__(self, host: Host) -> None:
        """Begin to wait."""
        super().__init__(host)
        # Silence is silence also while /clock stands still.
        self.timer(_CHECK_S, self._check, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._begin()

    def activate(self) -> None:
        """Wait anew."""
        self._begin()

    def _begin(self) -> None:
        now = time.monotonic()
        self._seen: Counter[str] = Counter()
        self._since = dict.fromkeys(_NEEDED, now)
        self._told = dict.fromkeys(_NEEDED, 0.0)

    def _check(self) -> None:
        now, limit = time.monotonic(), self.host.config.node.silence_s
        for topic in _NEEDED:
            if self.host.arrived[topic] != self._seen[topic]:
                self._since[topic], self._told[topic] = now, 0.0
        self._seen = Counter(self.host.arrived)
        silent = {topic: now - self._since[topic] for topic in _NEEDED}
        due = [topic for topic, time_s in silent.items() if time_s >= max(limit, 2 * self._told[topic])]
        if not self.host.active or not limit or not due:
            return
        self._told |= {topic: silent[topic] for topic in due}
        for topic in due:
            self.host.log(Notice(f"silence {topic}", f"no {topic} for {silent[topic]:.1f} s: {self._where(topic)}"))

    def _where(self, silent: str) -> str:
        """Say of a topic, and of the cameras if none came, who publishes there."""
        parts = [self._publishers(silent)]
        if not any(self.host.arrived[topic] for topic in CAMERAS):
            parts += ["no cameras came either", *(self._publishers(topic) for topic in CAMERAS)]
        return "; ".join(parts)

    def _publishers(self, topic: str) -> str:
        name = self.host.node.resolve_topic_name(topic)
        infos = self.host.node.get_publishers_info_by_topic(name)
        named = sorted(f"{i.node_namespace.rstrip('/')}/{i.node_name} ({i.topic_type})" for i in infos)
        who = f" from {', '.join(named)}" if named else ""
        plural = "" if len(infos) == 1 else "s"
        return f"{name} ({INPUT_TYPES[topic]}) has {len(infos)} publisher{plural}{who}"
