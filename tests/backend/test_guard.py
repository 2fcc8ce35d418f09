# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is published is at least as good as what came in, whatever is wrong with the rig, the depths or the poses."""

from __future__ import annotations

import dataclasses
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ba_node.backend import Backend, Optimization
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.core.result import Status
from ba_node.estimate import Estimate, Poses
from ba_node.evaluation.metrics import absolute_error
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from experiments.synthetic import SyntheticOptions
from tests.generated import generated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tests.conftest import Case

KINDS: dict[str, dict[str, Any]] = {
    "stereo": {},
    "one camera": {"baseline_m": 0.0},
    "depth": {"baseline_m": 0.0, "depth_share": 0.7},
}
# Odometry so good that hardly anything betters it, and as it usually is.
GOOD: dict[str, Any] = {"drift_rotation_deg": 0.02, "drift_translation": 0.0005}
USUAL: dict[str, Any] = {"drift_rotation_deg": 0.3, "drift_translation": 0.01}

# The guard alone: no check of the set-up before it.
ALONE = Config().with_values({"guard.check_setup": False})

Stream = list[Measurement]


def recording(**options: Any) -> tuple[Stream, Poses]:
    base: dict[str, Any] = {"keyframes": 40, "landmarks": 3000, "tracks": 150, "length_m": 35.0}
    data = generated(SyntheticOptions(**{**base, **options}))
    return [measurement for _, _, measurement in data.timeline()], data.truth


def replay(backend: Backend, stream: Iterable[Measurement]) -> list[Estimate]:
    return [event for event in backend.replay(stream) if isinstance(event, Estimate)]


def errors(stream: Stream, truth: Poses, last: Estimate, without: tuple[int, ...] = ()) -> tuple[float, float]:
    """Return the error of the input and of what is published (m, rmse, se3), some keyframes left out."""
    inputs = [measurement for measurement in stream if isinstance(measurement, Keyframe)]
    kept = np.setdiff1d(np.arange(len(inputs)), without)
    came = Poses(
        truth.keyframe_id,
        truth.stamp_ns,
        np.array([one.position for one in inputs]),
        np.array([one.orientation for one in inputs]),
    )
    before, after = (absolute_error(poses[kept], truth).translation.rmse for poses in (came, last.trajectory))
    return before, after


def with_rig(stream: Stream, change: Callable[[CameraRig], CameraRig]) -> Stream:
    return [change(one) if isinstance(one, CameraRig) else one for one in stream]


def reversed_baseline(rig: CameraRig) -> CameraRig:
    position = rig.position.copy()
    position[1] = 2.0 * position[0] - position[1]
    return dataclasses.replace(rig, position=position)


def swapped(rig: CameraRig) -> CameraRig:
    return dataclasses.replace(rig, position=rig.position[::-1], orientation=rig.orientation[::-1])


def inverted(rig: CameraRig) -> CameraRig:
    rotation, position = geometry.inverse(geometry.matrix_from_quaternion(rig.orientation), rig.position)
    return dataclasses.replace(rig, orientation=geometry.quaternion_from_matrix(rotation), position=position)


def turned(axis: int, degrees: float) -> Callable[[CameraRig], CameraRig]:
    def change(rig: CameraRig) -> CameraRig:
        rotation = geometry.matrix_from_quaternion(rig.orientation).copy()
        rotation[1] = rotation[1] @ geometry.so3_exp(np.radians(degrees) * np.eye(3)[axis])
        return dataclasses.replace(rig, orientation=geometry.quaternion_from_matrix(rotation))

    return change


def zoomed(factor: float) -> Callable[[CameraRig], CameraRig]:
    return lambda rig: dataclasses.replace(rig, intrinsics=rig.intrinsics * [factor, factor, 1.0, 1.0])


def scaled_depths(stream: Stream, factor: float) -> Stream:
    return [
        dataclasses.replace(one, depth_m=factor * one.depth_m) if isinstance(one, FeatureTracks) else one
        for one in stream
    ]


def jumped(stream: Stream, at: int, shift: Iterable[float], turn: float, stays: bool = False) -> Stream:
    """Return a recording whose front-end is elsewhere in one keyframe, or from it on."""
    out, k = list(stream), -1
    for i, one in enumerate(stream):
        if isinstance(one, Keyframe):
            k += 1
            if k == at or (stays and k > at):
                rotation = geometry.so3_exp(np.array([0.0, 0.0, turn])) @ geometry.matrix_from_quaternion(
                    one.orientation
                )
                orientation = geometry.quaternion_from_matrix(rotation)
                out[i] = dataclasses.replace(one, position=one.position + list(shift), orientation=orientation)
    return out


