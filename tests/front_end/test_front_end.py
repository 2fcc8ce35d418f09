# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The front-end on rendered images: every mode against the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from unittest.mock import Mock

import numpy as np
import pytest

from ba_node.core import cameras, geometry
from ba_node.estimate import Cloud, Poses, Transform
from ba_node.front_end import FrontEnd, Images, State, Tracked, features, tracking
from ba_node.measurements import Keyframe
from tests.front_end import world
from tests.front_end.following import OPTIONS, PLAIN, follow

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")


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


@pytest.mark.slow
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


def test_the_others_are_where_they_would_have_been_followed_to(
    stereo: list[Images], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few points lead; the pose that they tell brings the others to where Lucas-Kanade finds them."""
    monkeypatch.setattr(tracking, "_LEADERS", 40)
    front_end = FrontEnd(world.rig(), dataclasses.replace(PLAIN, keyframe_parallax_px=1000.0))
    follow(front_end, stereo[:1])
    assert front_end._session is not None
    tracker = front_end._session.tracker
    rows, uv, leaders = tracker.rows.copy(), tracker.uv.copy(), tracker.leaders
    assert 40 <= len(leaders) < 0.5 * len(rows)
    followed = features.follow
    spied = Mock(side_effect=followed)
    monkeypatch.setattr(features, "follow", spied)
    assert [one.state for one in follow(front_end, stereo[1:2])] == [State.TRACKING]
    assert [len(call.args[2]) for call in spied.call_args_list] == [len(leaders)]
    there, found = followed(stereo[0].grey[0], stereo[1].grey[0], uv, None)
    brought = found & np.isin(rows, tracker.rows) & ~np.isin(rows, leaders)
    at = dict(zip(tracker.rows.tolist(), tracker.uv, strict=True))
    off = [np.linalg.norm(at[row] - place) for row, place in zip(rows[brought].tolist(), there[brought], strict=True)]
    assert len(off) > 0.4 * len(rows)
    assert np.median(off) < 0.3 and np.mean(np.array(off) > 1.0) < 0.1


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


@pytest.mark.slow
def test_depth_camera(truth: list[Transform]) -> None:
    rig = world.rig(1)
    frames = [world.images(rig, pose, i, depth=True) for i, pose in enumerate(truth)]
    found = follow(FrontEnd(rig, OPTIONS), frames)
    scale, error = scale_and_error(found, truth)
    assert scale == pytest.approx(1.0, abs=0.006)
    assert error < 0.01
    assert all(len(one.tracks) == 1 and np.isfinite(one.tracks[0].depth_m).all() for one in found if one.keyframe)


@pytest.mark.slow
def test_depths_in_another_unit(truth: list[Transform]) -> None:
    """5000 is 1 m, and 1000 was taken for it."""
    rig = world.rig(1)
    frames = [world.images(rig, pose, i, depth=True) for i, pose in enumerate(truth[:8])]
    wrong = [world.without(one, depth_m=one.depth_m * np.float32(5.0)) for one in frames if one.depth_m is not None]
    blind = follow(FrontEnd(rig, OPTIONS), wrong)
    told = follow(FrontEnd(rig, dataclasses.replace(OPTIONS, depth_scale=0.2)), wrong)
    assert scale_and_error(blind, truth[:8])[0] == pytest.approx(5.0, rel=0.02)
    assert scale_and_error(told, truth[:8])[0] == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
