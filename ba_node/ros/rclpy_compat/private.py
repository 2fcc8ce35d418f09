# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Reach the private parts of rclpy that the node works with. Where a version lacks one, that is said once.

They were found in rclpy 7.1 (Jazzy). What the node does without them:

==========================================  =====================================================================
``LifecycleNode._state_machine``            a refused transition is told without the state and what is possible
``Node._parameter_overrides``               rclpy reads the overrides, and a name that does not exist goes unnoticed
``ActionServer._result_futures``, ...       a goal is a coroutine, which the executor asks again and again
==========================================  =====================================================================
"""

from __future__ import annotations

from typing import Any

from rclpy.logging import get_logger

try:
    from rclpy.impl.implementation_singleton import rclpy_implementation as _implementation
except ImportError:
    _implementation = None

_KNOWN = "7.1"
_said: set[str] = set()


def part(owner: Any, name: str, kind: type, without: str) -> Any:
    """Return a private attribute of a kind; None where this rclpy has none, after saying what the node does then."""
    found = getattr(owner, name, None)
    if not isinstance(found, kind):
        found = None
    where = f"{type(owner).__name__}.{name}"
    if found is None and where not in _said:
        _said.add(where)
        get_logger("ba_node").warning(f"this rclpy is not as {_KNOWN} is: no {where}; {without}")
    return found


def _error(name: str) -> type[Exception]:
    return getattr(_implementation, name, RuntimeError)


RCLError = _error("RCLError")
ARGUMENT_ERRORS = (RCLError, _error("RCLInvalidROSArgsError"), _error("UnknownROSArgsError"))
