# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Peers that were built with other message definitions are named, once, and those with the same are not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from ba_node.ros.components.definitions import Definitions


class _Node:
    """What of an rclpy node the component asks."""

    def __init__(self, other: str) -> None:
        mine = SimpleNamespace(node_name="ba_node", node_namespace="/", topic_type_hash="RIHS01_aa", topic_type="t")
        peer = SimpleNamespace(
            node_name="tracker", node_namespace="/", topic_type_hash=other, topic_type="ba_msgs/msg/Keyframe"
        )
        self.mine, self.peer = mine, peer

    def resolve_topic_name(self, name: str) -> str:
        return f"/{name.removeprefix('~/')}"

    def count_publishers(self, name: str) -> int:
        return int(name == "/keyframes")

    def count_subscribers(self, name: str) -> int:
        return int(name == "/keyframes")

    def get_publishers_info_by_topic(self, _: str) -> list[Any]:
        return [self.peer]

    def get_subscriptions_info_by_topic(self, _: str) -> list[Any]:
        return [self.mine]

    def get_name(self) -> str:
        return "ba_node"

    def get_namespace(self) -> str:
        return "/"

    def create_timer(self, *_: Any, **__: Any) -> None:
        return None

    def destroy_timer(self, _: Any) -> None:
        return None


def _notices(other: str) -> list[str]:
    said: list[str] = []
    host: Any = SimpleNamespace(
        node=_Node(other),
        log=lambda notice: said.append(notice.text),
        at_cleanup=SimpleNamespace(callback=lambda *_: None),
    )
    component = Definitions(host)
    component._check()
    component._check()
    return said


def test_another_definition_is_said_once() -> None:
    (text,) = _notices("RIHS01_bb")
    assert text.startswith("/keyframes: /tracker was built with another definition of ba_msgs/msg/Keyframe")
    assert "build both with the same ba_msgs" in text


def test_the_same_definition_or_an_unknown_one_is_no_news() -> None:
    assert _notices("RIHS01_aa") == []
    assert _notices("INVALID") == []
