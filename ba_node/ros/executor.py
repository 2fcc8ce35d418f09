# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run callbacks as rclpy's executor does, at half its price.

rclpy builds a wait set anew before every wait, and of what stands in it more than half are the events of publishers and
subscriptions: who comes and goes, and who does not match. While it builds, the solver's thread waits for the
interpreter. So events are left out of most waits: those soon after a wait that had them. The middleware keeps an event
until it is taken; none is lost, and none is late by more than the period.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from rclpy.event_handler import EventHandler
from rclpy.executors import SingleThreadedExecutor

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.context import Context

# Also how long a wait may take at most: one without events must end for one with them.
EVENT_PERIOD_S = 0.1


class NodeExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy is not typed
    """The executor of the node.

    Args:
        context: of rclpy; None for the default one.
        clock: steady clock, s.
    """

    def __init__(self, context: Context | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(context=context)
        self._now = clock
        self._has_events = False
        self._next_events_s = clock()

    def spin_once(self, timeout_sec: float | None = EVENT_PERIOD_S) -> None:
        """Wait for a callback and run it."""
        if self._has_events:
            self._has_events = False
            self._next_events_s = self._now() + EVENT_PERIOD_S
        super().spin_once(timeout_sec)

    def can_execute(self, entity: Any) -> bool:
        """Return True if the next wait is to wait for something too."""
        if isinstance(entity, EventHandler):
            self._has_events = self._has_events or self._now() >= self._next_events_s
            if not self._has_events:
                return False
        return bool(super().can_execute(entity))
