# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Feed the node from another front-end: `ros2 run ba_node ba_adapter --from openvins`.

It subscribes to what the front-end publishes as soon as it is there, in whatever namespace, and publishes
``keyframes``, ``feature_tracks``, ``landmark_guesses`` and ``camera_rig``. A true ``std_msgs/Bool`` on ``restart``
begins a new session. Every few seconds the log says what was sent on and what was left out, by reason.
"""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.utilities import remove_ros_args

from ba_node.io.rig_file import RigError, read_rig
from ba_node.messages.adapters import SOURCES, Adapter, AdapterOptions, Input
from ba_node.messages.conversion import InputMessages
from ba_node.messages.topics import INPUT_TYPES, TOPICS
from ba_node.ros import qos
from ba_node.ros.log import Severity, log
from ba_node.ros.main import USAGE_ERROR, run
from ba_node.ros.message_factory import RclpyFactory, message_class
from ba_node.ros.rclpy_compat.lifecycle import answering

NODE_NAME = "ba_adapter"
PUBLISHED = ("camera_rig", "keyframes", "landmark_guesses", "feature_tracks")
_DEPTH = 1000
_LOOK_S = 0.5
_LOG_S = 5.0
_HINT = "; its package comes with the front-end (for rtabmap: ros-jazzy-rtabmap-msgs)"


class AdapterNode(Node):  # type: ignore[misc]  # rclpy is not typed
    """The converter node. The messages of its source must be installed."""

    def __init__(self, source: str, adapter: Adapter, **node_options: Any) -> None:
        super().__init__(NODE_NAME, **node_options)
        self.adapter = adapter
        self._source = source
        self._inputs = [one for one in SOURCES[source].inputs if one.type_name]
        for service in self.services:
            service.callback = answering(self, service.srv_name, service.srv_type.Response, service.callback)
        self._subscribed: dict[str, Input] = {}
        self._messages = InputMessages(RclpyFactory())
        self._said = self._ambiguous = ""
        self._out = {
            name: self.create_publisher(message_class(kind), name, qos.profile(TOPICS[name], _DEPTH))
            for name, kind in INPUT_TYPES.items()
            if name in PUBLISHED
        }
        self.create_subscription(message_class("std_msgs/msg/Bool"), "restart", self._on_restart, qos.reliable(10))
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_LOOK_S, self._look, clock=clock)
        self.create_timer(_LOG_S, self._report, clock=clock)

    def start(self) -> None:
        """Begin: it does as soon as it is there."""

    def stop(self) -> None:
        """Count what still waits."""
        self.adapter.finish()

    def summary(self) -> str:
        """Return in words what was sent on, and what was left out."""
        return "; ".join([self.adapter.summary(), *self.adapter.told()])

    def _look(self) -> None:
        """Subscribe to what is there now: an input under its own name, else under the same one in any namespace."""
        taken = {one.role for one in self._subscribed.values() if one.role}
        there = [(name, kinds) for name, kinds in self.get_topic_names_and_types() if self.count_publishers(name)]
        for one in self._inputs:
            if one.role in taken or one in self._subscribed.values():
                continue
            own = self.resolve_topic_name(one.name)
            same = [name for name, kinds in there if one.type_name in kinds]
            found = [name for name in same if name == own] or [
                name for name in same if name.rpartition("/")[2] == one.name
            ]
            if len(found) == 1:
                self._subscribe(one, found[0])
                taken.add(one.role)
            elif found and one.role:
                words = f"{one.name} is there more than once: {', '.join(found)}: say -r {one.name}:=TOPIC"
                self._ambiguous = self._ambiguous or self._tell(Severity.WARNING, words)

    def _subscribe(self, one: Input, topic: str) -> None:
        infos = self.get_publishers_info_by_topic(topic)
        reliable = all(info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT for info in infos)
        profile = qos.reliable(_DEPTH) if reliable else qos.SENSOR_DATA
        receive = functools.partial(self._receive, one.name)
        self._subscribed[topic] = one
        # The name is that of the graph: remapping has been done, and must not be done again.
        self.create_subscription(message_class(one.type_name), topic, receive, profile)
        self._tell(Severity.INFO, f"{topic} ({one.type_name}) is taken as {one.name}")

    def _receive(self, name: str, message: Any) -> None:
        for topic, stamp_ns, measurement in self.adapter.take(name, message):
            if topic == "keyframes" and not self._out[topic].get_subscription_count():
                self.adapter.leave("nobody_listens", f"{self.resolve_topic_name(topic)} has no subscriber")
            self._out[topic].publish(self._messages.of(measurement, stamp_ns)[1])

    def _on_restart(self, restart: Any) -> None:
        if restart.data:
            self.adapter.restart()
            self._tell(Severity.INFO, f"restart: {self.adapter.summary()}")

    def _report(self) -> None:
        """Log what has become of the images, when that has changed; and what is missing."""
        missing = [one for one in self._inputs if one.role and one.role not in self._roles()]
        words = self.summary()
        if missing:
            listed = ", ".join(f"{self.resolve_topic_name(one.name)} ({one.type_name})" for one in missing)
            words += f"; nobody publishes {listed}: is {self._source} running?"
        if self.adapter.waits_for_rig:
            words += "; images wait for the cameras, of which nothing is known: give them with --rig FILE"
        if words != self._said:
            self._said = self._tell(Severity.WARNING if missing or self.adapter.waits_for_rig else Severity.INFO, words)

    def _roles(self) -> set[str]:
        roles = {one.role for one in self._subscribed.values()}
        return roles | {"extrinsic"} if self.adapter.rig is not None else roles

    def _tell(self, severity: Severity, words: str) -> str:
        log(self, severity, words)
        return words


def main(args: Sequence[str] | None = None) -> int:
    """Run the converter until SIGINT or SIGTERM; return 2 if it cannot."""
    given = list(sys.argv if args is None else args)
    parser = argparse.ArgumentParser(prog=NODE_NAME, description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--from", dest="source", required=True, choices=SOURCES, help="the front-end that runs")
    parser.add_argument("--rig", type=Path, nargs="+", metavar="FILE", help="cameras as YAML, in any form of ba rig")
    parser.add_argument("--tolerance", type=float, default=1e-3, metavar="S", help="stamps pair within (%(default)s)")
    parser.add_argument("--parallax", type=float, default=1.0, metavar="DEG", help="between keyframes (%(default)s)")
    parser.add_argument("--cameras", type=int, default=0, metavar="N", help="NUM_OF_CAM of vins_mono (rig's, or 1)")
    said = parser.parse_args(remove_ros_args(given)[1:])
    kind = SOURCES[said.source]
    try:
        rig = read_rig(*said.rig) if said.rig else None
        for name in {one.type_name for one in kind.inputs} - {""}:
            message_class(name)
    except (RigError, LookupError) as error:
        print(f"{NODE_NAME}: {error}{_HINT if isinstance(error, LookupError) else ''}", file=sys.stderr)
        return USAGE_ERROR
    options = AdapterOptions(said.tolerance, said.parallax, rig=rig)
    adapter = Adapter(kind(said.cameras or (len(rig) if rig else 1)), options)
    return run(NODE_NAME, lambda: AdapterNode(said.source, adapter), [given[0], *_ros_words(given)])


def _ros_words(given: Sequence[str]) -> Iterator[str]:
    """Yield the arguments that are for ROS."""
    inside = False
    for word in given:
        inside = word == "--ros-args" or (inside and word != "--")
        if inside:
            yield word


if __name__ == "__main__":
    sys.exit(main())
