# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Notice when the solver keeps falling behind, and say what could be changed."""

from __future__ import annotations

from ba_node.config import Config
from ba_node.estimate import Estimate

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
