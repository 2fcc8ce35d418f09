# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The front-end on rendered images: every mode against the truth, and what it makes of images that are no good."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import pytest

from ba_node.config.front_end import FrontEndOptions
from ba_node.core import cameras, geometry
from ba_node.estimate import Cloud, Poses, Transform
from ba_node.front_end import FrontEnd, Images, State, Tracked
from ba_node.measurements import Keyframe
from tests.front_end import world

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")

OPTIONS = FrontEndOptions(max_features=300)
PLAIN = dataclasses.replace(OPTIONS, stereo_align=False)


def follow(front_end: FrontEnd, frames: Sequence[Images], odometry: Sequence[Transform] | None = None) -> list[Tracked]:
    given: Sequence[Transform | None] = odometry or [None] * len(frames)
    return [front_end.process(one, pose) for one, pose in zip(frames, given, strict=True)]


def scale_and_error(found: Sequence[Tracked], truth: Sequence[Transform]) -> tuple[float, float]:
    """Return length of the way by the true one, and the largest distance as a share of the way."""
    pairs = [(one.pose, pose) for one, pose in zip(found, truth, strict=True) if one.pose is not None]
    ours = np.array([a.translation for a, _ in pairs])
    theirs = np.array([b.translation for _, b in pairs])
    length = np.linalg.norm(np.diff(theirs, axis=0), axis=1).sum()
    first = Transform(pairs[0][1].rotation, pairs[0][1].translation)
    placed = ours @ first.rotation.T + first.translation
    ratio = np.linalg.norm(np.diff(ours, axis=0), axis=1).sum() / length
    return float(ratio), float(np.linalg.norm(placed - theirs, axis=1).max() / length)


@pytest.fixture(scope="module")
def truth() -> list[Transform]:
    return world.drive(12)


@pytest.fixture(scope="module")
def stereo(truth: list[Transform]) -> list[Images]:
    return [world.images(world.rig(), pose, i) for i, pose in enumerate(truth)]


def test_stereo(truth: list[Transform], stereo: list[Images]) -> None:
    found = follow(FrontEnd(world.rig(), PLAIN), stereo)
    scale, error = scale_and_error(found, truth)
    assert scale == pytest.approx(1.0, abs=0.005)
    assert error < 0.008, f"{100 * error:.2f} %"
    assert all(one.state is not State.LOST and not one.notes for one in found)
    keyframes = [one for one in found if one.keyframe]
    assert len(keyframes) >= 3
    for one in keyframes:
        left, right = one.tracks
        assert len(left.track_id) > 100
        assert set(right.track_id) <= set(left.track_id)
        assert (left.sigma_px > 0.0).all()


def test_observations_fit_the_truth(truth: list[Transform], stereo: list[Images]) -> None:
    """Points triangulated from a track's first view reproject where it is seen later, in both cameras."""
    found = follow(FrontEnd(world.rig(), PLAIN), stereo)
    rig, errors = world.rig(), []
    first: dict[int, np.ndarray] = {}
    for i, one in enumerate(found):
        if not one.keyframe:
            continue
        pose = truth[i]
        left = one.tracks[0]
        depth = world.render(rig, 0, pose).depth_m
        for key, uv in zip(left.track_id.tolist(), left.uv, strict=True):
            point = (np.append((uv - rig.intrinsics[0, 2:]) / world.FOCAL, 1.0)) * depth[
                tuple(np.round(uv[::-1]).astype(int))
            ]
            where = first.setdefault(key, pose.rotation @ point + pose.translation)
            seen = pose.inverse()
            x = seen.rotation @ where + seen.translation
            errors.append(np.linalg.norm(world.FOCAL * x[:2] / x[2] + rig.intrinsics[0, 2:] - uv))
    assert np.median(errors) < 0.1
    assert np.mean(np.array(errors) > 2.0) < 0.03


