# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say so when the node is to go by simulated time (``use_sim_time``) and none comes on /clock, or it stands still."""

from __future__ import annotations

import time

from rclpy.clock import Clock, ClockType

from ba_node.messages.topics import CLOCK
from ba_node.ros.components.base import Component, Host
from ba_node.ros.worker.worker import Notice

_CHECK_S = 0.5
# Without a change of the time for so long it is said, and again each time this has doubled.
_PATIENCE_S = 3.0


class SimulatedTime(Component):
    """Watches the node's clock by one that never stands still."""

    def __init__(self, host: Host) -> None:
        """Begin to watch."""
        super().__init__(host)
        self._time_ns = -1
        self._since_s = time.monotonic()
        self._next_s = _PATIENCE_S
        self.timer(_CHECK_S, self._check, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _check(self) -> None:
        node, now_s = self.host.node, time.monotonic()
        time_ns = int(node.get_clock().now().nanoseconds)
        if time_ns != self._time_ns or not node.get_parameter("use_sim_time").value:
            self._time_ns, self._since_s, self._next_s = time_ns, now_s, _PATIENCE_S
            self.host.clock = ""
            return
        still_s = now_s - self._since_s
        if still_s < _PATIENCE_S:
            return
        self.host.clock = self._words(still_s)
        if still_s >= self._next_s:
            self._next_s = 2.0 * still_s
            self.host.log(Notice(CLOCK, self.host.clock))

    def _words(self, still_s: float) -> str:
        publishers = self.host.node.get_publishers_info_by_topic(CLOCK)
        names = sorted(f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in publishers)
        has = f"{CLOCK} has {len(names)} publisher{'' if len(names) == 1 else 's'}"
        who = f"{has} ({', '.join(names)})" if names else has
        if self._time_ns:
            return f"use_sim_time is true and the time has stood still for {still_s:.0f} s: {who}"
        return (
            f"use_sim_time is true and no time has come for {still_s:.0f} s: {who}; start the simulation, play with"
            " --clock, or set use_sim_time to false"
        )
