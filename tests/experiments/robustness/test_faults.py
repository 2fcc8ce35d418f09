# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The faults are what they say, the same every time, and leave the truth as it is."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.core.geometry import matrix_from_quaternion, so3_log
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement
from experiments.robustness.faults import FAULTS, MONO, RGBD, SOUND, STEREO, Recording, spoiled, without_outliers

SMALL = {"keyframes": 14, "length_m": 10.0, "landmarks": 800, "tracks": 60}


def make(name: str, rig: str | None = None, amount: float | None = None, seed: int = 1) -> Recording:
    return spoiled(name, rig, amount, seed, **SMALL)


def images(recording: Recording) -> list[FeatureTracks]:
    return [m for m in recording.measurements if isinstance(m, FeatureTracks)]


def rig_of(recording: Recording) -> CameraRig:
    return next(m for m in recording.measurements if isinstance(m, CameraRig))


def same(a: Measurement, b: Measurement) -> bool:
    return type(a) is type(b) and all(_equal(value, vars(b)[name]) for name, value in vars(a).items())


def _equal(a: object, b: object) -> bool:
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    numbers = isinstance(a, np.ndarray) and a.dtype.kind == "f"
    return np.array_equal(a, b, equal_nan=numbers)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", FAULTS)
def test_same_seed_same_recording_and_times_rise(name: str) -> None:
    rig = FAULTS[name].rigs[-1]
    one, two, sound = make(name, rig), make(name, rig), make(SOUND, rig)
    assert len(one.timeline) == len(two.timeline)
    for (topic, time_ns, a), (other, other_ns, b) in zip(one.timeline, two.timeline, strict=True):
        assert (topic, time_ns) == (other, other_ns)
        assert same(a, b)
    assert np.all(np.diff([time_ns for _, time_ns, _ in one.timeline]) >= 0)
    assert len(one.truth) == len(one.keyframes) == len(one.odometry)
    assert np.isfinite(one.truth.position).all()
    changed = len(one.timeline) != len(sound.timeline)
    assert changed or not all(map(same, one.measurements, sound.measurements)), "nothing is wrong in it"


@pytest.mark.parametrize("rig", [STEREO, MONO, RGBD])
def test_sound_recording_has_the_observations_where_the_truth_is(rig: str) -> None:
    recording = spoiled(SOUND, rig, seed=2, **SMALL, outlier_share=0.0)
    for image in images(recording):
        assert not recording.projector.wrong(image, 5.0).any()
    assert max(np.abs(recording.odometry.position - recording.truth.position).max(axis=1)) < 0.2


@pytest.mark.parametrize("name", ["outliers_uniform", "outliers_jumping", "outliers_moving"])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_share_of_outliers(name: str, share: float) -> None:
    recording = spoiled(name, STEREO, share, 3, keyframes=30, length_m=15.0, tracks=100, outlier_share=0.0)
    wrong = np.concatenate([recording.projector.wrong(image, 5.0) for image in images(recording)])
    # Not every displaced observation is displaced by much, and one that moves off the image is gone.
    assert 0.5 * share < wrong.mean() < 1.2 * share, f"{wrong.mean():.3f} of {len(wrong)}"
    cleaned = without_outliers(recording, 5.0)
    assert sum(len(image.uv) for image in images(cleaned)) == np.count_nonzero(~wrong)
    assert not any(cleaned.projector.wrong(image, 5.0).any() for image in images(cleaned))


def test_camera_is_turned_by_the_angle() -> None:
    for amount in (0.5, 10.0):
        a, b = rig_of(make("camera_turned", amount=amount)), rig_of(make(SOUND, STEREO))
        turn = np.swapaxes(matrix_from_quaternion(b.orientation), 1, 2) @ matrix_from_quaternion(a.orientation)
        angles = np.degrees(np.linalg.norm(so3_log(turn), axis=1))
        np.testing.assert_allclose(angles, [0.0, amount], atol=1e-6)


def test_baseline_is_reversed_about_the_first_camera() -> None:
    a, b = rig_of(make("baseline_reversed")), rig_of(make(SOUND, STEREO))
    np.testing.assert_allclose(a.position[1] - a.position[0], b.position[0] - b.position[1], atol=1e-12)
    np.testing.assert_array_equal(a.position[0], b.position[0])


def test_stamps() -> None:
    def stamps(name: str, amount: float | None = None) -> np.ndarray:
        return np.array([keyframe.stamp_ns for keyframe in make(name, STEREO, amount).keyframes])

    sound = stamps(SOUND)
    assert np.unique(sound - stamps("clock_set_back", 60.0)).tolist() == [0, 60 * 10**9]
    assert np.count_nonzero(stamps("one_stamp_zero") == 0) == 1
    assert sorted(stamps("one_stamp_future", 86400.0) - sound)[-2:] == [0, 86400 * 10**9]
    assert stamps("begins_anew").tolist() == 2 * sound.tolist()
    assert len(stamps("duplicates")) == len(sound) + 1


def test_ids_are_places() -> None:
    recording = make("ids_reused", STEREO)
    assert max(int(image.track_id.max()) for image in images(recording)) < SMALL["tracks"]
    for image in images(recording):
        assert len(np.unique(image.track_id)) == len(image.track_id)


def test_motions() -> None:
    def steps(name: str, amount: float) -> np.ndarray:
        step: np.ndarray = np.linalg.norm(np.diff(make(name, amount=amount).truth.position, axis=0), axis=1)
        return step

    assert np.count_nonzero(steps("stands_still", 5.0) == 0.0) == 5
    assert np.count_nonzero(steps("stops_midway", 5.0) == 0.0) == 5
    assert steps("pure_rotation", 3.0).max() == 0.0
    np.testing.assert_allclose(steps("hardly_moves", 1.0)[:10], 1e-3, atol=1e-9)
    recording = make("far_points", amount=2.0)
    distance = np.linalg.norm(recording.sound.landmarks - recording.truth.position[0], axis=1)
    np.testing.assert_allclose(distance, 2000.0, rtol=1e-9)


def test_one_keyframe_is_far_off_and_few_points_are_few() -> None:
    recording = make("one_keyframe_far", STEREO, 60.0)
    off = np.linalg.norm(recording.odometry.position - recording.truth.position, axis=1)
    assert np.count_nonzero(off > 1.0) == 1 and abs(off.max() - 60.0) < 0.5
    assert {len(image.uv) for image in images(make("few_points", STEREO, 2.0))} <= {0, 1, 2}


def test_session_is_lowered_at_a_keyframe() -> None:
    recording = make("session_lowered", STEREO, 10.0)
    assert [keyframe.session_id for keyframe in recording.keyframes] == [10] * 7 + [0] * 7
    owner = {keyframe.keyframe_id: keyframe.session_id for keyframe in recording.keyframes}
    assert all(image.session_id == owner[image.keyframe_id] for image in images(recording))
    assert all(isinstance(m, Keyframe | FeatureTracks | CameraRig) for m in recording.measurements)
