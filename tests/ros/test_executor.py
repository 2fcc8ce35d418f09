# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The executor runs what rclpy's runs, but does not wait for events of publishers and subscriptions every time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rclpy.event_handler import EventHandler, PublisherEventCallbacks
from rclpy.node import Node
from std_msgs.msg import Empty

from ba_node.ros.executor import EVENT_PERIOD_S, NodeExecutor


class Spun:
    """A node whose executor counts in how many of its waits there were events."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context)
        self.node = Node("spun", context=self.context, start_parameter_services=False, enable_rosout=False)
        self.now_s = 100.0
        self.executor = NodeExecutor(self.context, clock=lambda: self.now_s)
        self.executor.add_node(self.node)

    def waits_for_events(self) -> bool:
        """Spin once, woken at once; return True if the wait was one for events too."""
        asked: list[bool] = []
        inherited = type(self.executor).can_execute

        def spy(entity: Any) -> bool:
            can = inherited(self.executor, entity)
            if isinstance(entity, EventHandler):
                asked.append(can)
            return can

        setattr(self.executor, "can_execute", spy)  # noqa: B010 (mypy does not let a method be assigned)
        self.executor.spin_once(timeout_sec=0.0)
        assert asked, "the node has no events"
        assert len(set(asked)) == 1, f"some events were left out of a wait and others not: {asked}"
        return asked[0]

    def until(self, condition: Callable[[], Any]) -> None:
        end_s = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < end_s, "timed out"
            self.executor.spin_once(timeout_sec=0.01)


@pytest.fixture
def spun(domain: int) -> Iterator[Spun]:  # noqa: ARG001
    made = Spun()
    yield made
    made.executor.shutdown()
    made.node.destroy_node()
    rclpy.try_shutdown(context=made.context)


def test_waits_for_events_once_a_period(spun: Spun) -> None:
    spun.node.create_publisher(Empty, "topic", 1)
    assert spun.waits_for_events()
    assert [spun.waits_for_events() for _ in range(3)] == [False] * 3
    spun.now_s += 0.9 * EVENT_PERIOD_S
    assert not spun.waits_for_events()
    spun.now_s += 0.2 * EVENT_PERIOD_S
    assert spun.waits_for_events()
    assert not spun.waits_for_events()


def test_an_event_that_came_between_is_delivered_then(spun: Spun) -> None:
    events: list[Any] = []
    callbacks = PublisherEventCallbacks(matched=events.append)
    publisher = spun.node.create_publisher(Empty, "topic", 1, event_callbacks=callbacks)
    spun.waits_for_events()
    spun.node.create_subscription(Empty, "topic", lambda _: None, 1)
    spun.until(publisher.get_subscription_count)
    for _ in range(5):
        assert not spun.waits_for_events()
    assert events == []
    spun.now_s += 2.0 * EVENT_PERIOD_S
    spun.until(lambda: events)
    assert events[0].current_count == 1


def test_messages_are_taken_in_waits_without_events(spun: Spun) -> None:
    publisher = spun.node.create_publisher(Empty, "topic", 1)
    messages: list[Any] = []
    spun.node.create_subscription(Empty, "topic", messages.append, 1)
    spun.until(publisher.get_subscription_count)
    spun.waits_for_events()
    assert not spun.waits_for_events()
    publisher.publish(Empty())
    spun.until(lambda: messages)
    assert len(messages) == 1