def test_the_same_images_give_the_same_tracks(stereo: list[Images]) -> None:
    one, other = (follow(FrontEnd(world.rig(), OPTIONS), stereo[:6]) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        assert a.pose is not None and b.pose is not None
        assert np.array_equal(a.pose.translation, b.pose.translation)
        for x, y in zip(a.tracks, b.tracks, strict=True):
            assert np.array_equal(x.uv, y.uv) and np.array_equal(x.track_id, y.track_id)


@pytest.mark.slow
def test_raw_images_of_a_turned_rig(truth: list[Transform]) -> None:
    rig = world.rig(2, (-0.25, 0.06, 0.001, -0.0005, 0.0), np.array([0.02, -0.03, 0.04]))
    frames = [world.images(rig, pose, i) for i, pose in enumerate(truth[:8])]
    found = follow(FrontEnd(rig, PLAIN), frames)
    scale, error = scale_and_error(found, truth[:8])
    assert scale == pytest.approx(1.0, abs=0.01)
    assert error < 0.015
    # Tracks are in raw pixels: what both cameras see triangulates to a depth in front, by the raw model.
    left, right = found[0].tracks
    rows = np.isin(left.track_id, right.track_id)
    model, params = zip(
        *(cameras.parameters(m, k, d) for m, k, d in zip(rig.models, rig.intrinsics, rig.distortion, strict=True)),
        strict=True,
    )
    depth = world.render(rig, 0, truth[0]).depth_m
    at = np.round(left.uv[rows]).astype(int)
    n = int(rows.sum())
    flat = cameras.normalise(left.uv[rows], np.full(n, model[0]), np.tile(params[0], (n, 1)))
    points = np.column_stack([flat, np.ones(n)]) * depth[at[:, 1], at[:, 0]][:, None]
    turned = (points - rig.position[1]) @ geometry.matrix_from_quaternion(rig.orientation[1])
    there = cameras.project(turned, np.full(n, model[1]), np.tile(params[1], (n, 1)))
    assert np.median(np.linalg.norm(there - right.uv, axis=1)) < 0.15


@pytest.mark.slow
def test_second_camera_turned_against_the_rig() -> None:
    """A pixel of disparity that the calibration does not know of: found, and the scale is right again.

    So it is from the first image on, as these are tracked again once the turn is known.
    """
    poses = world.drive(24)
    yaw = 1.0 / world.FOCAL
    real = world.rig(turn=np.array([0.0, yaw, 0.0]))
    frames = [world.images(real, pose, i) for i, pose in enumerate(poses)]
    blind = follow(FrontEnd(world.rig(), PLAIN), frames)
    front_end = FrontEnd(world.rig(), OPTIONS)
    found = follow(front_end, frames)
    assert front_end.alignment is not None
    assert abs(front_end.alignment[0][0]) == pytest.approx(1.0, abs=0.15)
    (number,) = [i for i, one in enumerate(found) if one.again]
    assert found[number].notes[-1].endswith("the one before is void")
    told = [one for one in found[number].measurements() if isinstance(one, Keyframe)]
    told += [one.keyframe for one in found[number + 1 :] if one.keyframe]
    assert (told[0].session_id, told[0].keyframe_id, told[0].stamp_ns) == (2, 1, found[0].stamp_ns)
    assert [one.session_id for one in found] == [1] * number + [2] * (len(found) - number)
    wrong = scale_and_error(blind, poses)[0]
    at = {one.stamp_ns: pose.translation for one, pose in zip(found, poses, strict=True)}
    ours, theirs = np.array([one.position for one in told]), np.array([at[one.stamp_ns] for one in told])
    right = np.linalg.norm(np.diff(ours, axis=0), axis=1).sum() / np.linalg.norm(np.diff(theirs, axis=0), axis=1).sum()
    assert abs(wrong - 1.0) > 0.03, f"without: {wrong:.4f}"
    assert abs(right - 1.0) < 0.012, f"with: {right:.4f}"


def test_depth_camera(truth: list[Transform]) -> None:
    rig = world.rig(1)
    frames = [world.images(rig, pose, i, depth=True) for i, pose in enumerate(truth)]
    found = follow(FrontEnd(rig, OPTIONS), frames)
    scale, error = scale_and_error(found, truth)
    assert scale == pytest.approx(1.0, abs=0.006)
    assert error < 0.01
    assert all(len(one.tracks) == 1 and np.isfinite(one.tracks[0].depth_m).all() for one in found if one.keyframe)


def test_one_camera_with_odometry(truth: list[Transform]) -> None:
    rig = world.rig(1)
    frames = [world.images(rig, pose, i) for i, pose in enumerate(truth)]
    found = follow(FrontEnd(rig, OPTIONS), frames, truth)
    assert not any(one.notes for one in found)
    for one, pose in zip(found, truth, strict=True):
        assert one.pose is not None
        assert np.array_equal(one.pose.translation, pose.translation)
    keyframes = [one for one in found if one.keyframe]
    assert len(keyframes) >= 3
    # Of the first steps nobody knows how their lengths scatter: to two per cent along, and one across.
    first, second = (one.keyframe for one in keyframes[:2])
    assert first and second and not len(first.covariance)
    before, step = (truth[found.index(one)] for one in keyframes[:2])
    told = second.covariance.reshape(6, 6)[:3, :3]
    moved = before.rotation.T @ (step.translation - before.translation)
    length, across = float(np.linalg.norm(moved)), np.array([1.0, 0.0, 0.0])
    assert np.sqrt(moved @ told @ moved) / length == pytest.approx(0.0005 + np.hypot(0.001, 0.02) * length, rel=1e-6)
    assert np.sqrt(across @ told @ across) == pytest.approx(0.0005 + 0.01 * length, rel=0.1)
    shared = np.intersect1d(keyframes[0].tracks[0].track_id, keyframes[2].tracks[0].track_id)
    assert len(shared) > 20


def test_one_camera_alone(truth: list[Transform]) -> None:
    rig = world.rig(1)
    frames = [world.images(rig, pose, i) for i, pose in enumerate(truth)]
    found = follow(FrontEnd(rig, OPTIONS), frames)
    notes = [note for one in found for note in one.notes]
    assert notes == ["one camera without odometry: the scale is free, lengths are in units of the first step"]
    first = next(i for i, one in enumerate(found) if one.keyframe)
    assert 0 < first < 8
    assert [type(m).__name__ for m in found[first].measurements()][:2] == ["Keyframe", "FeatureTracks"]
    # The shape of the way is right, whatever its scale.
    ours = np.array([one.pose.translation for one in found[first:] if one.pose is not None])
    theirs = np.array([pose.translation for pose in truth[first:]])
    scale = np.linalg.norm(theirs[-1]) / np.linalg.norm(ours[-1])
    assert np.linalg.norm(scale * ours - theirs, axis=1).max() < 0.1 * np.linalg.norm(theirs[-1])


def test_stand_still_and_turn_on_the_spot() -> None:
    still = [Transform(np.eye(3), np.zeros(3))] * 4
    turns = [Transform(geometry.so3_exp(np.array([0.0, 0.03 * i, 0.0])), np.zeros(3)) for i in range(1, 9)]
    frames = [world.images(world.rig(), pose, i) for i, pose in enumerate([*still, *turns])]
    found = follow(FrontEnd(world.rig(), PLAIN), frames)
    assert [one.state for one in found[1:4]] == [State.STANDING] * 3
    assert sum(one.keyframe is not None for one in found[:4]) == 1
    for one, pose in zip(found, [*still, *turns], strict=True):
        assert one.pose is not None
        assert np.linalg.norm(one.pose.translation) < 0.01
        assert np.linalg.norm(geometry.so3_log(one.pose.rotation.T @ pose.rotation)) < 0.002


def test_dark_images_leave_the_map(truth: list[Transform], stereo: list[Images]) -> None:
    front_end = FrontEnd(world.rig(), PLAIN)
    follow(front_end, stereo[:4])
    black = tuple(np.zeros_like(grey) for grey in stereo[4].grey)
    dark = follow(front_end, [world.without(one, grey=black) for one in stereo[4:6]])
    assert [one.state for one in dark] == [State.LOST] * 2
    assert "shows nothing" in dark[0].notes[0] and not dark[1].notes
    sigma_m = [float(np.sqrt(one.covariance[0, 0])) for one in dark]
    assert sigma_m == pytest.approx([0.2, 0.3])
    again = front_end.process(stereo[6])
    assert again.state is State.TRACKING and again.session_id == 1
    assert again.pose is not None
    assert np.linalg.norm(again.pose.translation - truth[6].translation) < 0.03
    # The step across them is told with what it was unsure by, and no other.
    assert again.keyframe is not None
    assert np.sqrt(again.keyframe.covariance.reshape(6, 6)[0, 0]) == pytest.approx(0.3)
    later = [one.keyframe for one in follow(front_end, stereo[7:]) if one.keyframe]
    assert later and not any(len(one.covariance) for one in later)


@pytest.mark.parametrize("spoil", ["dark", "blurred"])
def test_what_is_not_found_again_begins_a_session(stereo: list[Images], spoil: str) -> None:
    """Nothing to see for as long as max_lost says, then another place."""
    front_end = FrontEnd(world.rig(), dataclasses.replace(PLAIN, max_lost=3))
    before = [one.keyframe for one in follow(front_end, stereo[:4]) if one.keyframe]
    bad = [
        world.without(one, grey=tuple(cv2.blur(g, (61, 61)) if spoil == "blurred" else 0 * g for g in one.grey))
        for one in stereo[4:7]
    ]
    told = follow(front_end, bad)
    assert [(one.state, one.session_id) for one in told] == [(State.LOST, 1)] * 3
    assert np.all(np.diff([one.covariance[0, 0] for one in told]) > 0.0)
    assert sum(len(one.notes) for one in told) == 1, "said once"
    far = Transform(geometry.so3_exp(np.array([0.0, np.pi, 0.0])), np.array([0.3, 0.0, 15.0]))
    other = front_end.process(world.images(world.rig(), far, 7))
    assert other.session_id == 2 and other.keyframe is not None
    assert other.notes[-1] == "session 2 begins: 4 images without a pose; the map of the one before stays as it is"
    assert (before[0].session_id, other.keyframe.session_id) == (1, 2)
    assert not len(other.keyframe.covariance), "no step leads to it"


def test_an_odometry_that_ends_begins_a_session(truth: list[Transform]) -> None:
    """Images alone have no scale to go on with: they are lost, then a session of its own, until it comes back."""
    rig = world.rig(1)
    front_end = FrontEnd(rig, dataclasses.replace(OPTIONS, max_lost=2))
    frames = [world.images(rig, pose, i) for i, pose in enumerate(truth)]
    found = follow(front_end, frames[:4], truth[:4])
    assert found[-1].state is not State.LOST
    lost = [front_end.process(one) for one in frames[4:7]]
    assert [one.state for one in lost] == [State.LOST, State.LOST, State.STARTING]
    assert "no odometry, which the session has its scale from" in lost[0].notes[0]
    assert [one.session_id for one in lost] == [1, 1, 2]
    assert "the scale is free" in lost[2].notes[-1]
    again = follow(front_end, frames[7:], truth[7:])
    assert again[0].session_id == 3 and again[0].keyframe is not None
    assert "an odometry is there now" in again[0].notes[0]
    assert again[-1].pose is not None
    assert np.array_equal(again[-1].pose.translation, truth[-1].translation)


def test_long_pause_begins_a_session_only_where_nothing_is_known(stereo: list[Images]) -> None:
    """One stamp after a pause may be wrong: only the next one tells, and decides."""
    front_end = FrontEnd(world.rig(), PLAIN)
    follow(front_end, stereo[:4])
    later = [world.without(one, stamp_ns=one.stamp_ns + 30_000_000_000) for one in stereo[4:6]]
    paused = follow(front_end, later)
    assert [(one.session_id, one.state) for one in paused] == [(1, State.TRACKING)] * 2 and paused[0].keyframe is None
    far = Transform(geometry.so3_exp(np.array([0.0, np.pi, 0.0])), np.array([0.3, 0.0, 15.0]))
    elsewhere = [
        world.without(world.images(world.rig(), far, 0), stamp_ns=later[1].stamp_ns + 30_000_000_000 + i * 100_000_000)
        for i in range(2)
    ]
    lost, other = follow(front_end, elsewhere)
    assert (lost.state, lost.session_id, other.session_id) == (State.LOST, 1, 2)
    assert any("30.1 s without images" in note for note in other.notes)
    assert other.keyframe is not None and other.keyframe.session_id == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"skew_ns": 30_000_000}, "+30.0 ms off the first"),
        ({"stamp_ns": 1_000_000_000}, "is not after the one before"),
        ({"grey": (np.full((120, 160), 9, np.uint8),) * 2}, "160 x 120 px where the calibration is for 320 x 240"),
    ],
)
def test_what_is_wrong_with_images_is_said(stereo: list[Images], changes: dict[str, object], words: str) -> None:
    front_end = FrontEnd(world.rig(), PLAIN)
    front_end.process(stereo[0])
    told = front_end.process(world.without(stereo[1], **changes))
    assert any(words in note for note in told.notes), told.notes
    assert front_end.process(stereo[2]).session_id == 1


