# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish what comes out of a solve: refined keyframes, poses, path, points and report."""

from __future__ import annotations

import dataclasses
import time
from typing import TYPE_CHECKING

from ba_node.estimate import SolveReport, Status
from ba_node.messages.conversion import OUTPUT_TYPES, output_messages
from ba_node.ros import qos
from ba_node.ros.component import Component, Host
from ba_node.ros.convert import RclpyFactory, message_class
from ba_node.ros.throttle import Throttle

if TYPE_CHECKING:
    from ba_node.estimate import Estimate

_LOG_PERIOD_S = 5.0


class Publishing(Component):
    """The outputs of the node. Path and points replace each other: only the newest are sent."""

    def __init__(self, host: Host) -> None:
        """Advertise."""
        super().__init__(host)
        self._factory = RclpyFactory()
        self._throttle = Throttle(_LOG_PERIOD_S)
        self._outputs = {
            topic: self.publisher(message_class(kind), f"~/{topic}", qos.for_output(topic))
            for topic, kind in OUTPUT_TYPES.items()
        }

    def take(self, estimate: Estimate, newest: bool) -> None:
        """Publish an estimate; latched topics even if nobody listens, for those who come later."""
        wanted = {topic for topic, publisher in self._outputs.items() if publisher.get_subscription_count()}
        wanted = wanted.union(qos.LATCHED_OUTPUTS) if newest else wanted.difference(qos.LATCHED_OUTPUTS)
        rejected = {**estimate.report.rejected, **self.host.counted}
        estimate = dataclasses.replace(estimate, report=dataclasses.replace(estimate.report, rejected=rejected))
        for topic, _, message in output_messages(self._factory, estimate, self.host.config.output, wanted):
            self._outputs[topic].publish(message)
        self._log_report(estimate.report)

    def _log_report(self, report: SolveReport) -> None:
        """Say why a solve gave nothing. That the first keyframes are not enough is nothing to warn about."""
        if not report.status.usable and self._throttle.passes(report.status.name, time.monotonic()):
            log = self.host.node.get_logger()
            text = f"keyframe {report.newest_keyframe_id} was not refined: {report.reason}"
            (log.info if report.status is Status.SKIPPED else log.warning)(text)
