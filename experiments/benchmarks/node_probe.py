# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the node with a timer of 10 ms that notes how late it is called: so long is the executor blocked.

Time on the processor is counted by thread, from when a window was refined: starting is another matter. And before the
first keyframe: so much the timer takes, what else the benchmark asks, and the node where nothing comes.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter, deque
from contextlib import suppress
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from ba_node.ros import main as node_main
from ba_node.ros.node import BaNode

_PERIOD_S = 0.01
_WINDOW = 20
_SAMPLE_S = 0.5
_IDLE_SAMPLES = 5


class ProbedNode(BaNode):
    """The node, with the timer."""

    def __init__(self, **options: Any) -> None:
        """Start the timer; what comes before the first call is not noted."""
        super().__init__(**options)
        self.late_ms: list[float] = []
        self._last_s = time.monotonic()
        self._began: tuple[float, Counter[str]] | None = None
        self._spent: tuple[float, Counter[str]] = (0.0, Counter())
        self._idle: deque[tuple[float, Counter[str]]] = deque(maxlen=_IDLE_SAMPLES)
        self._probe = self.create_timer(_PERIOD_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _tick(self) -> None:
        now = time.monotonic()
        self.late_ms.append(1e3 * max(0.0, now - self._last_s - _PERIOD_S))
        self._last_s = now
        if self.keyframes_refined >= _WINDOW and now > self._spent[0] + _SAMPLE_S:
            # Threads that have ended tell nothing any more.
            self._spent = now, cpu_ns()
            self._began = self._began or self._spent
        elif not self._heard() and (not self._idle or now > self._idle[-1][0] + _SAMPLE_S):
            self._idle.append((now, cpu_ns()))

    def _heard(self) -> bool:
        return self._host is None or self._host.arrived["keyframes"] > 0

    def destroy_node(self) -> None:
        """Say what was noted."""
        began_s, before = self._began or (0.0, Counter())
        now_s, spent = self._spent
        times: dict[str, Any] = {
            "cpu_s": {name: 1e-9 * ns for name, ns in (spent - before).items()},
            "wall_s": now_s - began_s,
            "idle_share": self._idle_share(),
        }
        print(json.dumps({"late_ms": [round(ms, 2) for ms in self.late_ms[20:]], **times}), flush=True)
        super().destroy_node()

    def _idle_share(self) -> float:
        (began_s, before), (ended_s, after) = self._idle[0], self._idle[-1]
        return 1e-9 * (after - before).total() / max(ended_s - began_s, 1e-9)


def cpu_ns() -> Counter[str]:
    """Return the time that the threads have had on a processor, ns: executor, solver, and all that are not Python's."""
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    spent: Counter[str] = Counter()
    for task in Path("/proc/self/task").iterdir():
        name = names.get(int(task.name), "others")
        with suppress(OSError):  # a thread that has just ended
            spent[name] += int((task / "schedstat").read_text().split()[0])
    return spent


if __name__ == "__main__":
    vars(node_main)["BaNode"] = ProbedNode
    sys.exit(node_main.main())
