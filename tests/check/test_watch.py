# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The back-end checks the first keyframes, and keeps what came in where the set-up is wrong."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.check import two_view
from ba_node.config import Config
from ba_node.estimate import Estimate, Status
from experiments.synthetic import SyntheticData
from tests.check.set_ups import WRONG, recording, rig


def play(backend: Backend, data: SyntheticData, keyframes: int | None = None) -> list[Estimate]:
    """Give a recording to a back-end as a replay does, and return its estimates."""
    estimates: list[Estimate | None] = []
    for _, _, measurement in data.timeline():
        if backend.completes(measurement):
            estimates.append(backend.solve())
        backend.add(measurement)
        if keyframes is not None and len(backend.scene.keyframes) > keyframes:
            break
    backend.flush()
    while backend.ready:
        estimates.append(backend.solve())
    return [one for one in estimates if one is not None]


def same_as_input(estimate: Estimate, data: SyntheticData) -> None:
    """Assert that what is published is what came in, bit for bit."""
    given = data.odometry
    n = len(estimate.trajectory)
    assert np.array_equal(estimate.trajectory.position, given.position[:n])
    assert np.abs(estimate.trajectory.orientation - given.orientation[:n]).max() < 1e-12
    assert len(estimate.cloud) == 0
    assert estimate.correction is not None
    assert np.abs(estimate.correction.position).max() < 1e-9
    assert abs(estimate.correction.orientation[3]) > 1.0 - 1e-12


@pytest.mark.parametrize(
    ("wrong", "mode", "words"),
    [
        ("baseline reversed", "stereo", "baseline of camera 1 reversed"),
        ("extrinsics inverted", "stereo", "extrinsics inverted"),
        ("turned 1 about x", "stereo", "camera 1 does not fit its place on the body by about 1 degree"),
        ("depth in mm", "rgbd", "depth_m in millimetres"),
        ("camera from world", "mono", "camera-from-world"),
        ("focal 1.2", "stereo", "focal length off"),
    ],
)
def test_wrong_set_up_is_held(wrong: str, mode: str, words: str) -> None:
    data = recording(wrong=wrong, mode=mode)
    backend = Backend(Config())
    last = play(backend, data)[-1]
    assert last.report.status is Status.HELD
    assert re.search(words, last.report.reason)
    assert re.search(words, backend.scene.log.warnings["setup"])
    assert last.report.warnings
    same_as_input(last, data)


@pytest.mark.slow
def test_sound_set_up_says_nothing() -> None:
    backend = Backend(Config())
    estimates = play(backend, recording())
    assert [one.report.status for one in estimates].count(Status.HELD) == 0
    assert not backend.scene.log.warnings
    assert backend.scene.keyframes.refined.all()


