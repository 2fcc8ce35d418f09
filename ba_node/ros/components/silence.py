# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say so when no data comes, and from whom it should; and when the time that the node goes by stands still."""

from __future__ import annotations

import time

from ba_node.messages.topics import CAMERAS, CLOCK, INPUT_TYPES
from ba_node.ros import qos
from ba_node.ros.components.base import Component, Host
from ba_node.ros.worker.worker import Notice

_CHECK_S = 0.5
_NEEDED = ("keyframes", "feature_tracks")
# Without a change of the time for so long it is said.
_CLOCK_PATIENCE_S = 3.0


class _Wait:
    """How long something has not changed; due after some patience, and again each time that has doubled."""

    def __init__(self) -> None:
        self._seen: object = None
        self.begin(None)

    def begin(self, seen: object) -> None:
        """Wait anew."""
        self._seen, self._since_s, self._said_s = seen, time.monotonic(), 0.0

    def look(self, seen: object) -> float:
        """Return how long it has been as it is now, s."""
        if seen != self._seen:
            self.begin(seen)
        return time.monotonic() - self._since_s

    def is_due(self, patience_s: float) -> bool:
        """Return True if it is time to say it."""
        lasted_s = time.monotonic() - self._since_s
        if lasted_s < max(patience_s, 2.0 * self._said_s):
            return False
        self._said_s = lasted_s
        return True


class Silence(Component):
    """Warn when ``node.silence_s`` has passed without keyframes or tracks."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._waits = {topic: _Wait() for topic in _NEEDED}
        self.timer(_CHECK_S, self._check)

    def activate(self) -> None:
        """Wait anew."""
        for topic, wait in self._waits.items():
            wait.begin(self.host.arrived[topic])

    def _check(self) -> None:
        limit_s = self.host.config.node.silence_s
        for topic, wait in self._waits.items():
            lasted_s = wait.look(self.host.arrived[topic])
            if self.host.active and limit_s and wait.is_due(limit_s):
                text = f"no {topic} for {lasted_s:.1f} s: {self._where(topic)}"
                self.host.log(Notice(f"silence {topic}", text))

    def _where(self, silent: str) -> str:
        """Say of a topic, and of the cameras if none came, who publishes there."""
        parts = [self._publishers(silent)]
        if not any(self.host.arrived[topic] for topic in CAMERAS):
            parts += ["no cameras came either", *(self._publishers(topic) for topic in CAMERAS)]
        return "; ".join(parts)

    def _publishers(self, topic: str) -> str:
        name = self.host.node.resolve_topic_name(topic)
        infos = self.host.node.get_publishers_info_by_topic(name)
        named = ", ".join(sorted(f"{qos.peer_name(info)} ({info.topic_type})" for info in infos))
        return f"{name} ({INPUT_TYPES[topic]}) has {_publishers(len(infos))}{f' from {named}' if named else ''}"


class SimulatedTime(Component):
    """Warn when the node is to go by simulated time (``use_sim_time``) and none comes, or it stands still."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._wait = _Wait()
        self.timer(_CHECK_S, self._check)

    def _check(self) -> None:
        node = self.host.node
        time_ns = int(node.get_clock().now().nanoseconds)
        still_s = self._wait.look(time_ns)
        is_still = still_s >= _CLOCK_PATIENCE_S and node.get_parameter("use_sim_time").value
        self.host.clock = self._words(time_ns, still_s) if is_still else ""
        if is_still and self._wait.is_due(_CLOCK_PATIENCE_S):
            self.host.log(Notice(CLOCK, self.host.clock))

    def _words(self, time_ns: int, still_s: float) -> str:
        names = sorted(qos.peer_name(info) for info in self.host.node.get_publishers_info_by_topic(CLOCK))
        who = f" ({', '.join(names)})" if names else ""
        who = f"{CLOCK} has {_publishers(len(names))}{who}"
        if time_ns:
            return f"use_sim_time is true and the time has stood still for {still_s:.0f} s: {who}"
        return (
            f"use_sim_time is true and no time has come for {still_s:.0f} s: {who}; start the simulation, play with"
            " --clock, or set use_sim_time to false"
        )


def _publishers(count: int) -> str:
    return f"{count} publisher{'' if count == 1 else 's'}"
