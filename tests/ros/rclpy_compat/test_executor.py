# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The executor of events serves the node; where rclpy has none, the one with wait sets does."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Empty

from ba_node.ros.rclpy_compat import executor as made_here

pytestmark = pytest.mark.dds


@pytest.fixture(params=["events", "wait_sets"])
def spun(
    domain: int,  # noqa: ARG001
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[tuple[Node, Any]]:
    """Return a node and the executor that it is in."""
    if request.param == "wait_sets":
        monkeypatch.setattr(made_here, "EventsExecutor", None)
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    node = Node("spun", context=context, start_parameter_services=False, enable_rosout=False)
    executor = made_here.make_executor(context)
    assert isinstance(executor, SingleThreadedExecutor) == (request.param == "wait_sets")
    executor.add_node(node)
    yield node, executor
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_messages_events_and_tasks_of_other_threads_are_run(spun: tuple[Node, Any]) -> None:
    node, executor = spun
    seen: list[str] = []
    callbacks = PublisherEventCallbacks(matched=lambda _: seen.append("matched"))
    publisher = node.create_publisher(Empty, "topic", 1, event_callbacks=callbacks)
    node.create_subscription(Empty, "topic", lambda _: seen.append("message"), 1)
    thread = threading.Thread(target=lambda: node.executor.create_task(lambda: seen.append("task")))
    thread.start()
    end_s = time.monotonic() + 20.0
    while set(seen) != {"matched", "message", "task"}:
        assert time.monotonic() < end_s, f"only {seen} within 20 s"
        if publisher.get_subscription_count() and "message" not in seen:
            publisher.publish(Empty())
        executor.spin_once(0.01)
    thread.join()
    assert seen.count("matched") == seen.count("task") == 1


def test_what_a_callback_raises_comes_out_of_the_spin(spun: tuple[Node, Any]) -> None:
    node, executor = spun

    def fail() -> None:
        raise ValueError("as asked")

    node.create_timer(0.01, fail)
    with pytest.raises(ValueError, match="as asked"):
        spin_for_a_while(executor)


def spin_for_a_while(executor: Any) -> None:
    for _ in range(100):
        executor.spin_once(0.1)
