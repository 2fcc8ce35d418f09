# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tell what is in a recording, cut it, and put several together; messages are copied as they are."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_source import BagChannel
from ba_node.io.bag_topics import BagError, TopicChoice
from ba_node.io.bag_writer import BagWriter
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.messages.topics import CAMERA_TYPES, IMAGE_TYPES, INPUT_TYPES, TF_STATIC

_NS = 1e9
# A pause between keyframes that is so many times as long as the median is told.
_GAP = 4.0
# Different things that are wrong with messages; the others are like them.
_TOLD = 5
Progress = Callable[[int, int], None]


@dataclass
class TopicFacts:
    """What there is of one topic."""

    type_name: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    gap_s: float = 0.0  # the longest pause
    gap_at_s: float = 0.0  # when it began, since the first message of the recording
    bytes: int = 0


@dataclass
class RecordingFacts:
    """What there is in a recording, and what a replay would use of it."""

    path: Path
    topics: dict[str, TopicFacts] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    taken: dict[str, str] = field(default_factory=dict)  # topic by input
    left: dict[str, str] = field(default_factory=dict)  # reason by topic
    inputs: dict[str, Any] = field(default_factory=dict)  # what the inputs hold
    refusal: str = ""  # why a replay would refuse it; empty if it would not
    attention: list[str] = field(default_factory=list)  # what has to be looked at, one sentence each

    def as_dict(self) -> dict[str, Any]:
        """Return all of it for JSON."""
        return {**vars(self), "path": self.path.name, "topics": {name: vars(of) for name, of in self.topics.items()}}


def examine(path: Path | Sequence[Path], choice: TopicChoice, progress: Progress) -> RecordingFacts:
    """Read a recording once as it is, and once as a replay would.

    Raises:
        BagError: nothing of it can be read.
    """
    with BagReader(path, choice) as reader:
        facts = RecordingFacts(reader.path)
        for done, (channel, time_ns, data) in enumerate(reader.raw(), start=1):
            progress(done, reader.message_count)
            facts.start_ns = facts.start_ns or time_ns
            facts.end_ns = max(facts.end_ns, time_ns)
            of = facts.topics.setdefault(channel.topic, TopicFacts(channel.type_name, first_ns=time_ns))
            pause_s = (time_ns - of.last_ns) / _NS
            if of.count and pause_s > of.gap_s:
                of.gap_s, of.gap_at_s = pause_s, (of.last_ns - facts.start_ns) / _NS
            of.count, of.last_ns, of.bytes = of.count + 1, time_ns, of.bytes + len(data)
        for topic, kind in reader.topics.items():
            facts.topics.setdefault(topic, TopicFacts(kind))
        _use(reader, facts)
        facts.attention += [*reader.warnings.values(), *_shortened(list(reader.rejection_notes), reader.rejected)]
    return facts


def _shortened(notes: list[str], rejected: Mapping[str, int]) -> list[str]:
    """Return the first of many notes, and how many were turned away in all."""
    if len(notes) <= _TOLD:
        return notes
    counts = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
    return [*notes[: _TOLD - 1], f"turned away in all: {counts}"]


def _use(reader: BagReader, facts: RecordingFacts) -> None:
    """Fill in what a replay would use."""
    seen = _Seen()
    try:
        for _, _, measurement in reader.measurements():
            seen.add(measurement)
    except BagError as error:
        facts.refusal = str(error).removeprefix(f"{reader.path}: ")
        images = sorted(topic for topic, of in facts.topics.items() if of.type_name in IMAGE_TYPES)
        if images:
            facts.attention.append(f"images on {', '.join(images)}: `ba run` makes a map of them, `ba track` keyframes")
        return
    facts.taken, facts.left = dict(reader.taken), dict(reader.left)
    facts.inputs = seen.as_dict()
    if seen.bare:
        facts.attention.append(f"{seen.bare} of {len(seen.keyframes)} keyframes have no tracks")
    if seen.rigs > facts.inputs["sessions"]:
        facts.attention.append(f"{seen.rigs} camera rigs that differ: a session keeps its first, and drops the others")
    facts.attention += [f"{reason}: {count} times" for reason, count in seen.malformed.most_common(_TOLD)]