WRONG_RIGS: dict[str, tuple[str, Callable[[CameraRig], CameraRig], str]] = {
    "baseline reversed": ("stereo", reversed_baseline, "observations agree"),
    "cameras swapped": ("stereo", swapped, "observations (of camera 1 )?agree"),
    "extrinsics inverted": ("stereo", inverted, "observations agree"),
    "extrinsics of one camera inverted": ("one camera", inverted, "by rays that meet"),
    "second camera pitched by 1 degree": ("stereo", turned(0, 1.0), "observations agree"),
    "second camera yawed by 0.3 degrees": ("stereo", turned(1, 0.3), "as long as the front-end's"),
    "second camera yawed by -1 degree": ("stereo", turned(1, -1.0), "as long as the front-end's"),
    "second camera rolled by 1 degree": ("stereo", turned(2, 1.0), "camera 0 alone"),
    "focal length 20 % short, stereo": ("stereo", zoomed(0.8), "focal length|half its steps|off the front-end's"),
    "focal length 20 % long, stereo": ("stereo", zoomed(1.2), "focal length|half its steps|off the front-end's"),
    "focal length 20 % short, one camera": ("one camera", zoomed(0.8), ""),
    "focal length 20 % long, one camera": ("one camera", zoomed(1.2), ""),
    "focal length 20 % short, depth": ("depth", zoomed(0.8), "off the front-end's"),
    "focal length 20 % long, depth": ("depth", zoomed(1.2), "off the front-end's"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG_RIGS)
def test_a_wrong_rig_does_no_harm(name: str) -> None:
    kind, change, words = WRONG_RIGS[name]
    stream, truth = recording(**GOOD, **KINDS[kind])
    stream = with_rig(stream, change)
    backend = Backend(ALONE)
    last = replay(backend, stream)[-1]
    before, after = errors(stream, truth, last)
    assert after <= 1.001 * before, f"{before:.4f} -> {after:.4f} m"
    # Where hardly a track has a place there is no solution that could be held.
    text = backend.scene.log.warnings.get("held", last.report.reason)
    assert re.search(words, text), text


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "words"), [(1000.0, "measured depths agree"), (1.2, "as long as the front-end's")])
def test_depths_in_another_unit_do_no_harm(factor: float, words: str) -> None:
    stream, truth = recording(**GOOD, **KINDS["depth"])
    stream = scaled_depths(stream, factor)
    backend = Backend(ALONE)
    before, after = errors(stream, truth, replay(backend, stream)[-1])
    assert after <= 1.001 * before, f"{before:.4f} -> {after:.4f} m"
    assert words in backend.scene.log.warnings["held"]


