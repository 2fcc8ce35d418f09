# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write to the node's log, at any severity, without ever raising.

rclpy remembers the severity of each call site and raises when another comes from there; so what is logged with a
severity that is only known when it runs goes through :func:`log`, which has a site for each. A test walks the sources.
"""

from __future__ import annotations

import contextlib
import enum
import sys
from typing import Any


class Severity(enum.Enum):
    """How much a line of the log matters."""

    INFO = enum.auto()
    WARNING = enum.auto()
    ERROR = enum.auto()


def log(node: Any, severity: Severity, text: str) -> None:
    """Log a text. Where the log takes none, it goes to stderr: no answer to a client may depend on it."""
    text = printable(text)
    try:
        logger = node.get_logger()
        if severity is Severity.INFO:
            logger.info(text)
        elif severity is Severity.WARNING:
            logger.warning(text)
        else:
            logger.error(text)
    except Exception as error:
        with contextlib.suppress(OSError, ValueError):  # closed, or full
            print(f"{severity.name.lower()}: {text} (not in the log: {error})", file=sys.stderr)


def printable(text: str) -> str:
    """Return the text with what UTF-8 cannot hold, as names of files may have it, spelt out."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def fault(error: BaseException) -> str:
    """Return what is told of an exception that nobody expected."""
    return f"internal error: {type(error).__name__}: {error}"


class Throttle:
    """Let one event of each key through in a period of time.

    Args:
        period_s: time between two events of one key, s.
        max_keys: keys to remember; beyond it the one let through longest ago is forgotten.
    """

    def __init__(self, period_s: float, max_keys: int = 100) -> None:
        self._period_s = period_s
        self._max_keys = max_keys
        self._last: dict[str, float] = {}

    def passes(self, key: str, now_s: float) -> bool:
        """Return True if the event should be logged now."""
        last = self._last.get(key)
        if last is not None and now_s - last < self._period_s:
            return False
        self._last.pop(key, None)
        self._last[key] = now_s
        if len(self._last) > self._max_keys:
            del self._last[next(iter(self._last))]
        return True
