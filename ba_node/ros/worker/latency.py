# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measure how old results are when they leave, end solves in time, and notice when the solver keeps falling behind."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from ba_node.config import Config
from ba_node.estimate import Estimate

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


# Solves in a row for one keyframe each after which it keeps up again.
_CALM = 5


class Lag:
    """Watches how many keyframes each solve has to take together.

    Args:
        patience_s: for how long that may go on without a word.
    """

    def __init__(self, patience_s: float) -> None:
        self.warnings: tuple[str, ...] = ()  # what is to be said in reports while it goes on
        self._patience_s = patience_s
        self._since_s: float | None = None
        self._solves = self._keyframes = self._calm = 0
        self._spent_s = 0.0

    def update(self, start_s: float, end_s: float, n_solved: int, estimate: Estimate | None, config: Config) -> str:
        """Take in a solve; return a warning when it is time for one, once for each time that it falls behind.

        ``n_solved`` keyframes were taken together; the parameters are to say which of them would help.
        """
        self._calm = self._calm + 1 if n_solved <= 1 else 0
        if self._calm >= _CALM:
            self._since_s, self.warnings = None, ()
        if self._since_s is None and n_solved <= 1:
            return ""
        if self._since_s is None:
            self._since_s, self._solves, self._keyframes, self._spent_s = start_s, 0, 0, 0.0
        self._solves += 1
        self._keyframes += n_solved
        self._spent_s += end_s - start_s
        if self.warnings or end_s - self._since_s < self._patience_s or estimate is None:
            return ""
        report, window = estimate.report, config.window
        text = (
            f"falling behind for {end_s - self._since_s:.0f} s: {self._keyframes} keyframes were solved in"
            f" {self._solves} solves of {1e3 * self._spent_s / self._solves:.0f} ms, the last with"
            f" {report.keyframes} free keyframes and {report.observations} observations; lower window.max_keyframes"
            f" ({window.max_keyframes}) or window.max_landmarks ({window.max_landmarks}), set node.latency_budget_ms,"
            " or send fewer keyframes or tracks"
        )
        self.warnings = (text,)
        return text
