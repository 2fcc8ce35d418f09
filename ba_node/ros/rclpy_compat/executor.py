# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run callbacks as rclpy's executor does, at a quarter of its price.

rclpy builds a wait set anew before every wait, and while it builds, the solver's thread waits for the interpreter.

Of what stands in a wait set more than half are the events of publishers and subscriptions: who comes and goes, and who
does not match. They are left out of most waits: those soon after a wait that had them. The middleware keeps an event
until it is taken; none is lost, and none is late by more than the period.

After every callback rclpy wakes the executor, for other threads of it that may have waited for the callback's group. So
the next wait ends at once, for nothing, and the one after that is the one that waits. Here there is one thread, which
need not be told what it does itself, unless a coroutine waits to go on.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sized
from typing import Any

from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition

from ba_node.ros.rclpy_compat.private import part

# Also how long a wait may take at most: one without events must end for one with them.
EVENT_PERIOD_S = 0.1


class NodeExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy is not typed
    """The executor of the node."""

    # rclpy's own attribute: what ends a wait.
    _guard: Any

    def __init__(self, context: Context | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(context=context)
        self._now = clock
        self._has_events = False
        self._next_events_s = clock()
        self._spinning: int | None = None
        guard, tasks = (
            part(self, name, kind, "waits end twice a callback")
            for name, kind in (("_guard", GuardCondition), ("_tasks", Sized))
        )
        if guard is not None and tasks is not None:
            self._guard.destroy()
            self._guard = _Alarm(self._knows, self._context)

    def spin_once(self, timeout_sec: float | None = EVENT_PERIOD_S) -> None:
        """Wait for a callback and run it."""
        if self._has_events:
            self._has_events = False
            self._next_events_s = self._now() + EVENT_PERIOD_S
        self._spinning = threading.get_ident()
        try:
            super().spin_once(timeout_sec)
        finally:
            self._spinning = None

    def can_execute(self, entity: Any) -> bool:
        """Return True if the next wait is to wait for something too."""
        if isinstance(entity, EventHandler):
            self._has_events = self._has_events or self._now() >= self._next_events_s
            if not self._has_events:
                return False
        return bool(super().can_execute(entity))

    def _knows(self) -> bool:
        """Return True if whoever wakes the executor is its own thread, with no coroutine that waits to go on."""
        return threading.get_ident() == self._spinning and all(
            task.done() or task.executing() for task, *_ in list(self._tasks)
        )


class _Alarm(GuardCondition):  # type: ignore[misc]  # rclpy is not typed
    """What wakes the executor, unless it knows."""

    def __init__(self, known: Callable[[], bool], context: Context) -> None:
        super().__init__(None, None, context=context)
        self._known = known

    def trigger(self) -> None:
        """Let the wait end that goes on or comes next."""
        if not self._known():
            super().trigger()
