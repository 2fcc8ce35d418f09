# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Another node of the same name is said, once each time that one comes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from ba_node.ros.components.namesake import Namesake

OWN = ("ba_node", "/robot")


def test_another_node_of_the_same_name_is_said_each_time_that_one_comes() -> None:
    said: list[str] = []
    nodes: list[tuple[str, str]] = []
    host: Any = SimpleNamespace(
        node=SimpleNamespace(
            get_name=lambda: OWN[0],
            get_namespace=lambda: OWN[1],
            get_node_names_and_namespaces=lambda: nodes,
            create_timer=lambda *_, **__: None,
            destroy_timer=lambda _: None,
        ),
        log=lambda notice: said.append(notice.text),
        at_cleanup=SimpleNamespace(callback=lambda *_: None),
    )
    component = Namesake(host)

    def said_of(*names: tuple[str, str]) -> int:
        nodes[:] = names
        before = len(said)
        component._check()
        return len(said) - before

    assert said_of() == 0  # not found itself yet
    assert said_of(OWN, ("ba_node", "/"), ("tracker", "/robot")) == 0
    assert said_of(OWN, OWN) == 1 and said[-1].startswith("2 nodes are called /robot/ba_node: ")
    assert said_of(OWN, OWN) == 0
    assert said_of(OWN) == 0
    assert said_of(OWN, OWN) == 1
