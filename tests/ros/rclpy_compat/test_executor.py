# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The executor runs what rclpy's runs, but does not wait for events of publishers and subscriptions every time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rclpy.event_handler import EventHandler, PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Empty

from ba_node.ros.rclpy_compat.executor import EVENT_PERIOD_S, NodeExecutor


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


@pytest.fixture
def alarms(spun: Spun, monkeypatch: pytest.MonkeyPatch) -> list[GuardCondition]:
    """Return a list into which the executor's alarm is put each time that it goes off."""
    gone_off: list[GuardCondition] = []
    trigger = GuardCondition.trigger

    def spy(guard: GuardCondition) -> None:
        if guard is spun.executor._guard:
            gone_off.append(guard)
        trigger(guard)

    monkeypatch.setattr(GuardCondition, "trigger", spy)
    return gone_off


def test_a_callback_does_not_end_the_wait_after_it(spun: Spun, alarms: list[GuardCondition]) -> None:
    calls: list[int] = []
    guard = spun.node.create_guard_condition(lambda: calls.append(1))
    spun.until(lambda: not guard.trigger() and len(calls) >= 5)
    alarms.clear()
    spun.until(lambda: not guard.trigger() and len(calls) >= 10)
    assert alarms == []


def test_other_threads_end_a_wait(spun: Spun, alarms: list[GuardCondition]) -> None:
    done: list[str] = []
    thread = threading.Thread(target=lambda: spun.executor.create_task(lambda: done.append("task")))
    thread.start()
    thread.join()
    assert alarms
    spun.until(lambda: done)


def test_a_coroutine_that_waits_is_looked_at_after_every_callback(spun: Spun, alarms: list[GuardCondition]) -> None:
    future, done = Future(), list[str]()

    async def wait() -> None:
        await future
        done.append("waited")

    spun.executor.create_task(wait)
    calls: list[int] = []
    guard = spun.node.create_guard_condition(lambda: calls.append(1))
    spun.until(lambda: not guard.trigger() and calls)
    assert not done
    alarms.clear()
    calls.clear()
    spun.until(lambda: not guard.trigger() and calls)
    assert alarms
    future.set_result(None)
    spun.until(lambda: done)


@pytest.mark.usefixtures("domain")
def test_an_rclpy_made_otherwise_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = SingleThreadedExecutor.__init__

    def other(self: Any, **kwargs: Any) -> None:
        plain(self, **kwargs)
        self._guard = Alien(self._guard)

    class Alien:
        def __init__(self, inner: Any) -> None:
            self.inner = inner

        def __getattr__(self, name: str) -> Any:
            return getattr(self.inner, name)

    monkeypatch.setattr(SingleThreadedExecutor, "__init__", other)
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    executor = NodeExecutor(context)
    try:
        assert isinstance(executor._guard, Alien)
    finally:
        executor.shutdown()
        rclpy.try_shutdown(context=context)
