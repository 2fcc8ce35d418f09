# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Connect topics and parameters to the worker. Everything in this file runs on the executor's thread."""

from __future__ import annotations

import dataclasses
import functools
import pickle
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from ba_node.backend import Backend
from ba_node.estimate import Estimate, SolveReport, Status
from ba_node.measurements import CameraRig
from ba_node.messages.conversion import INPUT_TYPES, OUTPUT_TYPES, measurement_from_message, output_messages
from ba_node.ros import qos
from ba_node.ros.convert import RclpyFactory, message_class
from ba_node.ros.inbox import Inbox
from ba_node.ros.parameters import Parameters
from ba_node.ros.throttle import Throttle
from ba_node.ros.worker import Notice, Worker

if TYPE_CHECKING:
    from ba_node.config import Config

NODE_NAME = "ba_node"
_LOG_PERIOD_S = 5.0


class BaNode(Node):  # type: ignore[misc]  # rclpy is not typed
    """The ROS node: subscribes to keyframes, tracks and cameras, publishes what the worker makes of them.

    Raises:
        ConfigError: a parameter given at start does not exist or has a wrong value.
    """

    def __init__(self, **node_options: Any) -> None:
        """Make the node; :meth:`start` sets it to work."""
        super().__init__(NODE_NAME, **node_options)
        self._settings = Parameters(self, self._reconfigure)
        config = self._settings.config
        self._inbox = Inbox(config.node.inbox_size)
        self._wake = self.create_guard_condition(self._publish)
        backend = Backend(config, clock=time.perf_counter)
        self._worker = Worker(backend, self._inbox, config.node.settle_time_s, self._wake.trigger)
        self._factory = RclpyFactory()
        self._throttle = Throttle(_LOG_PERIOD_S)
        self._unreadable: Counter[str] = Counter()
        self._rigs: dict[str, bytes] = {}
        self._outputs = {
            topic: self.create_publisher(message_class(kind), f"~/{topic}", qos.for_output(topic))
            for topic, kind in OUTPUT_TYPES.items()
        }
        for topic, kind in INPUT_TYPES.items():
            receive = functools.partial(self._receive, topic, kind)
            for profile in qos.for_input(topic, config.node.queue_depth):
                self.create_subscription(message_class(kind), topic, receive, profile)

    @property
    def keyframes_refined(self) -> int:
        """Return how many keyframes have been refined so far."""
        return self._worker.refined

    def start(self) -> None:
        """Start the worker."""
        self._worker.start()

    def stop(self) -> None:
        """End the worker, during a solve after its current iteration."""
        if not self._worker.stop():
            self.get_logger().error("the solver did not stop in time, leaving it")

    def _receive(self, topic: str, kind: str, message: Any) -> None:
        """Hand a message to the worker. What cannot be read is counted; it must not end the node."""
        try:
            measurement = measurement_from_message(kind, message)
            if isinstance(measurement, CameraRig) and not self._is_news(topic, measurement):
                return
            self._inbox.put(measurement, time.monotonic())
        except Exception as error:
            self._unreadable["unreadable"] += 1
            text = f"{self.resolve_topic_name(topic)}: {error}; dropped (unreadable = {self._unreadable['unreadable']})"
            self._log(Notice("unreadable", text))

    def _is_news(self, topic: str, rig: CameraRig) -> bool:
        """Return False for cameras that came before (drivers repeat them with each image) or that a rig overrules."""
        content = pickle.dumps(rig)
        known = self._rigs.get(topic) == content
        if topic == "camera_info" and "camera_rig" in self._rigs:
            self._log(Notice("camera_info", "camera_info is ignored: camera_rig has told the cameras"))
            return False
        self._rigs[topic] = content
        return not known

    def _reconfigure(self, config: Config) -> None:
        self._inbox.post(lambda backend: backend.configure(config))

    def _publish(self) -> None:
        """Publish what the worker has made. Path and points replace each other: only the newest are sent."""
        outputs = self._worker.outputs()
        estimates = [output for output in outputs if isinstance(output, Estimate)]
        newest = next((e for e in reversed(estimates) if e.report.status.usable), None)
        for output in outputs:
            if isinstance(output, Notice):
                self._log(output)
            else:
                self._send(output, latched=output is newest)
                self._log_report(output.report)

    def _send(self, estimate: Estimate, *, latched: bool) -> None:
        wanted = {topic for topic, publisher in self._outputs.items() if publisher.get_subscription_count()}
        # Latched topics are for those who come later.
        wanted = wanted.union(qos.LATCHED_OUTPUTS) if latched else wanted.difference(qos.LATCHED_OUTPUTS)
        rejected = {**estimate.report.rejected, **self._unreadable}
        estimate = dataclasses.replace(estimate, report=dataclasses.replace(estimate.report, rejected=rejected))
        for topic, _, message in output_messages(self._factory, estimate, self._settings.config.output, wanted):
            self._outputs[topic].publish(message)

    def _log_report(self, report: SolveReport) -> None:
        """Say why a solve gave nothing. That the first keyframes are not enough is nothing to warn about."""
        if not report.status.usable and self._throttle.passes(report.status.name, time.monotonic()):
            log = self.get_logger()
            text = f"keyframe {report.newest_keyframe_id} was not refined: {report.reason}"
            (log.info if report.status is Status.SKIPPED else log.warning)(text)

    def _log(self, notice: Notice) -> None:
        """Log a notice, the same one not more often than every few seconds."""
        if self._throttle.passes(notice.key, time.monotonic()):
            log = self.get_logger()
            (log.error if notice.is_error else log.warning)(notice.text)
