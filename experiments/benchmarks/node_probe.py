# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the node with a timer of 10 ms that notes how late it is called: so long is the executor blocked."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from ba_node.ros import main as node_main
from ba_node.ros.node import BaNode

_PERIOD_S = 0.01


class ProbedNode(BaNode):
    """The node, with the timer."""

    def __init__(self, **options: Any) -> None:
        """Start the timer; what comes before the first call is not noted."""
        super().__init__(**options)
        self.late_ms: list[float] = []
        self._last_s = time.monotonic()
        self._probe = self.create_timer(_PERIOD_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _tick(self) -> None:
        now = time.monotonic()
        self.late_ms.append(1e3 * max(0.0, now - self._last_s - _PERIOD_S))
        self._last_s = now

    def destroy_node(self) -> None:
        """Say what was noted."""
        times = {"cpu_s": time.process_time(), "wall_s": time.monotonic() - _BEGIN_S}
        print(json.dumps({"late_ms": [round(ms, 2) for ms in self.late_ms[20:]], **times}), flush=True)
        super().destroy_node()


_BEGIN_S = time.monotonic()

if __name__ == "__main__":
    vars(node_main)["BaNode"] = ProbedNode
    sys.exit(node_main.main())
