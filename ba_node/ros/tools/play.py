# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish a recording on live topics, where `ros2 bag play` is not at hand.

The recorded bytes go out as they are. Play begins when someone listens, repeats what gets lost on the way, and ends
when everything has been acknowledged. Whoever begins later than the recording does still gets the cameras from before.
Writers keep all that is not acknowledged: a subscriber with history keep_all
slows the play down when it falls behind. One with a queue of limited depth drops the oldest from it, which is to be
expected at rate 0.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import InvalidNamespaceException
from rclpy.time import Time

from ba_node.io.bag_reader import BagReader
from ba_node.measurements import CameraRig
from ba_node.messages.conversion import input_message
from ba_node.messages.topics import CAMERA_TYPES, CLOCK, INPUT_TYPES, TOPICS
from ba_node.ros import qos
from ba_node.ros.message_factory import RclpyFactory, message_class
from ba_node.ros.rclpy_compat.private import ARGUMENT_ERRORS, RCLError
from ba_node.ros.tools.node import node_apart

_WRONG_OPTIONS = (*ARGUMENT_ERRORS, InvalidNamespaceException)
_POLL_S = 0.02
# Fast DDS asks for acknowledgements every 3 s.
_ACK_TIMEOUT_S = 10.0
_LATCHED_DEPTH = 10
_LINGER_S = 0.5
_playing: list[Any] = []
# What a user calls the fields of PlayOptions that are numbers.
_OPTIONS = {"rate": "--rate", "wait_s": "--wait", "start_s": "--start", "rounds": "--loop", "clock_hz": "--clock"}


class PlayError(ValueError):
    """Options that cannot be used, or a recording without anything to play."""


@dataclass(frozen=True)
class PlayOptions:
    """How to play."""

    rate: float = 1.0  # times real time; 0 for as fast as the middleware takes it
    wait_s: float = 10.0  # how long to wait for a subscriber of each input of the node before the first message, s
    # where to begin, from the first message on, s; latched messages from before are sent all the same
    start_s: float = 0.0
    rounds: int = 1  # how often to play; 0 for ever
    # publish the time of the recording on /clock, so often a second of real time; 0 for not at all
    clock_hz: float = 0.0
    namespace: str = ""  # put in front of every topic
    topics: Collection[str] | None = None  # play only these; all if None
    # as on the command line, for example ("--ros-args", "-r", "keyframes:=front/keyframes")
    ros_args: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, option in _OPTIONS.items():
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0:
                raise PlayError(f"{option} {value:g}: expected a finite number, 0 or more")


@dataclass(frozen=True)
class PlaySummary:
    """What was played."""

    published: Mapping[str, int]  # messages by topic, as resolved
    skipped: Mapping[str, str]  # type by topic of what this Python environment has no message class for
    unheard: tuple[str, ...]  # topics that had no subscriber when play began
    unconfirmed: tuple[str, ...]  # topics with messages that were not acknowledged in time
    duration_s: float  # from the first message to the last, s


@dataclass(frozen=True)
class Listener:
    """Who is told about the play."""

    # called with the number of messages done and of all messages
    progress: Callable[[int, int], None] = lambda *_: None
    notice: Callable[[str], None] = lambda *_: None  # called with a line of text


def play(bag: Path | str, options: PlayOptions = PlayOptions(), listener: Listener = Listener()) -> PlaySummary:
    """Publish the messages of a recording at the times they were recorded.

    Raises:
        BagError: the recording cannot be read.
        PlayError: none of its topics can be published, or a subscriber hangs.
    """
    with BagReader(bag) as reader, _node(options) as node:
        player = _Player(reader, node, options, listener)
        player.wait()
        return player.run()


@contextlib.contextmanager
def _node(options: PlayOptions) -> Iterator[Any]:
    """Make the node that publishes."""
    apart = node_apart("ba_play", args=options.ros_args, namespace=options.namespace)
    try:
        node, _ = apart.__enter__()
    except _WRONG_OPTIONS as error:
        raise PlayError(f"--namespace or --remap: {error}") from error
    _playing.append(node)
    try:
        yield node
    finally:
        _playing.remove(node)
        apart.__exit__(None, None, None)


