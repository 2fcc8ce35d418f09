# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Limit how often the same thing is logged."""

from __future__ import annotations


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
