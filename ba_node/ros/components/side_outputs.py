# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish what is worked out only for those who look: markers, odometry, and poses with their covariance."""

from __future__ import annotations

from typing import Any

from ba_node.backend import Backend
from ba_node.estimate import Estimate, Extras
from ba_node.messages.markers import marker_array, no_markers
from ba_node.messages.topics import ON_DEMAND, TOPICS
from ba_node.messages.transforms import covariance_messages, odometry_message
from ba_node.ros.components.base import Component, Host
from ba_node.ros.message_factory import RclpyFactory


class SideOutputs(Component):
    """The topics of ``ON_DEMAND``. Who subscribes gets the next solve; the last markers are kept for those after."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._factory = RclpyFactory()
        self._asked = Extras()
        self._drawn_map: int | None = None
        # Map and stamp of the last odometry.
        self._went_on = (-1, 0)
        self._publishers: dict[str, Any] = {}
        for topic in ON_DEMAND:
            self._publishers[topic] = self.publisher(TOPICS[topic], matched=self._ask)

    def take(self, estimate: Estimate, newest: bool) -> None:
        """Publish what was asked for when the solve began."""
        if len(estimate.trajectory) == 0:
            self._drawn_map = None
        if estimate.covariance is not None and self._wanted("pose_with_covariance"):
            for message in covariance_messages(self._factory, estimate):
                self._publishers["pose_with_covariance"].publish(message)
        if estimate.replaces_map and len(estimate.refined) and self._wanted("odometry"):
            self._go_on(estimate)
        if newest and len(estimate.trajectory) == 0 and self._wanted("markers"):
            self._drawn_map = None
            self._publishers["markers"].publish(no_markers(estimate))
        if newest and estimate.view is not None and self._wanted("markers"):
            clear = estimate.map_index != self._drawn_map
            self._drawn_map = estimate.map_index
            self._publishers["markers"].publish(marker_array(estimate, self.host.config.output, clear=clear))

    def _go_on(self, estimate: Estimate) -> None:
        """Publish the newest keyframe, unless one as new was published of this map."""
        stamp_ns = int(estimate.refined.stamp_ns[-1])
        if self._went_on[0] != estimate.map_index or stamp_ns > self._went_on[1]:
            self._went_on = estimate.map_index, stamp_ns
            base_frame = self.host.config.frames.base_frame
            self._publishers["odometry"].publish(odometry_message(self._factory, estimate, base_frame))

    def _wanted(self, topic: str) -> bool:
        return bool(self._publishers[topic].get_subscription_count())

    def _ask(self, _status: object) -> None:
        """Let the solver work out what someone subscribes to, from its next solve on."""
        if len(self._publishers) < len(ON_DEMAND):
            return
        extras = Extras(
            covariance=self._wanted("pose_with_covariance") or self._wanted("odometry"), view=self._wanted("markers")
        )
        if extras == self._asked:
            return
        self._asked = extras

        def work_out(backend: Backend) -> None:
            backend.extras = extras

        self.host.inbox.post(work_out)