def test_one_picture_for_both_cameras_is_no_pair(stereo: list[Images]) -> None:
    front_end = FrontEnd(world.rig(), PLAIN)
    told = follow(front_end, [world.without(one, grey=one.grey[:1] * 2) for one in stereo[:6]])
    assert "are the same picture: not taken for a pair" in told[0].notes[0]
    assert all("the same picture" not in note for one in told[1:] for note in one.notes), "once"
    assert front_end.counts["same"] == 6
    assert all(one.guesses is None for one in told), "no depths from it"


def test_left_and_right_exchanged(stereo: list[Images]) -> None:
    told = FrontEnd(world.rig(), PLAIN).process(world.without(stereo[0], grey=stereo[0].grey[::-1]))
    assert any("exchanged" in note for note in told.notes), told.notes


def test_masks(stereo: list[Images]) -> None:
    left_half = np.ones(world.SIZE[::-1], bool)
    left_half[:, :160] = False
    static = FrontEnd(world.rig(), PLAIN, mask=left_half).process(stereo[0])
    moving = FrontEnd(world.rig(), PLAIN).process(world.without(stereo[0], mask=left_half))
    for one in (static, moving):
        assert len(one.tracks[0].uv) > 40
        assert one.tracks[0].uv[:, 0].min() >= 160.0