JUMPS: dict[str, dict[str, Any]] = {
    "60 m": {"shift": (60.0, 0.0, 0.0), "turn": 0.0},
    "1 km": {"shift": (0.0, 1000.0, 0.0), "turn": 0.0},
    "90 degrees": {"shift": (0.0, 0.0, 0.0), "turn": np.pi / 2},
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("at", [3, 20, 39])
@pytest.mark.parametrize("jump", JUMPS)
def test_one_keyframe_far_off_harms_no_other(kind: str, at: int, jump: str) -> None:
    stream, truth = recording(**USUAL, **KINDS[kind])
    stream = jumped(stream, at, **JUMPS[jump])
    backend = Backend(ALONE)
    last = replay(backend, stream)[-1]
    before, after = errors(stream, truth, last, without=(at,))
    assert after <= 0.4 * before, f"{before:.4f} -> {after:.4f} m"
    if at > 3:
        # Its tracks allow it to be mended too.
        assert errors(stream, truth, last)[1] <= 0.4 * before
        text = backend.scene.log.warnings["stray"]
        assert f"keyframe {at} is" in text and "it has jumped" in text, text


@pytest.mark.parametrize("kind", KINDS)
def test_a_jump_that_stays_is_followed(kind: str) -> None:
    stream, truth = recording(**USUAL, **KINDS[kind])
    before, after = errors(
        stream := jumped(stream, 20, (60.0, 0.0, 0.0), 0.0, stays=True), truth, replay(Backend(ALONE), stream)[-1]
    )
    assert before > 20.0
    assert after < 0.02, f"{before:.4f} -> {after:.4f} m"


@pytest.mark.parametrize("spared", [0, 20])
@pytest.mark.parametrize("shift", [60.0, 0.0])
def test_a_jump_to_which_no_track_leads_is_said(shift: float, spared: int) -> None:
    stream, truth = recording(**USUAL)
    stream = jumped(stream, 20, (shift, 0.0, 0.0), 0.0, stays=True)
    late = next(i for i, one in enumerate(stream) if isinstance(one, Keyframe) and one.keyframe_id == 20)
    for i, one in enumerate(stream):
        if isinstance(one, FeatureTracks) and i >= late:
            new = np.append(one.track_id[:spared], one.track_id[spared:] + np.uint64(10**6))
            stream[i] = dataclasses.replace(one, track_id=new)
    backend = Backend(ALONE)
    before, after = errors(stream, truth, replay(backend, stream)[-1])
    assert after <= 1.1 * before
    text = backend.scene.log.warnings.get("parted", "")
    assert ("jumps at keyframe 20, by 6" in text and "raise session_id" in text) == (shift > 0.0 and not spared), text


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_keyframes_with_wrong_ids_harm_no_other(kind: str) -> None:
    stream, truth = recording(**USUAL, **KINDS[kind])
    rng, k = np.random.default_rng(1), -1
    for i, one in enumerate(stream):
        k += isinstance(one, Keyframe)
        if isinstance(one, FeatureTracks) and 20 <= k < 25:
            stream[i] = dataclasses.replace(one, track_id=rng.permutation(one.track_id))
    before, after = errors(stream, truth, replay(Backend(ALONE), stream)[-1])
    assert after <= 1.1 * before, f"{before:.4f} -> {after:.4f} m"


def closing(stream: Stream, shift: tuple[float, float, float]) -> Stream:
    """Return a recording that is dark for three keyframes, after which the front-end is off and tracks have new ids.

    From keyframe 48 on half of the tracks have their old ids again: the loop closes.
    """
    out: Stream = []
    k = -1
    for one in jumped(stream, 30, shift, 0.0, stays=True):
        k += isinstance(one, Keyframe)
        if not isinstance(one, FeatureTracks):
            out.append(one)
        elif not 27 <= k < 30:
            renamed = (k >= 30) & ((k < 48) | (one.track_id % 2 == 0))
            ids = np.where(renamed, one.track_id + np.uint64(1_000_000), one.track_id)
            out.append(dataclasses.replace(one, track_id=ids))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shift", [(1.5, 1.5, 1.0), (0.4, -0.4, 0.2)])
def test_a_loop_that_closes_is_taken(kind: str, shift: tuple[float, float, float]) -> None:
    """The map is off by 5 % of the way since the start where old tracks are seen again."""
    options = {"keyframes": 60, "length_m": 52.0, "seed": 3}
    stream, truth = recording(**options, **USUAL, **KINDS[kind])
    stream = closing(stream, shift)
    backend = Backend(ALONE)
    found = replay(backend, stream)
    before, after = errors(stream, truth, found[-1])
    assert after < 0.5 * before, f"{before:.3f} -> {after:.3f} m"
    assert all(one.report.status.usable for one in found[1:])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("drift", [GOOD, USUAL, {"drift_rotation_deg": 1.5, "drift_translation": 0.06}])
def test_nothing_is_held_of_sound_data(kind: str, drift: dict[str, Any]) -> None:
    stream, truth = recording(**drift, **KINDS[kind])
    backend = Backend(ALONE)
    found = replay(backend, stream)
    before, after = errors(stream, truth, found[-1])
    # At the end one follows where the front-end turns out to be precise.
    assert [one.report.status.usable for one in found] == [False] + [True] * (len(found) - 1) and len(found) < 42
    assert not backend.scene.log.warnings
    assert after <= max(before, 0.008)
    report = found[-1].report
    assert report.inlier_share > 0.9
    assert 2.0 < report.parallax_deg < 60.0
    assert 0.0 < report.held_out_px_after <= 1.1 * report.held_out_px_before
    # Of stereo that sees much: millimetres, and well below a degree.
    assert 0.0 < report.weakest_m < 0.05 and 0.0 < report.weakest_rad < 0.005
    assert report.held_keyframes == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_solution_need_not_be_tried_on_tracks(kind: str) -> None:
    backend = Backend(ALONE.with_values({"guard.held_out_tracks": 0}))
    stream, truth = recording(**USUAL, **KINDS[kind], keyframes=15)
    estimates = replay(backend, stream)
    assert not [one.report.reason for one in estimates if one.report.status.name == "HELD"]
    before, after = errors(stream, truth, estimates[-1])
    assert after < before


@pytest.mark.slow
def test_solves_are_taken_again_when_data_are_good_again() -> None:
    """Depths are wrong for twenty keyframes in the middle of a long way."""
    stream, truth = recording(**USUAL, **KINDS["depth"], keyframes=120, length_m=100.0, landmarks=8000)
    k = -1
    for i, one in enumerate(stream):
        k += isinstance(one, Keyframe)
        if isinstance(one, FeatureTracks) and 50 <= k < 70:
            stream[i] = dataclasses.replace(one, depth_m=1.5 * one.depth_m)
    backend = Backend(ALONE)
    found = replay(backend, stream)
    held = np.array([one.report.status.name == "HELD" for one in found])
    assert not held[:50].any()
    assert not held[-10:].any()
    before, after = errors(stream, truth, found[-1])
    assert after <= 1.1 * before, f"{before:.3f} -> {after:.3f} m"


def test_a_held_solve_leaves_the_map_as_it_was() -> None:
    stream, _ = recording(**USUAL)
    backend = Backend(ALONE)
    replay(backend, stream[:-3])
    table, points = backend.scene.keyframes, backend.scene.landmarks
    rows = np.flatnonzero(table.refined)
    before = [table.position[rows].copy(), points.position.copy(), backend.scene.observations.outlier.copy()]
    correction = backend.estimate().correction
    backend.configure(ALONE.with_values({"guard.min_inlier_share": 1.0}))
    last = replay(backend, stream[-3:])[-1]
    assert last.report.status.name == "HELD"
    assert "observations agree" in last.report.reason
    assert np.array_equal(table.position[rows], before[0])
    np.testing.assert_array_equal(points.position[: len(before[1])], before[1])
    assert np.array_equal(backend.scene.observations.outlier[: len(before[2])], before[2])
    assert backend.scene.keyframes.solved.all()
    assert not backend.scene.keyframes.refined[-1]
    assert correction is not None and last.correction is not None
    assert np.array_equal(last.correction.position, correction.position)
    # The newest keyframe follows the front-end from the last one that was refined.
    steps = [rotation.T @ (b - a) for rotation, a, b in (
        (one.rotation[-2], one.position[-2], one.position[-1]) for one in (table,)
    )]  # fmt: skip
    given = table.input_rotation[-2].T @ (table.input_position[-1] - table.input_position[-2])
    np.testing.assert_allclose(steps[0], given, atol=1e-9)


def test_a_point_that_ran_away_goes_back(case: Callable[[str], Case]) -> None:
    """A public model at its optimum: the largest residual of its 509 points is 4 px."""
    stream = case("optimal_map_runaway_point").measurements
    backend = Backend(ALONE)
    cloud = replay(backend, stream)[-1].cloud
    given = {
        int(track): position
        for one in stream
        if isinstance(one, LandmarkGuesses)
        for track, position in zip(one.track_id, one.position, strict=True)
    }
    moved = [np.linalg.norm(at - given[int(track)]) for track, at in zip(cloud.track_id, cloud.position, strict=True)]
    assert len(cloud) == len(given) == 509
    assert np.max(moved) < 1.0 and np.median(moved) < 0.03
    assert backend.map.rms_px("refined") <= 0.94


def test_what_hardly_moves_is_left_as_it_came(case: Callable[[str], Case]) -> None:
    """One camera, five images 1 mm apart at 6 m: they tell no distance."""
    stream = case("mono_hardly_moves").measurements
    backend = Backend(ALONE)
    last = replay(backend, stream)[-1]
    inputs = np.array([one.position for one in stream if isinstance(one, Keyframe)])
    np.testing.assert_allclose(last.trajectory.position, inputs, atol=1e-12)
    assert backend.map.rms_px("refined") == pytest.approx(0.7216, abs=1e-3)
    assert last.report.status is Status.SKIPPED
    assert last.report.reason.startswith("waits for parallax: the rays to its points meet at")
    assert not backend.scene.log.warnings, "nothing is wrong with it"


@pytest.mark.parametrize("kind", KINDS)
def test_a_solve_of_everything_is_judged_too(kind: str) -> None:
    stream, _ = recording(**USUAL, **KINDS[kind])
    backend = Backend(ALONE)
    replay(backend, stream)
    taken = backend.begin_optimization()
    assert isinstance(taken, Optimization)
    taken.solve(backend.config.solver)
    state = taken.result.state
    wrong = dataclasses.replace(state, translation=1.5 * state.translation, points=1.5 * state.points)
    before = backend.estimate().trajectory.position.copy()
    if kind != "one camera":
        assert backend.merge(taken.with_result(state=wrong)) is None
        assert backend.refusal and backend.refusal in backend.scene.log.warnings["held"]
        assert np.array_equal(backend.estimate().trajectory.position, before)
    assert backend.merge(taken) is not None
    assert not backend.refusal


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["stereo_baseline_sign", "extrinsics_inverted", "depth_in_mm", "extrinsics_1_degree"],
)
def test_recordings_gone_wrong(name: str, case: Callable[[str], Case]) -> None:
    given = case(name)
    stream = given.measurements
    backend = Backend(ALONE)
    before, after = errors(stream, given.truth, replay(backend, stream)[-1])
    assert after <= 1.1 * before, f"{before:.4f} -> {after:.4f} m"
    # The front-end's steps hold one camera that stands still: that is no cause to hold anything back.
    assert ("held" in backend.scene.log.warnings) == (name != "mono_stands_still")
