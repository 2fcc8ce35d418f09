# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Record the inputs of the node from live topics, where `ros2 bag record` is not at hand.

Topics are found by type as they appear, under a namespace where one is given. Bytes are written as they come, with the
time of their arrival, into a file that has its name from the beginning: what a killed process leaves is read as far as
it goes.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from ba_node.io import ros_types
from ba_node.io.bag_writer import BagWriter
from ba_node.messages.topics import INPUT_TYPES, ON_DEMAND, OUTPUT_TYPES, TF_STATIC, TOPICS
from ba_node.ros.message_factory import message_class
from ba_node.ros.tools.node import node_apart

_POLL_S, _LOOK_S = 0.05, 0.5
_WANTED = frozenset(INPUT_TYPES.values())
_OUTPUTS = frozenset((*OUTPUT_TYPES, *ON_DEMAND))
# The name that ROS gives the node of a publisher before it knows it.
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
# Messages that wait while one is written; cameras and static transforms come once from each publisher.
_DEPTH, _LATCHED_DEPTH = 2000, 100


class RecordError(ValueError):
    """Options that cannot be used, or nothing to record."""


@dataclass(frozen=True)
class RecordOptions:
    """What to record."""

    namespace: str = ""  # only topics below it
    topics: Collection[str] = ()  # these too, whatever their type
    duration_s: float = 0.0  # 0 for until it is stopped


class Recorder:
    """Record until told to stop."""

    def __init__(self, path: Path, options: RecordOptions, notice: Callable[[str], None]) -> None:
        self.counts: Counter[str] = Counter()  # messages by topic
        self._path, self._options, self._notice = path, options, notice
        self._subscriptions: dict[str, Any] = {}
        self._refused: set[str] = set()
        self._named = {name if name.startswith("/") else f"/{name}" for name in options.topics}
        self._stopped = False

    def stop(self, *_: object) -> None:
        """End the recording soon; may be called by a signal."""
        self._stopped = True

    def run(self) -> float:
        """Record; return for how long, s.

        Raises:
            RecordError: no message came.
            OSError: the file is there already, or cannot be written.
        """
        looked = -_LOOK_S
        with node_apart("ba_record") as (node, executor), BagWriter(self._path, streaming=True) as writer:
            began = time.monotonic()
            while not self._stopped and not self._is_over(time.monotonic() - began):
                if time.monotonic() - looked >= _LOOK_S:
                    looked = time.monotonic()
                    self._look(node, writer)
                executor.spin_once(timeout_sec=_POLL_S)
            seen, lasted_s = self._seen(node), time.monotonic() - began
        if not self.counts:
            self._path.unlink()
            raise RecordError(f"{self._path}: no message came{seen}")
        return lasted_s

    def _is_over(self, seconds: float) -> bool:
        return 0.0 < self._options.duration_s <= seconds

    def _look(self, node: Any, writer: BagWriter) -> None:
        """Subscribe to what has appeared."""
        for topic, kinds in node.get_topic_names_and_types():
            if topic in self._subscriptions or topic in self._refused or not self._is_wanted(topic, kinds):
                continue
            publishers = node.get_publishers_info_by_topic(topic)
            if not publishers or (_is_output(topic, publishers) and topic not in self._named):
                continue
            try:
                kind = message_class(kinds[0])
                if not ros_types.is_known(kinds[0]):
                    raise LookupError(f"no definition of {kinds[0]} is known")
            except LookupError as error:
                self._refused.add(topic)
                self._notice(f"{topic} is not recorded: {error}")
                continue
            latched = all(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in publishers)
            profile = _profile(publishers, latched)
            receive = self._receiver(writer, topic, kinds[0], latched)
            self._subscriptions[topic] = node.create_subscription(kind, topic, receive, profile, raw=True)
            self._notice(f"recording {topic} ({kinds[0]})")

    def _receiver(self, writer: BagWriter, topic: str, kind: str, latched: bool) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            writer.write(topic, kind, data, time.time_ns(), latched=latched)
            self.counts[topic] += 1

        return receive

    def _is_wanted(self, topic: str, kinds: Collection[str]) -> bool:
        if topic in self._named or topic == TF_STATIC:
            return True
        space = f"/{self._options.namespace.strip('/')}/".replace("//", "/")
        return bool(_WANTED & set(kinds)) and topic.startswith(space)

    def _seen(self, node: Any) -> str:
        inputs = ", ".join(f"{TOPICS[name].type_name}" for name in INPUT_TYPES)
        there = ", ".join(sorted(topic for topic, _ in node.get_topic_names_and_types())) or "none"
        return f": expected topics of {inputs}; topics in this ROS domain: {there}"


def _is_output(topic: str, publishers: Collection[Any]) -> bool:
    """Return True if a back-end publishes it: of a type that is taken too, but what it works out is no input.

    Who publishes may become known later than that somebody does.
    """
    known = [info for info in publishers if info.node_name != _UNKNOWN]
    nodes = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in known}
    node, _, name = topic.rpartition("/")
    return name in _OUTPUTS and nodes <= {node}


def _profile(publishers: Collection[Any], latched: bool) -> Any:
    """Return a profile that matches all publishers of a topic, and loses nothing where they repeat what is lost."""
    reliable = all(info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in publishers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_LATCHED_DEPTH if latched else _DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
