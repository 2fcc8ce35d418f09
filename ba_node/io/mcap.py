# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read MCAP recordings of ROS 2 without ROS; write them with :class:`BagWriter`."""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from ba_node.io import ros_types
from ba_node.io.bag_errors import BagError
from ba_node.io.bag_index import BagIndex, read_index, read_messages
from ba_node.io.bag_writer import BagWriter
from ba_node.io.ros_types import ROSBAGS_FACTORY, TypeMismatchError
from ba_node.messages.conversion import INPUT_TYPES, measurement_from_message

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

    from mcap.records import Channel

    from ba_node.measurements import Measurement

__all__ = ["ROSBAGS_FACTORY", "BagError", "BagReader", "BagWriter"]

_NOTES = 100


class BagReader:
    """Read a recording. Use it as a context manager.

    Args:
        path: the ``*.mcap`` file.

    Attributes:
        topics: type of each topic, as ``package/msg/Type``.
        message_count: messages in the file, as far as it is whole.
        rejected: what could not be read, counted by reason: ``truncated``, ``corrupt``, ``undecodable``.
        rejection_notes: the last of these in words, with topic and number.

    Raises:
        BagError: the file is empty, not MCAP, or holds no message that can be read.
    """

    topics: dict[str, str]
    message_count: int

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.rejected: Counter[str] = Counter()
        self.rejection_notes: deque[str] = deque(maxlen=_NOTES)
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> BagReader:
        with contextlib.ExitStack() as stack:
            self._stream = stack.enter_context(self._open())
            try:
                self._index = read_index(self._stream, self.path.stat().st_size)
            except BagError as error:
                raise BagError(f"{self.path}: {error}") from None
            self._stack = stack.pop_all()
        self.message_count = self._index.message_count
        self.topics = {}
        for channel in self._index.channels.values():
            self.topics.setdefault(channel.topic, _type_of(self._index, channel))
        for reason, words in self._index.problems:
            self._reject(reason, words)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield (topic, type, log time in ns, CDR bytes) by log time; same times in the order of the file.

        Args:
            topics: only these; all if None.

        Raises:
            BagError: nothing of the file can be read after all.
        """
        for channel_id, log_time, data in self._raw(self._channels(topics)):
            channel = self._index.channels[channel_id]
            yield channel.topic, _type_of(self._index, channel), log_time, data

    def decode(self, topic: str, data: bytes) -> Any:
        """Return the message in the bytes of a topic, by the definition in the recording.

        Raises:
            BagError: there is no such topic, or the bytes do not fit its definition.
        """
        channels = self._channels([topic])
        if not channels:
            raise BagError(f"{self.path}: no topic {topic}; there are: {', '.join(sorted(self.topics))}")
        try:
            return self._decoder(min(channels))(data)
        except TypeMismatchError as error:
            raise BagError(f"{self.path}: topic {topic}: {error}") from error
        except Exception as error:  # generated decoders raise whatever broken bytes lead them to
            raise BagError(f"{self.path}: topic {topic}: {type(error).__name__}: {error}") from error

    def measurements(self) -> Iterator[tuple[str, int, Measurement]]:
        """Yield (topic, log time in ns, measurement) of the input topics, in the order of :meth:`messages`.

        A topic is known by its type. Where several have the type of one input, the one with the input's name is
        taken, and of several such the one in the namespace of the keyframes. A lone camera (CameraInfo) is read only
        when there is no rig. Messages that cannot be read are counted in ``rejected``.

        Raises:
            BagError: keyframes, tracks or cameras are missing, or a definition lacks a field.
        """
        chosen = self._choose()
        # A topic can have channels of several types, from publishers that disagree.
        channels = {c.id for c in self._index.channels.values() if (c.topic, _type_of(self._index, c)) in chosen}
        for channel_id in sorted(channels):
            self._check(channel_id)
        return self._measurements(channels)

    def _measurements(self, channels: Collection[int]) -> Iterator[tuple[str, int, Measurement]]:
        numbers: Counter[str] = Counter()
        for channel_id, log_time, data in self._raw(channels):
            channel = self._index.channels[channel_id]
            type_name = _type_of(self._index, channel)
            number = numbers[channel.topic]
            numbers[channel.topic] += 1
            try:
                measurement = measurement_from_message(type_name, self._decoder(channel_id)(data))
            except Exception as error:  # as in decode: whatever the bytes are, the next message may be sound
                words = f"topic {channel.topic}, message {number}: {type(error).__name__}: {error}"
                self._reject("undecodable", words)
                continue
            yield channel.topic, log_time, measurement

    def _raw(self, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        count = 0
        lost = Counter[str]()

        def report(reason: str, words: str) -> None:
            lost[reason] += 1
            self._reject(reason, words)

        for message in read_messages(self._stream, self._index, channels, report):
            count += 1
            yield message.channel_id, message.log_time, message.data
        if lost and not count:
            raise BagError(f"{self.path}: no message can be read: {self.rejection_notes[-1]}")

    def _choose(self) -> set[tuple[str, str]]:
        """Return topic and type of each input that the recording has."""
        chosen: dict[str, str] = {}
        there = {(channel.topic, _type_of(self._index, channel)) for channel in self._index.channels.values()}
        for name, type_name in INPUT_TYPES.items():
            found = [topic for topic, kind in there if kind == type_name]
            space = chosen.get("keyframes", "").rpartition("/")[0]
            found.sort(key=lambda topic: (topic.rpartition("/")[2] != name, topic.rpartition("/")[0] != space, topic))
            if found:
                chosen[name] = found[0]
        if "camera_rig" in chosen:
            chosen.pop("camera_info", None)
        missing = [INPUT_TYPES[name] for name in ("keyframes", "feature_tracks") if name not in chosen]
        if "camera_rig" not in chosen and "camera_info" not in chosen:
            missing.append(f"{INPUT_TYPES['camera_rig']} or {INPUT_TYPES['camera_info']}")
        if missing:
            listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(there)) or "none"
            raise BagError(
                f"{self.path}: no topic of type {', and none of type '.join(missing)}; in the recording: {listed}"
            )
        return {(topic, INPUT_TYPES[name]) for name, topic in chosen.items()}

    def _channels(self, topics: Collection[str] | None) -> set[int]:
        channels = self._index.channels.values()
        return {channel.id for channel in channels if topics is None or channel.topic in topics}

    def _check(self, channel_id: int) -> None:
        channel = self._index.channels[channel_id]
        where = f"{self.path}: topic {channel.topic}"
        schema = self._index.schemas[channel.schema_id]
        if channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
            raise BagError(
                f"{where}: messages in {channel.message_encoding!r}, definitions in {schema.encoding!r}:"
                " expected 'cdr' and 'ros2msg', as ROS 2 records them"
            )
        try:
            ros_types.check_definition(_type_of(self._index, channel), _text(schema.data))
        except TypeMismatchError as error:
            raise BagError(f"{where}: {error}") from error

    def _decoder(self, channel_id: int) -> Callable[[bytes], Any]:
        if channel_id not in self._decoders:
            channel = self._index.channels[channel_id]
            schema = self._index.schemas.get(channel.schema_id)
            text = "" if schema is None else _text(schema.data)
            self._decoders[channel_id] = ros_types.decoder(_type_of(self._index, channel), text)
        return self._decoders[channel_id]

    def _reject(self, reason: str, words: str) -> None:
        self.rejected[reason] += 1
        self.rejection_notes.append(f"{self.path}: {words}")

    def _open(self) -> IO[bytes]:
        if self.path.is_dir():
            raise BagError(f"{self.path}: is a folder: give the .mcap file in it")
        try:
            return self.path.open("rb")
        except OSError as error:
            raise BagError(f"{self.path}: cannot be opened: {error.strerror}") from error


def _type_of(index: BagIndex, channel: Channel) -> str:
    schema = index.schemas.get(channel.schema_id)
    return "" if schema is None else ros_types.full_name(schema.name)


def _text(data: bytes) -> str:
    return data.decode("utf-8", errors="replace")