@pytest.mark.slow
def test_lost_points_come_back_under_their_ids() -> None:
    """The camera looks away and back: what it saw first is found again."""
    turns = [0.0, 0.0, 0.12, 0.24, 0.36, 0.48, 0.6, 0.48, 0.36, 0.24, 0.12, 0.0]
    poses = [
        Transform(geometry.so3_exp(np.array([0.0, a, 0.0])), np.array([0.0, 0.0, 0.02 * i]))
        for i, a in enumerate(turns)
    ]
    options = dataclasses.replace(PLAIN, keyframe_min_shared=0.9)
    found = follow(FrontEnd(world.rig(), options), [world.images(world.rig(), pose, i) for i, pose in enumerate(poses)])
    keyframes = [one for one in found if one.keyframe]
    first, middle, last = (set(keyframes[i].tracks[0].track_id.tolist()) for i in (0, len(keyframes) // 2, -1))
    back = (first & last) - middle
    assert len(back) > 30, f"{len(back)} of {len(first)} came back"


def test_refined_poses_move_the_map_and_not_what_is_published(stereo: list[Images]) -> None:
    one, other = FrontEnd(world.rig(), PLAIN), FrontEnd(world.rig(), PLAIN)
    follow(one, stereo[:5])
    before = follow(other, stereo[:5])
    keyframes = [found.keyframe for found in before if found.keyframe]
    shift = Transform(geometry.so3_exp(np.array([0.0, 0.1, 0.0])), np.array([1.0, 2.0, 3.0]))
    poses = Poses.of(keyframes)
    rotation = shift.rotation @ geometry.matrix_from_quaternion(poses.orientation)
    moved = dataclasses.replace(
        poses,
        position=poses.position @ shift.rotation.T + shift.translation,
        orientation=geometry.quaternion_from_matrix(rotation),
    )
    other.refine(moved, Cloud(np.zeros(0, np.uint64), np.zeros((0, 3)), np.zeros(0, np.float32), np.zeros(0, np.int32)))
    for frame in stereo[5:8]:
        a, b = one.process(frame), other.process(frame)
        assert a.pose is not None and b.pose is not None
        assert np.linalg.norm(a.pose.translation - b.pose.translation) < 1e-3


def _noise(one: Images) -> Images:
    rng = np.random.default_rng(7)
    return world.without(one, grey=tuple(rng.integers(0, 256, grey.shape, dtype=np.uint8) for grey in one.grey))


def _speckled(one: Images) -> Images:
    rng = np.random.default_rng(8)
    grey = tuple(np.where(rng.random(grey.shape) < 0.001, 255, 0).astype(np.uint8) for grey in one.grey)
    return world.without(one, grey=grey)


def _wild_depth(one: Images) -> Images:
    rng = np.random.default_rng(9)
    values = rng.choice([0.0, np.nan, 1e9, np.inf, 1.5], size=one.grey[0].shape)
    return world.without(one, grey=one.grey[:1], depth_m=values.astype(np.float32))


@pytest.mark.parametrize(
    "spoil",
    [
        _noise,
        _speckled,
        _wild_depth,
        lambda one: world.without(one, grey=one.grey[:1]),
        lambda one: world.without(one, grey=tuple(grey[:, ::-1].copy() for grey in one.grey)),
        lambda one: world.without(one, mask=np.zeros(one.grey[0].shape, bool)),
        lambda one: world.without(one, mask=np.ones((3, 3), bool)),
    ],
    ids=["noise", "speckled", "wild_depth", "one_image", "mirrored", "all_masked", "mask_of_another_size"],
)
def test_nothing_is_raised_and_the_map_stays(stereo: list[Images], spoil: Callable[[Images], Images]) -> None:
    front_end = FrontEnd(world.rig(), PLAIN)
    follow(front_end, stereo[:2])
    follow(front_end, [spoil(stereo[2])])
    after = front_end.process(stereo[3])
    assert after.session_id == 1 and after.state is State.TRACKING
    follow(FrontEnd(world.rig(), PLAIN), [spoil(one) for one in stereo[:2]])
