# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measure how good parameters are on a recording: by its truth, or by tracks that were held out of it.

Where there is no truth, one track in eight is taken out of the recording before the back-end sees it. In the end its
points are triangulated from the refined poses, and the residuals of their observations say how good these are:
cross-validation, so that no parameter can better the figure by leaving more out. The residuals are bounded, so that
tracks which are wrong do not rule. How this is measured does not depend on the parameters that are tuned.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray
from ba_node.backend import Backend
from ba_node.config import Config, FramesConfig
from ba_node.estimate import Poses
from ba_node.evaluation.alignment import EvaluationError
from ba_node.evaluation.metrics import absolute_error
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import TopicChoice
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement
from ba_node.offline.fleet import fetched
from ba_node.offline.recording import placed, read_truth
from ba_node.offline.replay import Watch, rehearse
from ba_node.offline.session_record import SessionRecord

Objective = Literal["auto", "truth", "held_out"]
# One track in so many is held out.
_SHARE = 8
_HASH = np.uint64(0x9E3779B97F4A7C15)
# A residual counts for no more than this, sigmas; one behind the camera for as much.
_BOUND = 5.0
# Fewer residuals tell nothing.
_MIN_RESIDUALS = 100
_TRUTH_UNIT, _HELD_OUT_UNIT = "m", "sigma"


class MeasureError(ValueError):
    """A recording that cannot tell how good parameters are."""


@dataclass(frozen=True)
class Question:
    """Parameters to be tried on a recording."""

    recording: tuple[str, ...]  # a path or URL, or the files of one recording
    config: Config
    topics: TopicChoice
    objective: Objective = "auto"  # auto: the truth where there is one


@dataclass(frozen=True)
class Measured:
    """How good parameters are on a recording."""

    error: float  # rmse of the trajectory, m, or mean residual of the tracks held out, sigmas
    unit: str  # of the error
    latency_ms: float  # p95 of the time of a solve
    held: int  # solves that were held or failed
    solves: int  # all of them


@dataclass(frozen=True)
class _Recorded:
    """A recording in memory."""

    measurements: tuple[Measurement, ...]
    truth: Poses | None


def measure(question: Question) -> Measured:
    """Replay a recording with some parameters and return how good they are.

    Raises:
        BagError: the recording cannot be read.
        FleetError: it cannot be fetched.
        MeasureError: it has no truth where that is asked for, or neither truth nor tracks to hold out.
    """
    config = question.config
    topics = tuple(sorted(question.topics.topics.items()))
    recorded = _read(question.recording, topics, question.topics.namespace, config.frames)
    by_truth = question.objective == "truth" or (question.objective == "auto" and recorded.truth is not None)
    place = question.recording[0]
    if by_truth and recorded.truth is None:
        raise MeasureError(f"{place}: no ground_truth/pose in it: tune with --objective held_out")
    measurements = recorded.measurements if by_truth else tuple(_split(recorded.measurements, held_out=False))
    # The time of this thread alone, as others may want the processor; those of several threads by the clock.
    clock = time.thread_time if config.solver.threads == 1 else time.perf_counter
    sessions = rehearse(measurements, config, Watch(clock))
    reports = [report for session in sessions for _, report in session.solves]
    if not reports:
        raise MeasureError(f"{place}: none of its keyframes can be used; ba replay says why")
    if by_truth:
        assert recorded.truth is not None
        error, unit = _truth_error(place, sessions, recorded.truth), _TRUTH_UNIT
    else:
        error, unit = _held_out_error(place, sessions, recorded.measurements, config.frames), _HELD_OUT_UNIT
    times = [report.solve_time_s for report in reports]
    held = sum(report.status.name in ("HELD", "FAILED") for report in reports)
    return Measured(error, unit, 1e3 * float(np.percentile(times, 95)), held, len(reports))


@functools.lru_cache(maxsize=8)
def _read(
    place: tuple[str, ...], topics: tuple[tuple[str, str], ...], namespace: str, frames: FramesConfig
) -> _Recorded:
    """Read a recording, once for all trials in the same process."""
    choice = TopicChoice(dict(topics), namespace)
    with fetched(place[0]) as first, BagReader([first, *map(Path, place[1:])], choice) as reader:
        measurements = tuple(placed(reader.measurements(), reader, frames))
        return _Recorded(measurements, read_truth(reader))


def _truth_error(place: str, sessions: list[SessionRecord], truth: Poses) -> float:
    """Return the rmse over the keyframes of all sessions, each aligned by itself, m."""
    squares, count, reason = 0.0, 0, ""
    for session in sessions:
        try:
            found = absolute_error(session.trajectory, truth).translation
        except EvaluationError as error:
            reason = str(error)
            continue
        squares, count = squares + found.sse, count + found.count
    if not count:
        raise MeasureError(f"{place}: its ground truth cannot be compared with: {reason}")
    return float(np.sqrt(squares / count))


def _held_out_error(
    place: str, sessions: list[SessionRecord], measurements: Iterable[Measurement], frames: FramesConfig
) -> float:
    """Return the mean residual of the tracks that were held out, by the refined poses of all sessions, sigmas."""
    held_out = list(_split(measurements, held_out=True))
    norms = np.concatenate([_residuals(session, held_out, frames) for session in sessions])
    if len(norms) < _MIN_RESIDUALS:
        raise MeasureError(
            f"{place}: neither ground_truth/pose nor enough tracks to hold out ({len(norms)} observations of one track"
            f" in {_SHARE}, {_MIN_RESIDUALS} are needed): there is nothing to tune by"
        )
    return float(np.mean(norms))


def _residuals(session: SessionRecord, held_out: list[Measurement], frames: FramesConfig) -> FloatArray:
    """Return bounded residuals (n,) of held-out tracks, sigmas, points triangulated from the poses of a session."""
    # A back-end that never solves: the refined poses are its input, and everything else has its default.
    without_solves = Backend(dataclasses.replace(Config(), frames=frames))
    poses = session.trajectory
    known = {key: row for row, key in enumerate(poses.keyframe_id.tolist())}
    for one in held_out:
        if isinstance(one, CameraRig):
            without_solves.add(one)
    for key, row in known.items():
        stamp, frame = int(poses.stamp_ns[row]), session.last.frame_id
        without_solves.add(Keyframe(session.session_id, key, stamp, frame, poses.position[row], poses.orientation[row]))
    for one in held_out:
        if isinstance(one, FeatureTracks) and one.session_id == session.session_id and one.keyframe_id in known:
            without_solves.add(one)
    without_solves.flush(final=True)
    seen = without_solves.map.summary().observed
    norms = np.linalg.norm(seen.error, axis=1) / seen.sigma_px
    return np.asarray(np.minimum(np.nan_to_num(norms, nan=_BOUND), _BOUND))


def _split(measurements: Iterable[Measurement], *, held_out: bool) -> Iterator[Measurement]:
    """Yield measurements with the tracks that are held out alone, or without them."""
    for one in measurements:
        if not isinstance(one, FeatureTracks) or one.malformed:
            yield one
            continue
        rows = is_held_out(one.track_id) == held_out
        sigma, depth = (values[rows] if len(values) else values for values in (one.sigma_px, one.depth_m))
        yield dataclasses.replace(one, track_id=one.track_id[rows], uv=one.uv[rows], sigma_px=sigma, depth_m=depth)


def is_held_out(track_id: IdArray) -> BoolArray:
    """Return which tracks are held out: a fixed choice by their ids."""
    with np.errstate(over="ignore"):
        return np.asarray((track_id * _HASH) >> np.uint64(40) & np.uint64(_SHARE - 1) == 0)
