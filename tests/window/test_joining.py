# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions that tracks connect become one map, in the frame of the first."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.backend.archive import unpack
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Estimate
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement, TrackMerge
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

CUT, N = 20, 40
FAR = np.uint64(10**6)
# Where the second front-end begins its frame.
TURN, SHIFT = geometry.so3_exp(np.array([0.0, 0.0, 2.0])), np.array([300.0, -50.0, 7.0])


def small_eight() -> SyntheticData:
    """Return a figure of eight: its second half sees again what the first has seen, under the same ids."""
    return generate(SyntheticOptions(seed=2, keyframes=N, landmarks=1200, tracks=60, length_m=40.0))


@pytest.fixture(scope="module")
def data() -> SyntheticData:
    return small_eight()


def two_sessions(data: SyntheticData, *, merged: bool = False) -> Iterator[Measurement]:
    """Yield a recording in two sessions; ``merged``: with ids of its own in the second, and what is the same told."""
    early = {track for images in data.tracks[:CUT] for image in images for track in image.track_id.tolist()}
    told: set[int] = set()
    for number, (_, _, one) in enumerate(data.timeline()):
        if isinstance(one, CameraRig | LandmarkGuesses):
            yield one
            continue
        assert isinstance(one, Keyframe | FeatureTracks), number
        row = int(np.flatnonzero(data.truth.keyframe_id == np.uint64(one.keyframe_id))[0])
        if row < CUT:
            yield one
        elif isinstance(one, Keyframe):
            turned = TURN @ geometry.matrix_from_quaternion(one.orientation)
            position, orientation = TURN @ one.position + SHIFT, geometry.quaternion_from_matrix(turned)
            yield dataclasses.replace(one, session_id=1, position=position, orientation=orientation)
        else:
            again = np.array([t for t in one.track_id.tolist() if t in early and t not in told], np.uint64)
            track_id = one.track_id + FAR if merged else one.track_id
            yield dataclasses.replace(one, session_id=1, track_id=track_id)
            if merged and len(again):
                told |= set(again.tolist())
                yield TrackMerge(1, again + FAR, again)


def replayed(stream: Iterator[Measurement], **values: object) -> tuple[Backend, Estimate]:
    backend = Backend(Config().with_values(values))
    return backend, [event for event in backend.replay(stream) if isinstance(event, Estimate)][-1]


def error_m(estimate: Estimate, data: SyntheticData) -> float:
    """Return the rms distance to the truth where the first keyframe is held to it, m."""
    _, here, there = np.intersect1d(estimate.trajectory.keyframe_id, data.truth.keyframe_id, return_indices=True)
    off = estimate.trajectory.position[here] - data.truth.position[there]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


@pytest.fixture(scope="module")
def whole(data: SyntheticData) -> Estimate:
    """Return what comes of one session."""
    return replayed(m for _, _, m in data.timeline())[1]


@pytest.mark.slow
@pytest.mark.parametrize("merged", [False, True])
def test_sessions_that_tracks_connect_are_one_map(data: SyntheticData, whole: Estimate, merged: bool) -> None:
    backend, joined = replayed(two_sessions(data, merged=merged), **{"scene.join_sessions": True})
    assert len(joined.trajectory) == N and joined.report.adjustments >= 1
    assert not backend.report.warnings, backend.report.warnings
    assert error_m(joined, data) < 1.3 * error_m(whole, data) + 0.01
    content = backend.snapshot()
    content.facts.update(json.loads(json.dumps(content.facts)))
    loaded = unpack(content, Config().scene).scene
    assert loaded.constraints.seams == {int(data.truth.keyframe_id[CUT])}
    np.testing.assert_array_equal(loaded.sessions_of(loaded.order), np.arange(N) >= CUT)


@pytest.mark.slow
def test_why_sessions_cannot_be_one_map_is_said(data: SyntheticData) -> None:
    """The second front-end counts its keyframes from the first one's numbers on."""

    def again() -> Iterator[Measurement]:
        for one in two_sessions(data):
            if isinstance(one, Keyframe | FeatureTracks) and one.session_id == 1:
                yield dataclasses.replace(one, keyframe_id=one.keyframe_id - CUT)
            else:
                yield one

    backend, last = replayed(again(), **{"scene.join_sessions": True})
    assert len(last.trajectory) == N - CUT
    (text,) = backend.report.warnings
    assert text.startswith("session 0 is not joined with this one: keyframe 0 is in both")


@pytest.mark.slow
def test_sessions_that_nothing_connects_are_counted(data: SyntheticData) -> None:
    def apart() -> Iterator[Measurement]:
        for one in two_sessions(data, merged=True):
            if not isinstance(one, TrackMerge):
                yield one

    backend, last = replayed(apart(), **{"scene.join_sessions": True})
    assert len(last.trajectory) == N - CUT and backend.scene.log.notices["apart"] == 1