class _Seen:
    """Counts of what the inputs hold; no observation is kept."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self.malformed: Counter[str] = Counter()
        self._tracked: set[tuple[int, int]] = set()
        self._views: Counter[int] = Counter()
        self._sizes: list[int] = []
        self._cameras = 0
        self._rigs: set[bytes] = set()
        self._guesses = self._depths = 0

    def add(self, measurement: Measurement) -> None:
        """Count one."""
        malformed = getattr(measurement, "malformed", "")
        if malformed:
            self.malformed[malformed] += 1
        elif isinstance(measurement, Keyframe):
            self.keyframes.append(measurement)
        elif isinstance(measurement, FeatureTracks):
            if len(measurement.track_id):
                self._tracked.add((measurement.session_id, measurement.keyframe_id))
            self._views.update(np.unique(measurement.track_id).tolist())
            self._sizes.append(len(measurement.track_id))
            self._depths += int(np.isfinite(measurement.depth_m).sum())
        elif isinstance(measurement, LandmarkGuesses):
            self._guesses += len(measurement.track_id)
        elif isinstance(measurement, CameraRig):
            self._cameras = len(measurement)
            values = (measurement.intrinsics, *measurement.distortion, measurement.position, measurement.orientation)
            self._rigs.add(b"".join(value.tobytes() for value in values))

    @property
    def rigs(self) -> int:
        """Return how many camera rigs there are that differ."""
        return len(self._rigs)

    @property
    def bare(self) -> int:
        """Return the number of keyframes without tracks."""
        return sum((keyframe.session_id, keyframe.keyframe_id) not in self._tracked for keyframe in self.keyframes)

    def as_dict(self) -> dict[str, Any]:
        """Return all counts."""
        lengths = list(self._views.values())
        return {
            "sessions": len({keyframe.session_id for keyframe in self.keyframes}),
            "keyframes": len(self.keyframes),
            "keyframes_without_tracks": self.bare,
            "cameras": self._cameras,
            "images": len(self._sizes),
            "tracks": len(lengths),
            "observations": sum(self._sizes),
            "tracks_per_image": _median(self._sizes),
            "images_per_track": _median(lengths),
            "tracks_seen_once": sum(length == 1 for length in lengths),
            "guesses": self._guesses,
            "pauses": _pauses(self.keyframes),
            "depths": self._depths,
        }


def _pauses(keyframes: Sequence[Keyframe]) -> str:
    """Return in words where keyframes stay away for much longer than usual; empty if they never do."""
    stamps = np.sort(np.array([keyframe.stamp_ns for keyframe in keyframes], dtype=np.int64))
    steps = np.diff(stamps) / _NS
    usual = _median(steps.tolist())
    long = np.flatnonzero(steps > _GAP * usual) if usual > 0.0 else np.empty(0, np.intp)
    if not len(long):
        return ""
    worst = int(long[np.argmax(steps[long])])
    begin = (int(stamps[worst]) - int(stamps[0])) / _NS
    return f"{len(long)}, the longest {steps[worst]:.2f} s, {begin:.2f} s after the first; usual are {usual:.2f} s"


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else 0.0


@dataclass(frozen=True)
class Span:
    """What is cut out."""

    start_s: float = 0.0  # since the first message
    end_s: float = math.inf
    topics: Collection[str] | None = None  # all if None


def cut(source: Path | Sequence[Path], target: Path, span: Span, progress: Progress) -> tuple[int, float]:
    """Write the messages of a time; return how many, and how many seconds they take.

    The last message from before of each topic with cameras or static transforms, and of what else is latched, is
    written at the begin: without these the rest is of no use.

    Raises:
        BagError: the recording cannot be read, or nothing of it is of this time.
    """
    with BagReader(source) as reader:
        if math.isnan(span.start_s) or math.isnan(span.end_s):
            raise BagError(f"{reader.path}: from {span.start_s:g} to {span.end_s:g} s: expected numbers of seconds")
        names = None if span.topics is None else {name if name.startswith("/") else f"/{name}" for name in span.topics}
        missing = sorted((names or set()) - set(reader.topics))
        if missing:
            raise BagError(f"{reader.path}: no topic {missing[0]}; there are: {', '.join(sorted(reader.topics))}")
        first = next((time_ns for _, time_ns, _ in reader.raw()), 0)
        start, end = first + max(span.start_s, 0.0) * _NS, first + span.end_s * _NS
        held: dict[str, tuple[BagChannel, bytes]] = {}
        count, last = 0, int(min(max(start, 0.0), 2.0**63))
        with BagWriter(target) as writer:
            for done, (channel, time_ns, data) in enumerate(reader.raw(names), start=1):
                progress(done, reader.message_count)
                if time_ns > end:
                    break
                if time_ns < start:
                    if channel.is_latched or channel.type_name in CAMERA_TYPES or channel.topic == TF_STATIC:
                        held[channel.topic] = (channel, data)
                    continue
                if not count:
                    for kept, of in held.values():
                        writer.copy(kept, time_ns, of)
                writer.copy(channel, time_ns, data)
                count, last = count + 1, time_ns
            if not count:
                length = (max((t for _, t, _ in reader.raw()), default=first) - first) / _NS
                until = f"to {span.end_s:g} s" if math.isfinite(span.end_s) else "s on"
                raise BagError(f"{reader.path}: no message from {span.start_s:g} {until}: it has {length:g} s")
    return count + len(held), (last - start) / _NS


def merge(sources: Sequence[Path], target: Path, progress: Progress) -> tuple[int, list[str]]:
    """Write all messages of several recordings by time; return how many, and which topics come from several.

    Raises:
        BagError: one cannot be read, or a topic has another type in another.
    """
    with ExitStack() as stack:
        readers = [stack.enter_context(BagReader(source)) for source in sources]
        owners: dict[str, list[BagReader]] = {}
        for reader in readers:
            for topic, kind in reader.topics.items():
                of = owners.setdefault(topic, [])
                if of and of[0].topics[topic] != kind:
                    raise BagError(f"{reader.path}: topic {topic} is {kind}, in {of[0].path} {of[0].topics[topic]}")
                of.append(reader)
        total, count = sum(reader.message_count for reader in readers), 0

        def messages(place: int) -> Iterator[tuple[int, int, int, BagChannel, bytes]]:
            for number, (channel, time_ns, data) in enumerate(readers[place].raw()):
                yield time_ns, place, number, channel, data

        with BagWriter(target) as writer:
            for time_ns, _, _, channel, data in heapq.merge(*map(messages, range(len(readers)))):
                writer.copy(channel, time_ns, data)
                count += 1
                progress(count, total)
    return count, sorted(topic for topic, of in owners.items() if len(of) > 1 and of[0].topics[topic] in _SINGLE)


# Topics of these types make one stream, which two recordings tear apart.
_SINGLE = frozenset(INPUT_TYPES.values())
