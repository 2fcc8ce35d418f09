# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the executor: that of events, in rclpy since 7.1.4, takes half the time of the one with wait sets.

The latter builds a wait set of all entities in Python before every wait; meanwhile the solver's thread waits for the
interpreter. That of events knows no guard conditions, so what other threads have to say comes as a task.
"""

from __future__ import annotations

from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.utilities import get_default_context

try:
    from rclpy.experimental.events_executor import EventsExecutor
except ImportError:
    EventsExecutor = None

# How long a wait may take at most: signals are looked at after it.
WAIT_S = 0.1


def make_executor(context: Context | None = None) -> Any:
    """Return the executor of a node."""
    return (EventsExecutor or SingleThreadedExecutor)(context=context or get_default_context())