def publish_rig(rig: CameraRig, namespace: str, said: Callable[[str], None]) -> NoReturn:
    """Publish a latched rig on ``camera_rig`` until the process ends; ``said`` is told the name of the topic.

    Raises:
        PlayError: the namespace is none.
    """
    with _node(PlayOptions(namespace=namespace)) as node:
        topic = TOPICS["camera_rig"]
        publisher = node.create_publisher(message_class(topic.type_name), topic.name, qos.latched())
        publisher.publish(input_message(RclpyFactory(), rig, node.get_clock().now().nanoseconds)[1])
        said(publisher.topic_name)
        while True:
            time.sleep(_ACK_TIMEOUT_S)


def take_leave() -> None:
    """Let subscribers know that the play is over: the process is about to end in the middle of it."""
    nodes = list(_playing)
    for node in nodes:
        # A publisher in the middle of a message, where a signal is taken up most often, is not destroyed before it is
        # through, and now it never will be.
        for publisher in node.publishers:
            with contextlib.suppress(RuntimeError):
                publisher.handle.__exit__(None, None, None)
        node.destroy_node()
    # That writers are gone is repeated until others have it; that the participant is gone is said once, and lost where
    # a socket is still full of what was played.
    time.sleep(_LINGER_S if nodes else 0.0)
    for node in nodes:
        rclpy.try_shutdown(context=node.context)


class _Time:
    """Publishes the time of the recording, which is the same for all namespaces."""

    def __init__(self, node: Any, rate_hz: float) -> None:
        self._kind = message_class(TOPICS[CLOCK].type_name)
        self._publisher = node.create_publisher(self._kind, CLOCK, qos.reliable(max(1, round(rate_hz))))
        self._last_ns = -1
        self.count = 0

    def publish(self, time_ns: int) -> None:
        """Publish a time, unless it was published last."""
        if time_ns == self._last_ns:
            return
        self._last_ns = time_ns
        self.count += 1
        self._publisher.publish(self._kind(clock=Time(nanoseconds=time_ns).to_msg()))


