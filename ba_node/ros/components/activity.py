# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say in one line every few seconds how it goes: rate, residuals, latency, and what became of the solutions."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from ba_node.estimate import SolveReport, Status

if TYPE_CHECKING:
    from collections.abc import Mapping

_WORDS: Mapping[Status, str] = {Status.HELD: "held", Status.FAILED: "failed", Status.SKIPPED: "skipped"}


class Activity:
    """Count solves between two lines."""

    def __init__(self) -> None:
        """Start with none."""
        self._since_s: float | None = None
        self._counts: Counter[str] = Counter()

    def line(self, report: SolveReport, now_s: float, period_s: float) -> str:
        """Take in the report of a solve; return the line if one is due, else an empty text.

        Args:
            report: with latencies.
            now_s: by a clock that does not jump, s.
            period_s: time between two lines; 0 for none.
        """
        if self._since_s is None:
            self._since_s = now_s
        self._counts[_WORDS.get(report.status, "taken")] += 1
        elapsed_s = now_s - self._since_s
        if period_s <= 0.0 or elapsed_s < period_s:
            return ""
        count = sum(self._counts.values())
        verdict = ", ".join(
            f"{self._counts[word]} {word}" for word in ("taken", *_WORDS.values()) if self._counts[word]
        )
        self._since_s, self._counts = now_s, Counter()
        return (
            f"{count / elapsed_s:.1f} solves/s, {verdict}; rms {report.rms_px_after:.2f} px,"
            f" {100 * report.inlier_share:.0f} % agree, latency {1e3 * report.latency_p50_s:.0f} ms"
            f" (95 %: {1e3 * report.latency_p95_s:.0f} ms)"
        )
