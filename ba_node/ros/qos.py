# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the quality of service of every topic, let parameters override it, and say what does not fit together.

The parameters are those of ROS: ``qos_overrides.<topic>.publisher.<policy>`` and ``.subscription.<policy>``, with the
resolved name of the topic and the policies history, depth, reliability and durability.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    qos_check_compatible,
    qos_policy_name_from_kind,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import QoSOverridingOptions

from ba_node.messages.topics import CAMERAS, Delivery, Topic
from ba_node.ros.worker.worker import Notice

# Bursts that one solve sends: one pose for each keyframe of a window.
OUTPUT_DEPTH = 1000
SENSOR_DATA = qos_profile_sensor_data
OVERRIDES = "qos_overrides."
_NAMES_S = 1.0
_OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)


def reliable(depth: int) -> Any:
    """Return a profile that repeats lost messages and keeps nothing for late subscribers."""
    return QoSProfile(depth=depth)


def lossless() -> Any:
    """Return a profile that keeps every message until all subscribers have acknowledged it."""
    return QoSProfile(history=HistoryPolicy.KEEP_ALL)


def latched(depth: int = 1) -> Any:
    """Return a profile whose last messages reach subscribers that come later."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def profile(topic: Topic, depth: int = OUTPUT_DEPTH) -> Any:
    """Return the profile to publish a topic with, or to subscribe to it.

    A latched subscription alone does not match a camera driver, which publishes camera_info volatile and often best
    effort; one with ``SENSOR_DATA`` alone misses what was latched before the node came. Cameras are taken from both.
    """
    if topic.delivery is Delivery.BEST_EFFORT:
        return SENSOR_DATA
    return reliable(depth) if topic.delivery is Delivery.RELIABLE else latched()


def at_peace() -> dict[str, Any]:
    """Return the options of the second subscription to the cameras: not overridden, and at peace with any publisher."""
    events = SubscriptionEventCallbacks(use_default_callbacks=False)
    return {"event_callbacks": events, "qos_overriding_options": None}


def for_subscription(node: Any, topic: str, log: Callable[[Notice], None]) -> dict[str, Any]:
    """Return the options with which a subscription can be overridden and tells of incompatible peers and losses."""

    def incompatible(event: Any) -> None:
        _later(node, lambda: log(_mismatch(node, topic, "publisher", event)))

    def lost(event: Any) -> None:
        name = node.resolve_topic_name(topic)
        peers = _peers(node.get_publishers_info_by_topic(name))
        text = f"{name}: {event.total_count_change} messages of {peers} were lost ({event.total_count} so far)"
        log(Notice(f"lost {name}", text))

    if topic in CAMERAS:
        # A driver that publishes volatile does not match this subscription but the other one, and is welcome.
        events = SubscriptionEventCallbacks(message_lost=lost, use_default_callbacks=False)
    else:
        events = SubscriptionEventCallbacks(incompatible_qos=incompatible, message_lost=lost)
    return {"event_callbacks": events, "qos_overriding_options": QoSOverridingOptions(_OVERRIDABLE)}


def for_publisher(
    node: Any, topic: str, log: Callable[[Notice], None], matched: Callable[[Any], None] | None = None
) -> dict[str, Any]:
    """Return the options with which a publisher can be overridden and tells of incompatible peers, and of others."""

    def incompatible(event: Any) -> None:
        _later(node, lambda: log(_mismatch(node, topic, "subscriber", event)))

    events = PublisherEventCallbacks(incompatible_qos=incompatible, matched=matched)
    return {"event_callbacks": events, "qos_overriding_options": QoSOverridingOptions(_OVERRIDABLE)}


def _later(node: Any, action: Callable[[], None]) -> None:
    """Do something once the middleware has learned the names of nodes, which come after their topics."""

    def once() -> None:
        node.destroy_timer(timer)
        action()

    timer = node.create_timer(_NAMES_S, once, clock=Clock(clock_type=ClockType.STEADY_TIME))


def _mismatch(node: Any, topic: str, role: str, event: Any) -> Notice:
    """Say which peers an endpoint of this node does not match, and by which policy the last of them differs."""
    name = node.resolve_topic_name(topic)
    sides = node.get_publishers_info_by_topic(name), node.get_subscriptions_info_by_topic(name)
    others, own = sides if role == "publisher" else sides[::-1]
    mine = [info.qos_profile for info in own if is_of(info, node)]
    at_fault = [o for o in others if not any(_compatible(o.qos_profile, profile, role) for profile in mine)]
    text = (
        f"{name}: no messages pass between this node and {role} {_peers(at_fault)}: incompatible"
        f" {qos_policy_name_from_kind(event.last_policy_kind)}; change it there, or here with the parameters"
        f" {OVERRIDES}{name}.*"
    )
    return Notice(f"qos {name}", text)


def _peers(infos: Iterable[Any]) -> str:
    return " and ".join(sorted({peer_name(info) for info in infos})) or "a node that has gone"


def peer_name(info: Any) -> str:
    """Return the full name of the node of an endpoint."""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def is_of(info: Any, node: Any) -> bool:
    """Return True for an endpoint of a node."""
    return bool((info.node_name, info.node_namespace) == (node.get_name(), node.get_namespace()))


def _compatible(theirs: Any, mine: Any, role: str) -> bool:
    pair = (theirs, mine) if role == "publisher" else (mine, theirs)
    return bool(qos_check_compatible(*pair)[0] != QoSCompatibility.ERROR)