class _Player:
    def __init__(self, reader: BagReader, node: Any, options: PlayOptions, listener: Listener) -> None:
        self._reader = reader
        self._options = options
        self._listener = listener
        self._skipped: dict[str, str] = {}
        self._publishers: dict[str, Any] = {}
        self._time = _Time(node, options.clock_hz) if options.clock_hz else None
        for topic, kind in reader.topics.items():
            if options.topics is not None and topic not in options.topics:
                continue
            if self._time is not None and topic == CLOCK:
                continue  # there is one time
            try:
                cls = message_class(kind)
            except LookupError as error:
                self._skipped[topic] = kind
                listener.notice(f"{topic} is skipped: {error}")
                continue
            profile = qos.latched(_LATCHED_DEPTH) if kind in CAMERA_TYPES else qos.lossless()
            # Without the leading slash, so that a namespace moves it.
            self._publishers[topic] = node.create_publisher(cls, topic.removeprefix("/"), profile)
        if not self._publishers:
            there = ", ".join(f"{topic} ({kind})" for topic, kind in reader.topics.items())
            raise PlayError(f"{reader.path}: no topic can be played; topics in the recording: {there}")
        self._begin_ns = self._find_begin()

    def wait(self) -> None:
        """Wait for subscribers of the node's inputs, or if the recording has none of these, for any subscriber."""
        inputs = [topic for topic in self._publishers if self._reader.topics[topic] in INPUT_TYPES.values()]
        needed = all if inputs else any
        candidates = inputs or list(self._publishers)
        end = time.monotonic() + self._options.wait_s
        while not needed(self._heard(topic) for topic in candidates) and time.monotonic() < end:
            time.sleep(_POLL_S)
        self._unheard = tuple(self._publishers[topic].topic_name for topic in candidates if not self._heard(topic))
        if inputs and self._unheard:
            self._listener.notice(f"nobody listens to {', '.join(self._unheard)}")
        elif len(self._unheard) == len(candidates):
            self._listener.notice("nobody listens to any of the topics")

    def _heard(self, topic: str) -> bool:
        return bool(self._publishers[topic].get_subscription_count())

    def run(self) -> PlaySummary:
        """Publish everything."""
        published: Counter[str] = Counter()
        began = time.monotonic()
        rounds = itertools.count() if self._options.rounds == 0 else range(self._options.rounds)
        for _ in rounds:
            self._play_once(published)
        duration_s = time.monotonic() - began
        if self._time is not None:
            published[CLOCK] = self._time.count
        return PlaySummary(dict(published), self._skipped, self._unheard, self._confirm(), duration_s)

    def _play_once(self, published: Counter[str]) -> None:
        """Publish from the start to the end."""
        begin_ns = self._begin_ns
        total = self._reader.message_count
        # Cameras are latched: one that was recorded late was known to all from the beginning.
        for topic, data in self._reader.late_cameras():
            if topic in self._publishers:
                self._publish(self._publishers[topic], data)
        start = time.monotonic()
        for done, (topic, _, log_time_ns, data) in enumerate(self._reader.messages(), start=1):
            latched = self._reader.topics[topic] in CAMERA_TYPES
            if topic in self._publishers and (log_time_ns >= begin_ns or latched):
                self._wait_for(start, max(log_time_ns, begin_ns), begin_ns)
                self._publish(self._publishers[topic], data)
                published[self._publishers[topic].topic_name] += 1
            self._listener.progress(done, total)

    def _find_begin(self) -> int:
        """Return the time of the recording at which play begins, ns.

        Raises:
            PlayError: the recording is over by then.
        """
        times = [log_time_ns for _, _, log_time_ns, _ in self._reader.messages()] if self._options.start_s else []
        if not times:
            return next((log_time_ns for _, _, log_time_ns, _ in self._reader.messages()), 0)
        length_s = (times[-1] - times[0]) * 1e-9
        if self._options.start_s > length_s:
            raise PlayError(f"--start {self._options.start_s:g}: the recording is {length_s:.1f} s long")
        return times[0] + round(self._options.start_s * 1e9)

    def _publish(self, publisher: Any, data: bytes) -> None:
        """Publish, waiting for a subscriber that is behind."""
        end = time.monotonic() + _ACK_TIMEOUT_S
        while (error := _try_to_publish(publisher, data)) is not None:
            if time.monotonic() > end:
                where = f"{publisher.topic_name}: a subscriber takes no messages any more"
                raise PlayError(f"{where} (waited {_ACK_TIMEOUT_S:g} s): {error}")

    def _wait_for(self, start: float, time_ns: int, begin_ns: int) -> None:
        """Sleep until a time of the recording, and publish it."""
        rate = self._options.rate
        due = start + (time_ns - begin_ns) * 1e-9 / rate if rate else start
        while (left := due - time.monotonic()) > 0.0 and rate:
            if self._time is None:
                time.sleep(left)
            else:
                self._time.publish(time_ns - round(left * rate * 1e9))
                time.sleep(min(left, 1.0 / self._options.clock_hz))
        if self._time is not None:
            self._time.publish(time_ns)

    def _confirm(self) -> tuple[str, ...]:
        """Wait until the subscribers have got what was sent; return the topics where they have not."""
        timeout = Duration(seconds=_ACK_TIMEOUT_S)
        late = [publisher for publisher in self._publishers.values() if not publisher.wait_for_all_acked(timeout)]
        for publisher in late:
            self._listener.notice(f"{publisher.topic_name}: a subscriber has not confirmed everything that was sent")
        return tuple(publisher.topic_name for publisher in late)


def _try_to_publish(publisher: Any, data: bytes) -> Exception | None:
    """Publish; return the error if the writer is full, which it reports after 0.1 s."""
    try:
        publisher.publish(data)
    except RCLError as error:
        return error
    return None
