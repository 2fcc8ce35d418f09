# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish what comes out of a solve: refined keyframes, poses, path, points and report."""

from __future__ import annotations

import dataclasses
import time
from typing import TYPE_CHECKING, Any

from ba_node.estimate import SolveReport, Status
from ba_node.messages.outputs import output_messages, report_message
from ba_node.messages.topics import LATCHED_OUTPUTS, OUTPUT_TYPES, TOPICS
from ba_node.ros.components.activity import Activity
from ba_node.ros.components.base import Component, Host
from ba_node.ros.convert import RclpyFactory
from ba_node.ros.log import Severity, log
from ba_node.ros.throttle import Throttle
from ba_node.ros.worker.latency import Sliding

if TYPE_CHECKING:
    from ba_node.estimate import Estimate
    from ba_node.ros.worker.worker import Account

_LOG_PERIOD_S = 5.0
# Leave first; their age is in the report that follows.
_POSES = {"refined_keyframes", "pose"}
# Of a report, what is known on this thread alone.
_TIMES = [f"{which}latency_{part}_s" for which in ("", "stamp_") for part in ("p50", "p95", "max")]


class Publishing(Component):
    """The outputs of the node; nothing is built for a topic that nobody listens to.

    Path and points replace each other: only the newest are sent. Who comes later gets those of the last estimate, which
    are built then.
    """

    def __init__(self, host: Host) -> None:
        """Advertise."""
        super().__init__(host)
        self._factory = RclpyFactory()
        self._throttle, self._activity = Throttle(_LOG_PERIOD_S), Activity()
        self._latency, self._stamp_latency = Sliding(), Sliding()
        # The estimate that latched topics are to show, and those of them that do not show it yet.
        self._latest: Estimate | None = None
        self._behind: set[str] = set()
        self._outputs: dict[str, Any] = {}
        for topic in OUTPUT_TYPES:
            matched = self._catch_up if topic in LATCHED_OUTPUTS else None
            self._outputs[topic] = self.publisher(TOPICS[topic], matched=matched)

    def take(self, estimate: Estimate, newest: bool) -> None:
        """Publish an estimate."""
        wanted = self._heard()
        if newest:
            self._latest = estimate
            self._behind = set(LATCHED_OUTPUTS) - wanted
        else:
            wanted.difference_update(LATCHED_OUTPUTS)
        self._publish(estimate, wanted & _POSES)
        report = self.host.report = self._timed(estimate)
        told = dataclasses.replace(report, rejected={**report.rejected, **self.host.counted})
        self._publish(dataclasses.replace(estimate, report=told), wanted - _POSES)
        self._log_report(report)

    def take_account(self, account: Account) -> None:
        """Publish a report without a solve: with the times of the last one."""
        known = self.host.report
        times = {} if known is None else {name: getattr(known, name) for name in _TIMES}
        report = self.host.report = dataclasses.replace(account.report, **times)
        if "report" in self._heard():
            told = dataclasses.replace(report, rejected={**report.rejected, **self.host.counted})
            frame = self.host.config.frames.map_frame
            self._outputs["report"].publish(report_message(self._factory, told, account.stamp_ns, frame))

    def _heard(self) -> set[str]:
        return {topic for topic, publisher in self._outputs.items() if publisher.get_subscription_count()}

    def _catch_up(self, _status: object) -> None:
        """Give those who come late what they missed."""
        wanted = self._behind & self._heard()
        if self._latest is not None and wanted and self.host.active:
            self._behind -= wanted
            self._publish(self._latest, wanted)

    def _publish(self, estimate: Estimate, wanted: set[str]) -> None:
        for topic, _, message in output_messages(self._factory, estimate, self.host.config.output, wanted):
            self._outputs[topic].publish(message)

    def _timed(self, estimate: Estimate) -> SolveReport:
        """Return the report with what only this thread knows: how old the poses are that have just left."""
        age_ns = self.host.node.get_clock().now().nanoseconds - estimate.stamp_ns
        now_s = time.monotonic()
        latency = self._latency.add(now_s - (estimate.arrived_s or now_s))
        stamp_latency = self._stamp_latency.add(1e-9 * age_ns)
        return dataclasses.replace(
            estimate.report,
            latency_p50_s=latency.p50,
            latency_p95_s=latency.p95,
            latency_max_s=latency.largest,
            stamp_latency_p50_s=stamp_latency.p50,
            stamp_latency_p95_s=stamp_latency.p95,
            stamp_latency_max_s=stamp_latency.largest,
        )

    def _log_report(self, report: SolveReport) -> None:
        """Say how it goes, and why a solve gave nothing: that the first keyframes are not enough is no warning."""
        if (
            report.solve_count
            and not report.status.usable
            and self._throttle.passes(report.status.name, time.monotonic())
        ):
            text = f"keyframe {report.newest_keyframe_id} was not refined: {report.reason}"
            log(self.host.node, Severity.INFO if report.status is Status.SKIPPED else Severity.WARNING, text)
        line = self._activity.line(report, time.monotonic(), self.host.config.node.log_period_s)
        if line:
            log(self.host.node, Severity.INFO, line)
