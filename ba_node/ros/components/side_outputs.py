# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish what is worked out only for those who look: markers, and poses with their covariance."""

from __future__ import annotations

from typing import Any

from ba_node.backend import Backend
from ba_node.estimate import Estimate, Extras
from ba_node.messages.markers import marker_array, no_markers
from ba_node.messages.topics import ON_DEMAND, TOPICS
from ba_node.messages.transforms import covariance_messages
from ba_node.ros.components.base import Component, Host
from ba_node.ros.convert import RclpyFactory


class SideOutputs(Component):
    """The topics of ``ON_DEMAND``. Who subscribes gets the next solve; the last markers are kept for those after."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._factory = RclpyFactory()
        self._asked = Extras()
        self._drawn_map: int | None = None
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
        if newest and len(estimate.trajectory) == 0 and self._wanted("markers"):
            self._drawn_map = None
            self._publishers["markers"].publish(no_markers(estimate))
        if newest and estimate.view is not None and self._wanted("markers"):
            clear = estimate.map_index != self._drawn_map
            self._drawn_map = estimate.map_index
            self._publishers["markers"].publish(marker_array(estimate, self.host.config.output, clear=clear))

    def _wanted(self, topic: str) -> bool:
        return bool(self._publishers[topic].get_subscription_count())

    def _ask(self, _status: object) -> None:
        """Let the solver work out what someone subscribes to, from its next solve on."""
        if len(self._publishers) < len(ON_DEMAND):
            return
        extras = Extras(covariance=self._wanted("pose_with_covariance"), view=self._wanted("markers"))
        if extras == self._asked:
            return
        self._asked = extras

        def work_out(backend: Backend) -> None:
            backend.extras = extras

        self.host.inbox.post(work_out)
