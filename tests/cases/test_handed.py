# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Small recordings that once went wrong: the result is what their README says is right."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core.geometry import matrix_from_quaternion, so3_log
from ba_node.estimate import Estimate
from ba_node.io.trajectory import read_tum
from ba_node.measurements import CameraRig, LandmarkGuesses, Measurement
from tests.cases.conftest import Replay, harmless
from tests.conftest import Case

Cases = Callable[[str], Case]
OK, ATTENTION = 0, 3
# Name -> keyframes, exit codes, largest error m, patterns of which each has to be found in the messages.
WITH_TRUTH: dict[str, tuple[int, tuple[int, ...], float, tuple[str, ...]]] = {
    "clock_set_back": (40, (ATTENTION,), 0.01, (r"keyframe 20 is 3599\.9 s older",)),
    "one_stamp_zero": (39, (ATTENTION,), 0.02, ("stamp", "keyframe 17", "1 bad_stamp, 2 unknown_keyframe")),
    "stereo_baseline_sign": (60, (ATTENTION,), 0.0995, ("baseline|swapped", "camera 1|camera_rig")),
    "extrinsics_inverted": (60, (ATTENTION,), 0.0995, ("invert|camera.from.body|axes",)),
    "mono_stands_still": (50, (OK,), 0.066, ("keyframes 0 to 1[0-9] .* from another place",)),
    "depth_in_mm": (60, (ATTENTION,), 0.0381, ("depth", "mm|milli|1000")),
    "extrinsics_1_degree": (80, (ATTENTION,), 0.004, ("camera 1", "degree|deg")),
}


@pytest.mark.parametrize("name", WITH_TRUTH)
def test_no_worse_than_what_came_in(name: str, case: Cases, run: Replay) -> None:
    given = case(name)
    keyframes, codes, most_m, named = WITH_TRUTH[name]
    outcome = run(given.bag)
    assert outcome.code in codes, outcome.words
    errors = outcome.errors(given.truth)
    harmless(errors, 1.0, keyframes)
    for error in errors:
        assert error.published_m <= most_m, f"{error.folder.name}: {error.published_m:.4f} m, at most {most_m} m"
    assert sum(error.keyframes for error in errors) == keyframes
    outcome.tells(*named)
    folders = [outcome.out, outcome.out / "session_0"] if name == "clock_set_back" else [outcome.out]
    assert sorted(error.folder for error in errors) == sorted(folders)


@pytest.mark.slow
def test_clock_set_back_leaves_two_maps(case: Cases, run: Replay) -> None:
    given = case("clock_set_back")
    assert sorted(error.keyframes for error in run(given.bag).errors(given.truth)) == [20, 20]


def estimate(stream: Iterable[Measurement]) -> Estimate:
    backend = Backend(Config())
    for _ in backend.replay(stream):
        pass
    return backend.estimate()


def test_region_of_interest_is_taken_off_the_principal_point(case: Cases, run: Replay) -> None:
    """The same observations with the offset taken off by hand give the same path."""
    given = case("camera_info_roi")
    outcome = run(given.bag)
    assert outcome.code == OK, outcome.words
    assert outcome.report["notices"]["adjusted_camera"] == 2 and outcome.report["attention"] == []
    assert outcome.report["rms_px_without_outliers"]["refined"] < 0.11, "the noise is 0.1 px"
    published = read_tum(outcome.out / "trajectory.tum").position
    assert len(published) == 25
    # The K in the file is 403.9, 631.1, 375.7: that of the whole sensor, whatever the reader makes of it.
    intrinsics = np.array([403.911583563, 403.911583563, 631.065444573 - 320.0, 375.688877091 - 200.0])
    by_hand = [
        dataclasses.replace(m, intrinsics=np.tile(intrinsics, (2, 1)), image_size=np.tile([640, 400], (2, 1)))
        if isinstance(m, CameraRig)
        else m
        for m in given.measurements
    ]
    np.testing.assert_allclose(published, estimate(by_hand).trajectory.position, atol=1e-6)


def test_camera_that_hardly_moves_does_not_mirror_the_map(case: Cases, run: Replay) -> None:
    outcome = run(case("mono_hardly_moves").bag)
    assert outcome.code in (OK, ATTENTION)
    assert outcome.report["rms_px"]["refined"] <= 0.725, outcome.report["rms_px"]
    before, after = (read_tum(outcome.out / f"{name}.tum") for name in ("trajectory_input", "trajectory"))
    assert len(after) == 5
    turn = matrix_from_quaternion(before.orientation[-1]).T @ matrix_from_quaternion(after.orientation[-1])
    angle = np.degrees(np.linalg.norm(so3_log(turn)))
    assert angle < 3.0, f"last pose {angle:.1f} degrees off"
    moved = [float(np.linalg.norm(poses.position[-1] - poses.position[0])) for poses in (before, after)]
    along = (after.position[-1] - after.position[0]) @ (before.position[-1] - before.position[0])
    assert along > 0.9 * moved[0] ** 2, f"{moved[0]:.3f} m before, {along / moved[0]:.3f} m along it after"


def test_map_at_its_optimum_stays_there(case: Cases, run: Replay) -> None:
    given = case("optimal_map_runaway_point")
    outcome = run(given.bag)
    # Of its first two images the rays meet at 0.045 degrees, which may be said.
    assert outcome.code in (OK, ATTENTION), outcome.words
    assert outcome.report["rms_px"]["refined"] <= 0.94, outcome.report["rms_px"]
    assert outcome.report["landmarks"] == 509
    before, after = (read_tum(outcome.out / f"{name}.tum") for name in ("trajectory_input", "trajectory"))
    np.testing.assert_allclose(after.position, before.position, atol=0.02)
    guesses = [m for m in given.measurements if isinstance(m, LandmarkGuesses)]
    ids, first = np.unique(np.concatenate([m.track_id for m in guesses]), return_index=True)
    guess = np.concatenate([m.position for m in guesses])[first]
    cloud = estimate(given.measurements).cloud
    place_of = dict(zip(cloud.track_id.tolist(), cloud.position, strict=True))
    assert set(place_of) == set(ids.tolist())
    place = np.array([place_of[int(key)] for key in ids])
    distance = np.linalg.norm(guess - before.position.mean(axis=0), axis=1)
    moved = np.linalg.norm(place - guess, axis=1) / distance
    # One that is seen from two images close to each other may slide along its rays.
    assert moved.max() < 0.3, f"point {ids[moved.argmax()]} moved by {moved.max():.2f} of its distance"
    assert np.median(moved) < 0.005
