# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read recordings of ROS 2 without ROS, MCAP or SQLite, of one file or several."""

from __future__ import annotations

import contextlib
import pickle
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import chain, combinations, islice
from pathlib import Path
from typing import Any

from ba_node.io import ros_types
from ba_node.io.bag_files import PACKED, find_files, unpack_file
from ba_node.io.bag_source import BagChannel, Source, open_source
from ba_node.io.bag_topics import NO_CHOICE, BagError, Chooser, Chosen, EmptyBagError, TopicChoice
from ba_node.io.mcap_index import MAX_CHUNK_BYTES, Message, merge_by_time
from ba_node.io.ros_types import TypeMismatchError
from ba_node.io.unpack import ZSTD_MAGIC, unpack
from ba_node.measurements import CameraRig, Measurement
from ba_node.messages.conversion import measurement_from_message
from ba_node.messages.topics import CAMERA_TYPES, CAMERAS, INPUT_TYPES

_NOTES = 100
# Messages that are looked at for the frames that a topic names.
_LOOKED_AT = 20
# Parts of a recording follow each other but for this: messages wait a while before they are written.
_MAX_OVERLAP_NS = 1_000_000_000


class BagReader:
    """Read a recording. Use it as a context manager.

    Args:
        path: a file (``*.mcap``, ``*.db3``, either packed as ``*.zstd``), a folder of them as rosbag2 writes it, or
            several files of one recording in any order.
        choice: topics that the user names.

    Attributes:
        topics: type of each topic, as ``package/msg/Type``.
        message_count: messages in the recording, as far as it is whole.
        rejected: what could not be read, counted by reason: ``truncated``, ``corrupt``, ``undecodable``.
        rejection_notes: the last of these in words, with topic and number.
        warnings: what somebody has to know about the files, by kind.
        taken: topic of each input, after :meth:`measurements`.
        left: topics that are inputs by type and were not taken, with the reason.

    Raises:
        BagError: a file is empty, not a recording, or holds no message that can be read.
    """

    topics: dict[str, str]
    message_count: int

    def __init__(self, path: Path | str | Sequence[Path], choice: TopicChoice = NO_CHOICE) -> None:
        self.paths = [Path(path)] if isinstance(path, (str, Path)) else list(path)
        self.path = self.paths[0]
        self.rejected: Counter[str] = Counter()
        self.rejection_notes: deque[str] = deque(maxlen=_NOTES)
        self.warnings: dict[str, str] = {}
        self.taken: dict[str, str] = {}
        self.left: dict[str, str] = {}
        self._choice = choice
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self._sources: list[tuple[Path, Source]] = []
        self._channels: list[BagChannel] = []
        self._are_parts = True
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> BagReader:
        with contextlib.ExitStack() as stack:
            self._open(stack)
            self._channels = [channel for _, source in self._sources for channel in source.channels]
            self.topics = {}
            for channel in self._channels:
                self.topics.setdefault(channel.topic, channel.type_name)
            if not self._are_parts:
                self._require_one_recording()
            self._stack = stack.pop_all()
        self.message_count = sum(source.message_count for _, source in self._sources)
        for path, source in self._sources:
            for reason, words in source.problems:
                self._reject(path, reason, words)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield (topic, type, log time in ns, CDR bytes) of topics (None: all) by log time, then place in the file.

        Raises:
            BagError: nothing of the recording can be read after all.
        """
        for channel, log_time, data in self.raw(topics):
            yield channel.topic, channel.type_name, log_time, data

    def raw(self, topics: Collection[str] | None = None) -> Iterator[tuple[BagChannel, int, bytes]]:
        """Yield channel, log time in ns and bytes, otherwise as :meth:`messages`."""
        for number, log_time, data in self._raw(self._numbers(topics)):
            yield self._channels[number], log_time, data

    def late_cameras(self) -> list[tuple[str, bytes]]:
        """Return topic and bytes of the first message of each camera topic that comes after others of the inputs."""
        cameras = [topic for topic, kind in self.topics.items() if kind in CAMERA_TYPES]
        others = [
            topic for topic, kind in self.topics.items() if kind in INPUT_TYPES.values() and kind not in CAMERA_TYPES
        ]
        first = next((time for _, _, time, _ in self.messages(others)), None) if others else None
        found = [next(self.messages([topic]), None) for topic in cameras]
        return [(raw[0], raw[3]) for raw in found if raw is not None and first is not None and raw[2] > first]

    def decode(self, topic: str, data: bytes) -> Any:
        """Return the message in the bytes of a topic, by the definition in the recording.

        Raises:
            BagError: there is no such topic, or the bytes do not fit its definition.
        """
        numbers = self._numbers([topic])
        if not numbers:
            raise BagError(f"{self.path}: no topic {topic}; there are: {', '.join(sorted(self.topics))}")
        try:
            return self._decoder(min(numbers))(data)
        except TypeMismatchError as error:
            raise BagError(f"{self.path}: topic {topic}: {error}") from error
        except Exception as error:  # generated decoders raise whatever broken bytes lead them to
            raise BagError(f"{self.path}: topic {topic}: {type(error).__name__}: {error}") from error

    def check(self, topic: str) -> None:
        """Raise BagError if a topic's definition lacks a field that ours has, or has it of another type."""
        for number in self._numbers([topic]):
            self._check(number)

    def measurements(self, cameras_known: bool = False) -> Iterator[tuple[str, int, Measurement]]:
        """Yield (topic, log time in ns, measurement) of the input topics, in the order of :meth:`messages`.

        The first cameras that can be used come before all else, wherever they stand: they are latched, and a recorder
        may have got them late. A lone camera (CameraInfo) is read only when there is no rig. See :class:`Chooser` for
        which topics are taken; ``taken`` and ``left`` tell. Messages that cannot be read are counted in ``rejected``.

        The recording may come without cameras where they are known.

        Raises:
            BagError: keyframes, tracks or cameras are missing, several are possible, or a
                definition lacks a field.
        """
        chosen = self._choose(cameras_known)
        self.taken, self.left = chosen.taken, chosen.left
        wanted = {(topic, INPUT_TYPES[name]) for name, topic in chosen.taken.items()}
        # A topic can have channels of several types, from publishers that disagree.
        numbers = {n for n, c in enumerate(self._channels) if (c.topic, c.type_name) in wanted}
        for number in sorted(numbers):
            self._check(number)
        cameras = {n for n in numbers if self._channels[n].type_name in CAMERA_TYPES}
        return self._measurements(numbers, self._first_cameras(cameras))

    def _measurements(self, numbers: Collection[int], first: Message | None) -> Iterator[tuple[str, int, Measurement]]:
        counts: Counter[str] = Counter()
        raw = self._raw(numbers)
        if first is not None:
            raw = chain([first], _without(raw, first))
        for message in raw:
            topic = self._channels[message.channel].topic
            place = counts[topic]
            counts[topic] += 1
            try:
                measurement = self._measurement(message)
            except Exception as error:  # as in decode: whatever the bytes are, the next message may be sound
                words = f"topic {topic}, message {place}: {type(error).__name__}: {error}"
                self._reject(self.path, "undecodable", words)
                continue
            yield topic, message.log_time, measurement

    def _measurement(self, message: Message) -> Measurement:
        decoded = self._decoder(message.channel)(message.data)
        return measurement_from_message(self._channels[message.channel].type_name, decoded)

    def _first_cameras(self, numbers: Collection[int]) -> Message | None:
        """Return the first message of some channels that holds cameras that can be read."""
        rejected, notes = self.rejected.copy(), self.rejection_notes.copy()
        try:
            for raw in self._raw(numbers):
                with contextlib.suppress(Exception):  # what cannot be read is counted in its turn
                    found = self._measurement(raw)
                    if isinstance(found, CameraRig) and not found.malformed:
                        return raw
        except BagError:
            return None
        finally:
            self.rejected, self.rejection_notes = rejected, notes
        return None

    def _choose(self, cameras_known: bool) -> Chosen:
        there = {(channel.topic, channel.type_name) for channel in self._channels}
        full = {(channel.topic, channel.type_name) for channel in self._channels if channel.count != 0}
        found = {
            name: [topic for topic, kind in there if kind == type_name and ((topic, kind) in full or not full)]
            for name, type_name in INPUT_TYPES.items()
        }
        try:
            chosen = Chooser(found, self._frames_of, self._content_of).choose(self._choice)
        except BagError as error:
            raise BagError(f"{self.path}: {error}") from None
        missing = [INPUT_TYPES[name] for name in ("keyframes", "feature_tracks") if name not in chosen.taken]
        if not cameras_known and not chosen.taken.keys() & set(CAMERAS):
            missing.append(" or ".join(CAMERA_TYPES))
        if missing:
            listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(there)) or "none"
            lost = "".join(f"; {words}" for words in self.warnings.values())
            raise BagError(
                f"{self.path}: no topic of type {', and none of type '.join(missing)}; in the recording: {listed}{lost}"
            )
        return chosen

    def _first_messages(self, topic: str) -> Iterator[Any]:
        numbers = [n for n in self._numbers([topic]) if self._channels[n].type_name in INPUT_TYPES.values()]
        for raw in islice(self._raw(numbers), _LOOKED_AT):
            with contextlib.suppress(Exception):  # as in _first_cameras
                yield raw.channel, self._decoder(raw.channel)(raw.data)

    def _frames_of(self, topic: str) -> frozenset[str]:
        frames: set[str] = set()
        for _, message in self._first_messages(topic):
            parts = getattr(message, "cameras", None) or [message]
            frames |= {str(part.header.frame_id).removeprefix("/") for part in parts}
        return frozenset(frames)

    def _content_of(self, topic: str) -> CameraRig | None:
        for number, message in self._first_messages(topic):
            found = measurement_from_message(self._channels[number].type_name, message)
            return found if isinstance(found, CameraRig) else None
        return None

    def _raw(self, numbers: Collection[int]) -> Iterator[Message]:
        """Yield the messages of some channels of all files by log time; those of the same time file by file."""
        count, lost = 0, self.rejected["corrupt"]
        for message in merge_by_time(self._readers(numbers)):
            count += 1
            yield message
        if not count and self.rejected["corrupt"] > lost:
            raise BagError(f"{self.path}: no message can be read: {self.rejection_notes[-1]}")

    def _readers(self, numbers: Collection[int]) -> Iterator[tuple[int, int, Iterator[Message]]]:
        """Yield, for each file by its first time, that time, its place and its messages."""
        begin = 0
        for place, (path, source) in enumerate(self._sources):
            own = {c.id: begin + i for i, c in enumerate(source.channels) if begin + i in numbers}
            begin += len(source.channels)
            if own:
                yield source.start_ns, place, self._of_source(path, source, own)

    def _of_source(self, path: Path, source: Source, numbers: dict[int, int]) -> Iterator[Message]:
        def report(reason: str, words: str) -> None:
            self._reject(path, reason, words)

        try:
            for channel, log_time, data in source.read(numbers, report):
                whole: bytes | None = data
                if data[:4] == ZSTD_MAGIC:
                    whole = self._unpacked(path, numbers[channel], data)
                if whole is not None:
                    yield Message(numbers[channel], log_time, whole)
        except BagError as error:
            raise BagError(f"{path}: {error}") from None

    def _unpacked(self, path: Path, number: int, data: bytes) -> bytes | None:
        """Return a message that the recorder has packed by itself (CDR never begins so), None if it is damaged."""
        try:
            return unpack("zstd", data, MAX_CHUNK_BYTES)
        except Exception as error:  # what the library raises on damaged data has no common class
            self._reject(path, "undecodable", f"topic {self._channels[number].topic}: zstd: {error}")
            return None

    def _numbers(self, topics: Collection[str] | None) -> set[int]:
        return {number for number, c in enumerate(self._channels) if topics is None or c.topic in topics}

    def _check(self, number: int) -> None:
        channel = self._channels[number]
        where = f"{self.path}: topic {channel.topic}"
        messages, definitions = channel.encoding
        if messages != "cdr" or definitions not in ros_types.LANGUAGES:
            raise BagError(
                f"{where}: messages in {messages!r}, definitions in {definitions!r}:"
                f" expected 'cdr' and {' or '.join(map(repr, ros_types.LANGUAGES))}, as ROS 2 records them"
            )
        try:
            ros_types.check_definition(channel.type_name, channel.definition, definitions)
        except TypeMismatchError as error:
            raise BagError(f"{where}: {error}") from error

    def _decoder(self, number: int) -> Callable[[bytes], Any]:
        if number not in self._decoders:
            channel = self._channels[number]
            self._decoders[number] = ros_types.decoder(channel.type_name, channel.definition, channel.encoding[1])
        return self._decoders[number]

    def _reject(self, path: Path, reason: str, words: str) -> None:
        self.rejected[reason] += 1
        self.rejection_notes.append(f"{path}: {words}")

    def _open(self, stack: contextlib.ExitStack) -> None:
        """Open all files. One of several that cannot be read is passed over."""
        files = find_files(self.paths)
        self.warnings.update(files.warnings)
        folder: Path | None = None
        errors: list[BagError] = []
        for path in files.paths:
            if path.suffix == PACKED and folder is None:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ba_")))
            source = _source_or_error(path, folder, stack)
            if isinstance(source, BagError):
                errors.append(source)
            else:
                self._sources.append((path, source))
        if not self._sources:
            raise errors[0]
        self._sources.sort(key=lambda entry: (entry[1].start_ns, entry[1].end_ns, entry[0].name))
        notes = [str(error) for error in errors if not isinstance(error, EmptyBagError)]
        self.rejected.update(["unreadable_file"] * len(notes))
        self.rejection_notes.extend(notes)
        self._are_parts = files.are_parts

    def _require_one_recording(self) -> None:
        """Raise BagError if files cannot be parts of one recording: of the same time, or with other cameras."""
        for (path, source), (other, later) in combinations(self._sources, 2):
            shared = {c.topic for c in source.channels} & {c.topic for c in later.channels}
            inputs = {topic for topic in shared if self.topics[topic] in INPUT_TYPES.values()}
            why = ""
            if inputs and source.end_ns - later.start_ns > _MAX_OVERLAP_NS:
                why = "are of the same time"
            elif any(self._other_cameras(topic, source, later) for topic in inputs):
                why = "have different cameras"
            if why:
                where = f"{self.path}: holds several recordings: " if len(self.paths) == 1 else ""
                raise BagError(f"{where}{path.name} and {other.name} {why}: give one of them")

    def _other_cameras(self, topic: str, *sources: Source) -> bool:
        """Return True if files say different things of the cameras on a topic."""
        if self.topics[topic] not in CAMERA_TYPES:
            return False
        found = set()
        for source in sources:
            own = {id(channel) for channel in source.channels if channel.topic == topic}
            first = self._first_cameras({n for n, channel in enumerate(self._channels) if id(channel) in own})
            if first is not None:
                found.add(pickle.dumps(self._measurement(first)))
        return len(found) > 1


def _source_or_error(path: Path, folder: Path | None, stack: contextlib.ExitStack) -> Source | BagError:
    try:
        file = unpack_file(path, folder) if folder and path.suffix == PACKED else path
        return open_source(file, path, stack)
    except BagError as error:
        return error


def _without(raws: Iterator[Message], first: Message) -> Iterator[Message]:
    """Yield all messages but one, the first that is equal to it."""
    for raw in raws:
        if raw == first:
            break
        yield raw
    yield from raws
