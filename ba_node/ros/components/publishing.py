# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish what comes out of a solve: refined keyframes, poses, path, points and report."""

from __future__ import annotations

import functools
import time
from collections import Counter
from typing import Any

from ba_node.estimate import Estimate, Refinement, Status
from ba_node.messages.outputs import output_messages, pose_outputs
from ba_node.messages.report import LatencyReport, Report, report_message
from ba_node.messages.topics import LATCHED_OUTPUTS, OUTPUT_TYPES, TOPICS, WHOLE_MAP
from ba_node.ros.components.base import Component, Host
from ba_node.ros.log import Severity, Throttle, log
from ba_node.ros.message_factory import RclpyFactory
from ba_node.ros.worker.latency import Sliding
from ba_node.ros.worker.worker import Outcome

_LOG_PERIOD_S = 5.0
# Leave first; their age is in the report that follows.
_POSES = {"refined_keyframes", "pose"}

_WORDS = {Status.HELD: "held", Status.FAILED: "failed", Status.SKIPPED: "skipped"}


class Activity:
    """Say in one line every few seconds how it goes: rate, residuals, latency, and what became of the solutions."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._counts: Counter[str] = Counter()

    def line(self, report: Report, now_s: float, period_s: float) -> str:
        """Take in the report of a solve; return the line if one is due, every ``period_s`` (0: never), else nothing."""
        if self._since_s is None:
            self._since_s = now_s
        self._counts[_WORDS.get(report.solve.status, "taken")] += 1
        elapsed_s = now_s - self._since_s
        if period_s <= 0.0 or elapsed_s < period_s:
            return ""
        count = sum(self._counts.values())
        verdict = ", ".join(
            f"{self._counts[word]} {word}" for word in ("taken", *_WORDS.values()) if self._counts[word]
        )
        self._since_s, self._counts = now_s, Counter()
        return (
            f"{count / elapsed_s:.1f} solves/s, {verdict}; rms {report.solve.rms_px_after:.2f} px,"
            f" {100 * report.solve.inlier_share:.0f} % agree, latency {1e3 * report.latency.latency_p50_s:.0f} ms"
            f" (95 %: {1e3 * report.latency.latency_p95_s:.0f} ms)"
        )


class Publishing(Component):
    """The outputs of the node; nothing is built for a topic that nobody listens to.

    Path and points replace each other: only the newest are sent. Who comes later gets those of the last estimate, and
    the last report, which are built then.
    """

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._factory = RclpyFactory()
        self._throttle, self._activity = Throttle(_LOG_PERIOD_S), Activity()
        self._ages, self._latency = (Sliding(), Sliding()), LatencyReport()
        # The estimate that latched topics are to show, and those of them that do not show it yet.
        self._latest: Estimate | None = None
        self._told: Outcome | None = None
        self._behind: set[str] = set()
        self._outputs: dict[str, Any] = {}
        # How many listen to poses, as far as it was told: to ask takes longer than to write the message.
        self._listeners: dict[str, int] = {}
        for topic in OUTPUT_TYPES:
            matched = self._catch_up if topic in LATCHED_OUTPUTS else None
            if topic in _POSES:
                matched = functools.partial(self._count, topic)
            self._outputs[topic] = self.publisher(TOPICS[topic], matched=matched)

    def take_poses(self, refinement: Refinement, arrived_s: float) -> None:
        """Publish the poses of a solve, and note how old they are then."""
        told = self._listeners
        wanted = {one for one in _POSES if told.get(one) or self._outputs[one].get_subscription_count()}
        for topic, message in pose_outputs(refinement, wanted):
            self._outputs[topic].publish(message)
        arrival, stamp = self._ages
        age_ns = self.host.node.get_clock().now().nanoseconds - refinement.stamp_ns
        self._latency = LatencyReport(*arrival.add(time.monotonic() - arrived_s), *stamp.add(1e-9 * age_ns))

    def take_report(self, outcome: Outcome) -> None:
        """Publish the report, which says how old the poses were when they left."""
        report = Report(outcome.report, outcome.queue, self._latency).counting(self.host.counted)
        self.host.report, self._told = report, outcome
        self._behind.add("report")
        self._publish_report()
        if outcome.estimate is not None:
            self._log_report(report)

    def take(self, estimate: Estimate, newest: bool) -> None:
        """Publish the map."""
        if newest:
            self._latest = estimate
            heard = self._heard()
            self._behind |= set(WHOLE_MAP) - heard
            self._behind -= heard.intersection(WHOLE_MAP)
            self._publish(estimate, heard.intersection(WHOLE_MAP))

    def _heard(self) -> set[str]:
        return {topic for topic, publisher in self._outputs.items() if publisher.get_subscription_count()}

    def _count(self, topic: str, status: Any) -> None:
        self._listeners[topic] = status.current_count

    def _catch_up(self, _status: object) -> None:
        """Give those who come late what they missed."""
        if not self.host.active or len(self._outputs) < len(OUTPUT_TYPES):
            return
        wanted = (self._behind & self._heard()).intersection(WHOLE_MAP)
        self._behind -= wanted
        if self._latest is not None:
            self._publish(self._latest, wanted)
        self._publish_report()

    def _publish_report(self) -> None:
        """Publish the last report if somebody listens who has not got it."""
        report, outcome = self.host.report, self._told
        if report is None or outcome is None or "report" not in self._behind & self._heard():
            return
        self._behind.discard("report")
        frame_id = self.host.config.frames.map_frame if outcome.estimate is None else outcome.estimate.frame_id
        self._outputs["report"].publish(report_message(self._factory, report, outcome.stamp_ns, frame_id))

    def _publish(self, estimate: Estimate, wanted: set[str]) -> None:
        if not wanted:
            return
        for topic, _, message in output_messages(self._factory, estimate, self.host.config.output, wanted):
            self._outputs[topic].publish(message)

    def _log_report(self, report: Report) -> None:
        """Say how it goes, and why a solve gave nothing: that the first keyframes are not enough is no warning."""
        solve, now_s = report.solve, time.monotonic()
        if solve.solve_count and not solve.status.usable and self._throttle.passes(solve.status.name, now_s):
            text = f"keyframe {solve.newest_keyframe_id} was not refined: {solve.reason}"
            log(self.host.node, Severity.INFO if solve.status is Status.SKIPPED else Severity.WARNING, text)
        line = self._activity.line(report, now_s, self.host.config.node.log_period_s)
        if line:
            log(self.host.node, Severity.INFO, line)
