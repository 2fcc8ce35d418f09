# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the front-end makes of images that are no good: it says so, and the map stays."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end import FrontEnd, Images, State
from tests.front_end import world
from tests.front_end.following import OPTIONS, PLAIN, follow

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_long_pause_begins_a_session_only_where_nothing_is_known(stereo: list[Images]) -> None:
    """One stamp after a pause may be wrong: only the next one tells, and decides."""
    front_end = FrontEnd(world.rig(), PLAIN)
    follow(front_end, stereo[:4])
    later = [world.without(one, stamp_ns=one.stamp_ns + 30_000_000_000) for one in stereo[4:6]]
    paused = follow(front_end, later)
    assert [(one.session_id, one.state) for one in paused] == [(1, State.TRACKING)] * 2 and paused[0].keyframe is None
    (note,) = paused[1].notes
    assert "30.2 s without images" in note and "the session goes on" in note and not paused[0].notes
    assert not any(one.notes for one in follow(front_end, [world.without(stereo[6], stamp_ns=later[1].stamp_ns + 1)]))
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


@pytest.mark.parametrize("spoil", ["frozen", "black"])
def test_a_second_camera_that_hangs_or_is_covered_is_no_partner(
    truth: list[Transform], stereo: list[Images], spoil: str
) -> None:
    """It is said once; the first camera goes on alone, and the pair when there is one again."""
    front_end = FrontEnd(world.rig(), PLAIN)
    bad = stereo[2].grey[1] if spoil == "frozen" else np.zeros_like(stereo[2].grey[1])
    frames = [world.without(one, grey=(one.grey[0], bad)) if 3 <= i < 7 else one for i, one in enumerate(stereo)]
    told = follow(front_end, frames)
    words = "is the one before again, and the first is not" if spoil == "frozen" else "shows nothing"
    assert [[words in note for note in one.notes] for one in told] == [[]] * 3 + [[True]] + [[]] * 8
    assert front_end.counts == {"frozen" if spoil == "frozen" else "second_dark": 4}
    seen = [len(one.tracks) for one in told if one.keyframe is not None]
    assert seen[0] == seen[-1] == 2
    assert all(one.state is State.TRACKING and one.session_id == 1 for one in told[1:])
    last = told[-1].pose
    assert last is not None and np.linalg.norm(last.translation - truth[-1].translation) < 0.03


def test_a_depth_camera_that_hangs_is_said(truth: list[Transform]) -> None:
    rig = world.rig(1)
    frames = [world.images(rig, pose, i, depth=True) for i, pose in enumerate(truth[:4])]
    frames[2:] = [world.without(one, depth_m=frames[1].depth_m) for one in frames[2:]]
    notes = [note for one in follow(FrontEnd(rig, OPTIONS), frames) for note in one.notes]
    assert len(notes) == 1 and notes[0].startswith("the depth image at 1200000000 ns is the one before again"), notes
    still = [world.without(frames[0], stamp_ns=frames[0].stamp_ns + i * world.STEP_NS) for i in range(3)]
    assert not any(one.notes for one in follow(FrontEnd(rig, OPTIONS), still)), "nor does a pair that stands still"


def test_left_and_right_exchanged(stereo: list[Images]) -> None:
    told = FrontEnd(world.rig(), PLAIN).process(world.without(stereo[0], grey=stereo[0].grey[::-1]))
    assert any("exchanged" in note for note in told.notes), told.notes


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
