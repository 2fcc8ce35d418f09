# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from ba_node.estimate import SolveReport, Status
from ba_node.messages.report import LatencyReport, Report
from ba_node.ros.components.publishing import Activity

REPORT = Report(
    SolveReport(status=Status.CONVERGED, rms_px_after=0.434, inlier_share=0.97),
    latency=LatencyReport(latency_p50_s=0.021, latency_p95_s=0.04),
)


def test_one_line_a_period() -> None:
    activity = Activity()
    lines = [activity.line(REPORT, 0.5 * k, 5.0) for k in range(21)]
    assert [k for k, line in enumerate(lines) if line] == [10, 20]
    assert lines[20] == "2.0 solves/s, 10 taken; rms 0.43 px, 97 % agree, latency 21 ms (95 %: 40 ms)"


def test_what_was_not_taken_is_counted() -> None:
    activity = Activity()
    for k, status in enumerate((Status.SKIPPED, Status.CONVERGED, Status.HELD, Status.HELD, Status.FAILED)):
        line = activity.line(Report(SolveReport(status=status)), float(k), 4.0)
    assert line.startswith("1.2 solves/s, 1 taken, 2 held, 1 failed, 1 skipped; ")


def test_none_with_a_period_of_zero() -> None:
    activity = Activity()
    assert not any(activity.line(REPORT, float(k), 0.0) for k in range(100))
