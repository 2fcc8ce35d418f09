# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The border of messages as functions of bytes: a good stream, spoiled as the bytes say, into a back-end."""

from __future__ import annotations

import dataclasses
import functools
import struct
from typing import Any

import numpy as np

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.io import ros_types
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import (
    FeatureTracks,
    GlobalFix,
    GravityDirection,
    Keyframe,
    LandmarkPriors,
    Measurement,
    PosePrior,
    RelativePose,
    TrackMerge,
)
from ba_node.messages.conversion import InputMessages, measurement_from_message
from ba_node.messages.topics import INPUT_TYPES
from experiments.robustness.faults import RIGS, SOUND, spoiled

_SETTINGS = {"solver.max_iterations": 3, "window.max_keyframes": 3, "scene.max_pending": 5, "scene.max_landmarks": 100}
_TINY: dict[str, Any] = {
    "length_m": 10.0,
    "landmarks": 300,
    "tracks": 25,
    "ids": "random64",
    "guesses": True,
}
_SPECIAL = (0.0, -1.0, 1e-300, 1e8, 1e300, np.nan, np.inf, -np.inf)


class Bytes:
    """Take numbers from bytes; zeros when they are used up."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def __bool__(self) -> bool:
        """Return True while there are some."""
        return self._at < len(self._data)

    def unpack(self, kind: str) -> Any:
        """Take a number by its letter of ``struct``."""
        size = struct.calcsize(f"<{kind}")
        part = self._data[self._at : self._at + size].ljust(size, b"\0")
        self._at += size
        return struct.unpack(f"<{kind}", part)[0]

    def below(self, limit: int) -> int:
        """Take a number in [0, limit)."""
        return int(self.unpack("H")) % max(1, limit)

    def number(self) -> float:
        """Take a float: a special one, one as of an image, or any."""
        kind = self.below(3)
        if kind == 0:
            return _SPECIAL[self.below(len(_SPECIAL))]
        return float(self.unpack("h")) / 16.0 if kind == 1 else float(self.unpack("d"))


@functools.cache
def good_stream(rig: str, keyframes: int = 6) -> tuple[Measurement, ...]:
    """Return a stream of some keyframes, with all that may be known beside pixels after the third and the last."""
    measurements = list(spoiled(SOUND, rig, **_TINY, keyframes=keyframes).measurements)
    at = [i for i, one in enumerate(measurements) if isinstance(one, Keyframe)]
    for end in (len(measurements), at[3]):
        measurements[end:end] = _beside(measurements[:end])
    return tuple(measurements)


def _beside(stream: list[Measurement]) -> list[Measurement]:
    """Return one of each kind of what may be known beside pixels, of the newest keyframes of a stream."""
    keyframes = [one for one in stream if isinstance(one, Keyframe)]
    ids = next(one.track_id for one in reversed(stream) if isinstance(one, FeatureTracks))
    before, newest = keyframes[-2:]
    pose = newest.position, newest.orientation
    return [
        RelativePose(0, before.keyframe_id, newest.keyframe_id, False, *pose, np.eye(6).ravel()),
        RelativePose(0, keyframes[0].keyframe_id, newest.keyframe_id, True, *pose, np.eye(6).ravel()),
        LandmarkPriors(0, newest.frame_id, ids[:2], np.ones((2, 3)), np.tile(np.eye(3), (2, 1, 1))),
        TrackMerge(0, ids[2:4], ids[4:6]),
        GravityDirection(0, newest.keyframe_id, np.array([0.0, 0.0, -1.0]), 0.02),
        PosePrior(newest.stamp_ns, "site", *pose, np.eye(6).ravel()),
        GlobalFix(newest.stamp_ns, "gps", np.array([48.0, 11.0, 500.0]), np.eye(3).ravel(), is_fix=True),
    ]


def stream(data: bytes, keyframes: int = 6) -> int:
    """Give a back-end the stream that bytes describe; return the number of messages."""
    source = Bytes(data)
    good = good_stream(list(RIGS)[source.below(len(RIGS))], keyframes)
    messages: list[Measurement] = []
    for measurement in good:
        choice = source.below(8)
        if choice == 1:
            continue
        messages += [measurement] * (2 if choice == 2 else 1)
        while source and choice >= 4 and len(messages) < 10 * keyframes:
            messages.append(spoil(source, messages[-1 - source.below(min(4, len(messages)))]))
            choice = source.below(8)
    feed(messages, check_setup=keyframes > 6)
    return len(messages)


def drive(data: bytes) -> int:
    """Do as :func:`stream` with as many keyframes as the check of the set-up asks for."""
    return stream(data, keyframes=16)


def cdr(data: bytes) -> int:
    """Give a back-end a good stream with messages in it that are made from bytes of CDR; return their number."""
    source = Bytes(data)
    name = list(INPUT_TYPES)[source.below(len(INPUT_TYPES))]
    try:
        message = ros_types.decode(INPUT_TYPES[name], data[2:])
        measurement = measurement_from_message(INPUT_TYPES[name], message)
    except Exception:  # the decoder raises whatever broken bytes lead it to, and its callers count that
        return 1
    good = good_stream(next(iter(RIGS)))
    feed([*good[:5], measurement, *good[5:8], measurement, *good[8:]])
    return 2


def feed(messages: list[Measurement], check_setup: bool = False) -> None:
    """Run a back-end over messages as a replay does, and look at all that it gives."""
    backend = Backend(Config().with_values({**_SETTINGS, "guard.check_setup": check_setup}))
    for measurement in messages:
        if backend.completes(measurement):
            check(backend.solve())
        backend.add(measurement)
        assert len(backend.scene.pending) <= 5 and len(backend.scene.landmarks) <= 100
    backend.flush(final=True)
    while backend.ready:
        check(backend.solve())


def check(estimate: Estimate | None) -> None:
    """Assert that an estimate holds numbers."""
    assert estimate is not None
    for poses in (estimate.refined, estimate.trajectory):
        assert np.isfinite(poses.position).all()
        assert np.abs(np.linalg.norm(poses.orientation, axis=1) - 1.0).max(initial=0.0) < 1e-6
    assert np.isfinite(estimate.cloud.position).all()


def spoil(source: Bytes, measurement: Measurement) -> Measurement:
    """Return a measurement with one field changed."""
    names = [field.name for field in dataclasses.fields(measurement)]
    name = names[source.below(len(names))]
    return dataclasses.replace(measurement, **{name: _changed(source, getattr(measurement, name))})


def _changed(source: Bytes, value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _changed_array(source, value)
    if isinstance(value, str):
        return ("", "/odom", "other", "plumb_bob", "equidistant", "\n\0")[source.below(6)]
    if isinstance(value, tuple):
        items = list(value)
        at = source.below(len(items))
        items[at : at + 1] = [[], [_changed(source, items[at])], items][source.below(3)] if items else []
        return tuple(items)
    return (0, 1, (value + 1) % 2**64, max(0, value - 1), source.unpack("H"), source.unpack("Q"))[source.below(6)]


def _changed_array(source: Bytes, value: np.ndarray) -> np.ndarray:
    array = value.copy()
    kind = source.below(8)
    if kind == 0 or not array.size:
        return array[: source.below(len(array) + 1)]
    if kind == 1:
        return np.concatenate([array, array[: source.below(len(array) + 1)]])
    step, first = 1 + source.below(4), source.below(array.size)
    if array.dtype.kind == "f":
        array.reshape(-1)[first::step] = source.number()
    else:
        array.reshape(-1)[first] = source.unpack("Q") if array.dtype.kind == "u" else source.unpack("q")
    return array


def seeds() -> dict[str, list[bytes]]:
    """Return bytes that lead to good and to bad streams, and good CDR of every type."""
    rng = np.random.default_rng(0)
    streams = [bytes([k, 0]) + bytes(60) for k in range(3)] + [rng.bytes(200) for _ in range(4)]
    return {"stream": streams, "drive": streams, "cdr": [_type_bytes(k) + data for k, data in _good_cdr()]}


def _type_bytes(index: int) -> bytes:
    return struct.pack("<H", index)


def _good_cdr() -> list[tuple[int, bytes]]:
    """Return the number of an input and a good message of it, of each kind."""
    names, messages = list(INPUT_TYPES), InputMessages(ROSBAGS_FACTORY)
    good = dict(messages.of(measurement, 5) for measurement in good_stream(next(iter(RIGS))))
    good["camera_info"] = good["camera_rig"].cameras[0]
    assert good.keys() == INPUT_TYPES.keys(), "an input that no message is made of"
    return [(names.index(name), ros_types.encode(INPUT_TYPES[name], message)) for name, message in good.items()]