def test_a_test_that_fails_is_said_and_keeps_nobody_from_solving(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise ValueError("by design")

    monkeypatch.setattr("ba_node.check.motion.check_motion", fails)
    backend = Backend(Config())
    estimates = play(backend, recording())
    assert "internal error, ValueError: by design" in backend.scene.log.warnings["check_failed"]
    assert any(one.report.status is Status.CONVERGED for one in estimates)


def test_can_be_turned_off() -> None:
    backend = Backend(Config().with_values({"guard.check_setup": False}))
    play(backend, recording(wrong="baseline reversed"), keyframes=12)
    assert "setup" not in backend.scene.log.warnings


def test_reset_and_sessions_are_checked_anew() -> None:
    backend = Backend(Config())
    play(backend, recording(wrong="baseline reversed"), keyframes=8)
    assert backend.setup.reason(backend.scene)
    backend.reset()
    assert not backend.setup.reason(backend.scene)
    # The same front-end goes on: the rig is as wrong as before.
    last = play(backend, recording(wrong="baseline reversed"), keyframes=8)[-1]
    assert last.report.status is Status.HELD


@pytest.mark.slow
def test_stands_first() -> None:
    """A robot that stands has nothing to tell; it is checked when it moves."""
    data = recording(mode="mono", wrong="", keyframes=30)
    still = 30
    sound = _standing(data, still)
    backend = Backend(Config())
    play(backend, sound)
    assert "setup" not in backend.scene.log.warnings
    wrong = WRONG["poses inverted"](sound)
    backend = Backend(Config())
    last = play(backend, wrong)[-1]
    assert re.search("poses inverted", last.report.reason)
    same_as_input(last, wrong)


@pytest.mark.slow
def test_full_solve_is_not_taken() -> None:
    backend = Backend(Config())
    data = recording(wrong="turned 1 about x")
    play(backend, data)
    assert backend.optimize() is None
    same_as_input(backend.estimate(), data)


def test_without_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(two_view, "available", lambda: False)
    backend = Backend(Config())
    play(backend, recording(), keyframes=12)
    assert backend.scene.log.notices["setup_unchecked"] == 1
    assert "setup" not in backend.scene.log.warnings


def test_poses_are_looked_at_again_after_a_turn() -> None:
    """A camera that looks to the side is given looking to the other one: on a straight way its steps nearly fit."""
    data = recording(701, mode="mono", path="line", look_deg=90.0, keyframes=60)
    wrong = rig(lambda rotation, position: (rotation.transpose(0, 2, 1), position))(data)
    backend = Backend(Config())
    last = play(backend, wrong)[-1]
    assert re.search("extrinsics inverted", last.report.reason)
    same_as_input(last, wrong)


def test_warnings_that_follow_from_the_set_up_go() -> None:
    backend = Backend(Config())
    play(backend, recording(wrong="no baseline", path="line"))
    assert set(backend.scene.log.warnings) == {"setup"}


@pytest.mark.slow
def test_solutions_that_are_given_up_leave_a_correction() -> None:
    """map -> odom goes on to be published: the identity, as the front-end's poses stand."""
    backend = Backend(Config().with_values({"guard.check_setup": False}))
    data = recording(wrong="turned 1 about x")
    estimates = play(backend, data, keyframes=30)
    assert estimates[-1].report.status is Status.HELD
    same_as_input(estimates[-1], data)


def test_elsewhere() -> None:
    """Work that is handed over blocks nothing, and its result counts for the session that it is of."""
    backend = Backend(Config())
    handed: list[Any] = []
    backend.setup.elsewhere = handed.append
    data = recording(wrong="baseline reversed")
    play(backend, data, keyframes=8)
    assert len(handed) == 1
    assert "setup" not in backend.scene.log.warnings
    estimate = backend.take_check(handed[0].run())
    assert estimate is not None
    assert estimate.report.status is Status.HELD
    same_as_input(estimate, data)
    backend.reset()
    assert backend.take_check(handed[0].run()) is None


def _standing(data: SyntheticData, still: int) -> SyntheticData:
    """Return a recording whose first keyframe comes many times over before the others."""
    import dataclasses  # noqa: PLC0415

    step = data.keyframes[1].stamp_ns - data.keyframes[0].stamp_ns
    rng = np.random.default_rng(0)
    rows = [0] * still + list(range(len(data.keyframes)))
    keyframes, tracks = [], []
    for k, row in enumerate(rows):
        stamp = data.keyframes[0].stamp_ns + k * step
        keyframes.append(dataclasses.replace(data.keyframes[row], keyframe_id=k, stamp_ns=stamp))
        noise = rng.normal(0.0, 0.3 if k < still else 0.0, data.tracks[row][0].uv.shape)
        tracks.append((dataclasses.replace(data.tracks[row][0], keyframe_id=k, uv=data.tracks[row][0].uv + noise),))
    order = np.array(rows)
    truth = dataclasses.replace(
        data.truth,
        keyframe_id=np.arange(len(rows), dtype=np.uint64),
        stamp_ns=data.keyframes[0].stamp_ns + step * np.arange(len(rows)),
        position=data.truth.position[order],
        orientation=data.truth.orientation[order],
    )
    return dataclasses.replace(
        data, keyframes=tuple(keyframes), tracks=tuple(tracks), guesses=(None,) * len(rows), truth=truth
    )
