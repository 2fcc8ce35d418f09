# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say so when another node has this one's name: both take the same inputs, and what they publish is mixed."""

from __future__ import annotations

from ba_node.ros.components.base import Component, Host
from ba_node.ros.worker.worker import Notice

_CHECK_S = 1.0


class Namesake(Component):
    """Counts the nodes of this one's name and namespace."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._count = 1
        self.timer(_CHECK_S, self._check)

    def _check(self) -> None:
        node = self.host.node
        own = (node.get_name(), node.get_namespace())
        count, before = node.get_node_names_and_namespaces().count(own), self._count
        self._count = count
        if count > max(before, 1):
            name = f"{own[1].rstrip('/')}/{own[0]}"
            self.host.log(
                Notice(
                    "namesake",
                    f"{count} nodes are called {name}: each solves, and what they publish is mixed; end one, or start"
                    " it with --ros-args -r __node:=NAME (one that crashed is counted for some 20 s more)",
                )
            )
