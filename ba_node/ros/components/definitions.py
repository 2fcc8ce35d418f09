# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say so when another node was built with other definitions of the messages: what passes between them is garbage.

The middleware matches topics by the name of the type alone. Each side announces a hash of its definition (REP-2016),
which comments and parameters do not change.
"""

from __future__ import annotations

from ba_node.messages.topics import INPUT_TYPES, INTERFACE_VERSION, OUTPUT_TYPES, TOPICS
from ba_node.ros import qos
from ba_node.ros.components.base import Component, Host
from ba_node.ros.worker.worker import Notice

_CHECK_S = 1.0


class Definitions(Component):
    """Compares the definitions of those who publish the inputs and subscribe to the outputs with those of this node."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._counts: dict[str, int] = {}
        self.timer(_CHECK_S, self._check)

    def _check(self) -> None:
        node = self.host.node
        for topic in (*INPUT_TYPES, *OUTPUT_TYPES):
            name = node.resolve_topic_name(TOPICS[topic].given_name)
            count = node.count_publishers(name) + node.count_subscribers(name)
            if self._counts.get(topic, 0) != count:
                self._counts[topic] = count
                self._compare(name)

    def _compare(self, name: str) -> None:
        node = self.host.node
        ends = [*node.get_publishers_info_by_topic(name), *node.get_subscriptions_info_by_topic(name)]
        mine = {str(end.topic_type_hash) for end in ends if qos.is_of(end, node)}
        for end in ends:
            other = str(end.topic_type_hash)
            if mine and other not in mine and other.startswith("RIHS"):
                self.host.log(
                    Notice(
                        f"definition {name} {qos.peer_name(end)}",
                        f"{name}: {qos.peer_name(end)} was built with another definition of {end.topic_type} than this"
                        f" node (interface version {INTERFACE_VERSION}): its messages cannot be understood; build both"
                        " with the same ba_msgs",
                    )
                )
