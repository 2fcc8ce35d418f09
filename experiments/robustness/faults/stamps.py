# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps, sessions, frames: the messages come in a wrong order, twice, or with wrong names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses, Measurement, OfSession
from experiments.robustness.faults.recording import Entry, Recording

_RESTART_NS = 10**9


def clock_set_back(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Set the clock back by some seconds in the middle; the session id stays."""
    return _with_stamps(recording, lambda k, n, stamp_ns: stamp_ns - round(amount * 1e9) * (k >= n // 2))


def clock_stepped(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Set the clock forward by some seconds in the middle, or back by less than keyframes are apart."""
    return _with_stamps(recording, lambda k, n, stamp_ns: stamp_ns + round(amount * 1e9) * (k >= n // 2))


def one_stamp_zero(recording: Recording, _amount: float, rng: np.random.Generator) -> Recording:
    """Leave the stamp of one keyframe empty."""
    at = _one(recording, rng)
    return _with_stamps(recording, lambda k, _n, stamp_ns: 0 if k == at else stamp_ns)


def one_stamp_future(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Put one stamp some seconds into the future."""
    at = _one(recording, rng)
    return _with_stamps(recording, lambda k, _n, stamp_ns: stamp_ns + round(amount * 1e9) * (k == at))


def stamps_in_another_unit(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Divide all stamps, by 1000 where they were milliseconds."""
    return _with_stamps(recording, lambda _k, _n, stamp_ns: round(stamp_ns / amount))


def begins_anew(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Play the recording twice under one session id."""
    timeline = recording.timeline
    later = timeline[-1][1] - timeline[0][1] + _RESTART_NS
    again = tuple((topic, time_ns + later, measurement) for topic, time_ns, measurement in timeline)
    return dataclasses.replace(recording, timeline=timeline + again)


def session_lowered(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Restart the front-end in the middle, with a session id that is lower by some."""
    half = len(recording.keyframes) // 2
    first, second = 10, max(0, 10 - int(amount))
    seen = 0

    def session(measurement: Measurement) -> int:
        nonlocal seen
        seen += isinstance(measurement, Keyframe)
        return second if seen > half else first

    timeline: list[Entry] = []
    for topic, time_ns, measurement in recording.timeline:
        moved = measurement
        if isinstance(measurement, Keyframe | OfSession):
            moved = dataclasses.replace(measurement, session_id=session(measurement))
        timeline.append((topic, time_ns, moved))
    return dataclasses.replace(recording, timeline=tuple(timeline))


def useless_messages(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Put in tracks and guesses of the next session that have no rows, or only NaN, some of each."""
    timeline = list(recording.timeline)
    no_ids = np.empty(0, dtype=np.uint64)
    for at in np.sort(rng.choice(np.arange(1, len(timeline)), int(amount), replace=False))[::-1].tolist():
        time_ns = timeline[at][1]
        image = next(m for _, _, m in timeline if isinstance(m, FeatureTracks))
        useless: list[Entry] = [
            ("feature_tracks", time_ns, FeatureTracks(1, image.keyframe_id, 0, no_ids, np.empty((0, 2)))),
            ("landmark_guesses", time_ns, LandmarkGuesses(1, no_ids, np.empty((0, 3)))),
            (
                "feature_tracks",
                time_ns,
                dataclasses.replace(image, session_id=1, uv=np.full_like(image.uv, np.nan)),
            ),
        ]
        timeline[at:at] = useless
    return dataclasses.replace(recording, timeline=tuple(timeline))


def duplicates(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Send every seventh keyframe again a while later, with a stamp that is off by some seconds."""
    timeline: list[Entry] = []
    waiting: list[Keyframe] = []
    for topic, time_ns, measurement in recording.timeline:
        if isinstance(measurement, Keyframe):
            timeline += [("keyframes", time_ns, again) for again in waiting]
            waiting = []
            if recording.number(measurement.keyframe_id) % 7 == 6:
                waiting = [dataclasses.replace(measurement, stamp_ns=measurement.stamp_ns + round(amount * 1e9))]
        timeline.append((topic, time_ns, measurement))
    return dataclasses.replace(recording, timeline=tuple(timeline))


def frame_slash(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Name the fixed frame with a leading slash, as in ROS 1."""
    return recording.changed(Keyframe, lambda keyframe: dataclasses.replace(keyframe, frame_id="/odom"))


def frame_empty(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Leave the name of the fixed frame empty."""
    return recording.changed(Keyframe, lambda keyframe: dataclasses.replace(keyframe, frame_id=""))


def frame_changes(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Change the name of the fixed frame in the middle of a session."""
    half = len(recording.keyframes) // 2

    def change(keyframe: Keyframe) -> Keyframe:
        if recording.number(keyframe.keyframe_id) < half:
            return keyframe
        return dataclasses.replace(keyframe, frame_id="world")

    return recording.changed(Keyframe, change)


def _one(recording: Recording, rng: np.random.Generator) -> int:
    """Return a keyframe that is neither at the beginning nor at the end."""
    n = len(recording.keyframes)
    return int(rng.integers(n // 3, 2 * n // 3 + 1))


def _with_stamps(recording: Recording, stamp: Callable[[int, int, int], int]) -> Recording:
    """Return the recording with new stamps of keyframes: a function of number, count and stamp in ns."""
    count = len(recording.keyframes)

    def change(keyframe: Keyframe) -> Keyframe:
        new = stamp(recording.number(keyframe.keyframe_id), count, keyframe.stamp_ns)
        return dataclasses.replace(keyframe, stamp_ns=new)

    return recording.changed(Keyframe, change)
