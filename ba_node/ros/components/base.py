# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What a part of the node is, and what it gets to work with.

The node (``node.py``) is a list of components. A component makes its publishers, subscriptions, services and timers
when the node is configured, and they are destroyed when the node is cleaned up. All its methods but ``take_poses``, and
all callbacks of the entities that it made, run on the executor's thread; what is to run on the solver's thread goes
through ``host.inbox.post(command)``, and comes back with the next estimate, or as a Notice.

To add one: a class derived from :class:`Component` in a file of its own, its name in ``node.COMPONENTS``, and its topic
in ``messages/topics.py``::

    class Status(Component):
        def __init__(self, host: Host) -> None:
            super().__init__(host)
            self._publisher = self.publisher(TOPICS["status"])

        def take(self, estimate: Estimate, newest: bool) -> None:
            if newest and self._publisher.get_subscription_count():
                self._publisher.publish(...)
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from rclpy.clock import Clock, ClockType

from ba_node.config import Config
from ba_node.estimate import Estimate, Refinement
from ba_node.measurements import CameraRig
from ba_node.messages.report import Report
from ba_node.messages.topics import Topic
from ba_node.ros import qos
from ba_node.ros.message_factory import message_class
from ba_node.ros.rclpy_compat.deferred import DeferredAnswers
from ba_node.ros.worker.inbox import Inbox
from ba_node.ros.worker.worker import Notice, Outcome, Worker


@dataclass
class Host:
    """What the node lends its components, from configure to cleanup."""

    node: Any  # the rclpy node: names, clock, logger. Entities are made with the methods of Component.
    config: Config  # the parameters as they are now
    inbox: Inbox  # where measurements and commands for the back-end go
    worker: Worker  # the solver's thread
    deferred: DeferredAnswers  # brings work to the executor's thread, and knows the answers that clients wait for
    log: Callable[[Notice], None]  # log a Notice, the same one not more often than every few seconds
    active: bool = False  # True between activate and deactivate
    leaving: threading.RLock = field(default_factory=threading.RLock)  # held while poses leave
    # why data is ignored now, in words that serve as a key ("inactive"); empty when it is taken
    ignoring: set[str] = field(default_factory=lambda: {"inactive"})
    # what this side of the inbox turned away, by reason; it goes into the report
    counted: Counter[str] = field(default_factory=Counter)
    arrived: Counter[str] = field(default_factory=Counter)  # messages that came in, by topic; ignored ones too
    # gives cameras the places that the parameters ask for; None: they have to wait
    place_cameras: Callable[[CameraRig], CameraRig | None] = lambda rig: rig
    tf: str = ""  # what becomes of the transform map -> odom, in words
    clock: str = ""  # what is wrong with simulated time, in words; empty if nothing is
    report: Report | None = None  # the last one, with its latency; None before the first
    # what is undone when the node is cleaned up, last made first
    at_cleanup: ExitStack = field(default_factory=ExitStack)
    # what is undone a moment later: who was answered at cleanup must still hear it
    after_cleanup: ExitStack = field(default_factory=ExitStack)


class Component:
    """A part of the node. Made when the node is configured; derived classes override what concerns them."""

    def __init__(self, host: Host) -> None:
        """Make the entities. An exception refuses the configuration and destroys those made so far."""
        self.host = host

    def activate(self) -> None:
        """Begin: from now on estimates are delivered. ``host.active`` is True already."""

    def deactivate(self) -> None:
        """Pause: nothing may be published until :meth:`activate`. ``host.active`` is False already."""

    def take_poses(self, refinement: Refinement, arrived_s: float) -> None:
        """Take the poses of a solve, before there is a report on it; only while active.

        On the solver's thread, which holds ``host.leaving``: what the executor's thread works with too needs it there.
        ``arrived_s`` is when its newest keyframe came in, s.
        """

    def take_report(self, outcome: Outcome) -> None:
        """Take what the worker reports, of every solve and on what was turned away; only while active."""

    def take(self, estimate: Estimate, newest: bool) -> None:
        """Take an estimate as it leaves the worker, after the report on it, oldest first; only while active.

        Failed and skipped solves give one too. ``newest`` is the last of those that came together that replaces the
        map: what replaces the ones before needs only this.
        """

    def publisher(self, topic: Topic, profile: Any = None, **options: Any) -> Any:
        """Make a publisher that is destroyed at cleanup. Its profile can be overridden by parameters.

        Its quality of service is ``profile``, or that of the topic. Options are ``matched``, called when a subscriber
        comes or goes, and those of rclpy.

        Raises:
            LookupError: there is no message class of its type.
        """
        kind, name, matched = message_class(topic.type_name), topic.given_name, options.pop("matched", None)
        options = qos.for_publisher(self.host.node, name, self.host.log, matched) | options
        return self._owned("publisher", kind, name, profile or qos.profile(topic), **options)

    def subscription(self, topic: Topic, take: Callable[[Any], None], profile: Any, **options: Any) -> Any:
        """Make a subscription that is destroyed at cleanup; as :meth:`publisher`."""
        kind = message_class(topic.type_name)
        options = qos.for_subscription(self.host.node, topic.name, self.host.log) | options
        return self._owned("subscription", kind, topic.name, take, profile, **options)

    def timer(self, period_s: float, call: Callable[[], None]) -> Any:
        """Make a timer that is destroyed at cleanup. It goes by a steady clock, also while /clock stands still."""
        return self._owned("timer", period_s, call, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _owned(self, kind: str, *arguments: Any, **options: Any) -> Any:
        entity = getattr(self.host.node, f"create_{kind}")(*arguments, **options)
        # For what is not made here, an action server or a listener: self.host.at_cleanup.callback(its.destroy).
        self.host.at_cleanup.callback(getattr(self.host.node, f"destroy_{kind}"), entity)
        return entity
