# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measure how old results are when they leave, and end solves in time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

WINDOW = 100


class Quantiles(NamedTuple):
    """Median, 95th percentile and largest of a run of numbers; 0 without any."""

    p50: float = 0.0
    p95: float = 0.0
    largest: float = 0.0


class Sliding:
    """The last numbers of a run, at most ``WINDOW`` of them."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=WINDOW)

    def add(self, value: float) -> Quantiles:
        """Add a number and return the quantiles with it."""
        self._values.append(value)
        ordered = sorted(self._values)
        last = len(ordered) - 1
        return Quantiles(ordered[last // 2], ordered[-(-95 * last // 100)], ordered[last])


class Budget:
    """Decide after each iteration of a solve whether there is time for another.

    The next iteration is expected to take as long as the last one, and what follows the solve (judging observations,
    collecting the estimate) as long as after the solve before. One iteration is always made.

    Args:
        clock: s, of the same kind as the arrival times.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._end_s = float("inf")
        self._last_s = 0.0
        self._tail_s = 0.0
        self._calls = 0
        self.spent = False

    def begin(self, arrived_s: float, budget_s: float) -> None:
        """Begin a solve whose result should leave ``budget_s`` after its keyframe arrived; 0 for no limit."""
        self._end_s = arrived_s + budget_s if budget_s > 0.0 else float("inf")
        self._last_s = self._clock()
        self._calls = 0
        self.spent = False

    def allows_more(self) -> bool:
        """Return False when another iteration would end too late. To be called at the start and after each."""
        now_s = self._clock()
        step_s, self._last_s = now_s - self._last_s, now_s
        self._calls += 1
        self.spent = self._calls > 1 and now_s + step_s + self._tail_s > self._end_s
        return not self.spent

    def end(self) -> None:
        """Note how long the rest took."""
        self._tail_s = self._clock() - self._last_s
