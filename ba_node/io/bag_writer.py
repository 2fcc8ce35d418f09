# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write MCAP recordings that ``ros2 bag play`` of Jazzy takes, the same bytes for the same messages."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from ba_node.io import ros_types
from ba_node.io.bag_source import BagChannel
from ba_node.io.bag_topics import BagError
from ba_node.io.files import whole_file

# The form in which rosbag2 of Jazzy (metadata version 9) stores the profile of a publisher; the durations are
# RMW_DURATION_INFINITE.
_QOS = """\
- history: keep_last
  depth: {depth}
  reliability: reliable
  durability: {durability}
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""


class BagWriter:
    """Write a recording. Use it as a context manager: the file takes its name when the block ends without an error.

    Args:
        path: the file, ``*.mcap``; an older one is replaced.
        streaming: the file has its name from the beginning, and must not be there yet; so it outlives its process.
    """

    def __init__(self, path: Path | str, *, streaming: bool = False) -> None:
        self._path, self._streaming = Path(path), streaming
        self._stack = contextlib.ExitStack()
        self._types: dict[str, tuple[str, bool]] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._sequences: dict[int, int] = {}

    def __enter__(self) -> BagWriter:
        new = self._path.open("xb") if self._streaming else whole_file(self._path)
        stream = self._stack.enter_context(new)
        # The name of the library must not bring a version, and with it other bytes, into the file.
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="ba_node")
        self._stack.push(self._finish)
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without types

    def write(self, topic: str, type_name: str, message: Any, log_time_ns: int, latched: bool = False) -> None:
        """Add a message made with ``ROSBAGS_FACTORY``, at a time of recording, ns, that players and readers go by.

        Names in a bag are absolute: a missing leading slash is added. ``latched`` is durability ``transient_local``.

        Raises:
            BagError: a time outside uint64, a topic with two types or durabilities, a message that does not fit.
        """
        topic = topic if topic.startswith("/") else f"/{topic}"
        if not 0 <= log_time_ns < 2**64:
            raise BagError(f"{self._path}: topic {topic}: log time {log_time_ns} ns: expected a number in [0, 2^64)")
        if self._types.setdefault(topic, (type_name, latched)) != (type_name, latched):
            before = self._types[topic]
            raise BagError(
                f"{self._path}: topic {topic}: type {type_name}, latched {latched}; it was opened with"
                f" {before[0]}, latched {before[1]}: a topic keeps both"
            )
        try:
            data = ros_types.encode(type_name, message)
        except Exception as error:  # generated encoders raise whatever a wrong value leads them to
            raise BagError(f"{self._path}: topic {topic}: message does not fit {type_name}: {error}") from error
        if (topic, type_name) not in self._channels:
            text, about = ros_types.schema_text(type_name), {"topic_type_hash": ros_types.type_hash(type_name)}
            self._register(BagChannel(0, topic, type_name, ("cdr", "ros2msg"), text, None, latched), about)
        self._add(self._channels[topic, type_name], log_time_ns, data)

    def copy(self, channel: BagChannel, log_time_ns: int, data: bytes) -> None:
        """Add a message of another recording as it is, with the definition that it had there."""
        if (channel.topic, channel.type_name) not in self._channels:
            self._register(channel, {})
        self._add(self._channels[channel.topic, channel.type_name], log_time_ns, data)

    def _add(self, channel: int, log_time_ns: int, data: bytes) -> None:
        sequence = self._sequences.get(channel, 0)
        self._sequences[channel] = sequence + 1
        self._writer.add_message(channel, log_time_ns, data, publish_time=log_time_ns, sequence=sequence)

    def _register(self, channel: BagChannel, about: dict[str, str]) -> None:
        (kind, encoding), schema = channel.encoding, (channel.type_name, channel.definition)
        if schema not in self._schemas:
            text = channel.definition.encode()
            self._schemas[schema] = self._writer.register_schema(channel.type_name, encoding, text)
        about = {"offered_qos_profiles": _qos(channel.is_latched), **about}
        number = self._writer.register_channel(channel.topic, kind, self._schemas[schema], about)
        self._channels[channel.topic, channel.type_name] = number


def _qos(latched: bool) -> str:
    return _QOS.format(depth=1 if latched else 10, durability="transient_local" if latched else "volatile")
