# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What programs send that are not quite those whose layout it is: said and counted, never taken for something else."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from tests.messages.adapters import layouts
from tests.messages.adapters.layouts import CLOUD, ODOMETRY, Sent
from tests.messages.adapters.test_adapters import feed, of

IMAGES = 6


def changed(
    source: str, type_name: str, change: Callable[[Any, int], None], end: str = "", **options: Any
) -> Iterator[Sent]:
    """Yield what a source sends, with a change of some messages, which are numbered."""
    number = 0
    for sent in getattr(layouts, source)(layouts.scene(IMAGES), **options):
        message = copy.deepcopy(sent.message)
        if sent.type_name == type_name and sent.topic.endswith(end):
            change(message, number)
            number += 1
        yield sent._replace(message=message)


def _nan(message: Any, number: int) -> None:
    if number % 3 == 0:
        message.pose.pose.position.x = float("nan")


def _zero(message: Any, number: int) -> None:
    if number % 3 == 0:
        turn = message.pose.pose.orientation
        turn.x = turn.y = turn.z = turn.w = 0.0


@pytest.mark.parametrize("spoil", [_nan, _zero])
def test_poses_that_are_none_are_left_out(spoil: Callable[[Any, int], None]) -> None:
    made, out = feed("openvins", changed("openvins", ODOMETRY, spoil, "loop_pose"))
    assert made.counted["bad_pose"] == 2
    assert "loop_pose: position [" in made.notes["bad_pose"]
    keyframes = of(Keyframe, out)
    assert len(keyframes) == IMAGES - 2
    assert all(np.isfinite(one.position).all() and one.orientation.any() for one in keyframes)


@pytest.mark.parametrize("source", ["openvins", "vins_fusion", "vins_mono"])
@pytest.mark.parametrize("spoil", [_nan, _zero])
def test_an_extrinsic_that_is_none_gives_no_rig(source: str, spoil: Callable[[Any, int], None]) -> None:
    """The next sound one does."""
    made, out = feed(source, changed(source, ODOMETRY, spoil, "extrinsic"))
    assert made.counted["bad_extrinsic"] == 2
    (rig,) = of(CameraRig, out)
    assert np.allclose(rig.position[0], layouts.scene(IMAGES).rig.position[0])
    assert len(of(Keyframe, out)) >= 2


def test_stamps_that_never_pair_are_told_by_how_much() -> None:
    made, out = feed("openvins", changed("openvins", ODOMETRY, _late, "loop_pose"))
    made.finish()
    assert not of(Keyframe, out)
    for reason in ("no_features", "no_pose"):
        assert made.counted[reason] == IMAGES
        assert made.notes[reason] == "the nearest is 5.000 ms off; taken are up to 1 ms (--tolerance)"


def _late(message: Any, _: int) -> None:
    message.header.stamp.nanosec += 5_000_000


def _divided(message: Any, _: int) -> None:
    for channel in message.channels:
        channel.values[2:4] /= 400.0


def _exchanged(message: Any, _: int) -> None:
    for channel in message.channels:
        channel.values[:4] = channel.values[[2, 3, 0, 1]]


def _turned(message: Any, _: int) -> None:
    for channel in message.channels:
        channel.values[2:4] = channel.values[[3, 2]]


def _pixels(message: Any, _: int) -> None:
    for point, u, v in zip(message.points, message.channels[1].values, message.channels[2].values, strict=True):
        point.x, point.y = float(u), float(v)


@pytest.mark.parametrize(
    ("source", "spoil", "words"),
    [
        ("openvins", _divided, "are they divided by the focal length?"),
        ("vins_fusion", _divided, "are they divided by the focal length?"),
        ("vins_fusion", _exchanged, "divided by the focal length?"),
        ("vins_fusion", _turned, "are on the side of u and v: are these exchanged?"),
        ("vins_mono", _pixels, "exchanged?"),
    ],
)
def test_pixels_that_are_none_are_said(source: str, spoil: Callable[[Any, int], None], words: str) -> None:
    made, out = feed(source, changed(source, CLOUD, spoil))
    assert not of(Keyframe, out)
    assert made.counted["not_pixels"] >= 2
    assert words in made.notes["not_pixels"]


def _named(order: tuple[int, ...], names: tuple[str, ...]) -> Callable[[Any, int], None]:
    def change(message: Any, _: int) -> None:
        message.channels = [message.channels[i] for i in order]
        for channel, name in zip(message.channels, names, strict=True):
            channel.name = name

    return change


def _with_camera(message: Any, _: int) -> None:
    message.channels.insert(1, copy.deepcopy(message.channels[0]))
    message.channels[1].name = "camera_id"
    message.channels[1].values = np.zeros(len(message.points), np.float32)


def _with_camera_and_no_names(message: Any, number: int) -> None:
    _with_camera(message, number)
    for channel in message.channels:
        channel.name = ""


@pytest.mark.parametrize(
    "change",
    [
        _named((1, 2, 3, 4, 0), ("u", "v", "velocity_x", "velocity_y", "id")),
        _named((2, 1, 0, 3, 4), ("v_of_point", "u_of_point", "id_of_point", "vx", "vy")),
        _with_camera,
        _with_camera_and_no_names,
    ],
    ids=["other_order", "other_names", "with_camera", "input_of_vins_fusion"],
)
def test_channels_in_another_order_that_is_told(change: Callable[[Any, int], None]) -> None:
    """By their names, or by one for the camera, as the estimator of VINS-Fusion takes them."""
    expected = of(FeatureTracks, feed("vins_mono", layouts.vins_mono(layouts.scene(IMAGES)))[1])
    found = of(FeatureTracks, feed("vins_mono", changed("vins_mono", CLOUD, change))[1])
    assert len(found) == len(expected) >= 2
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.track_id, other.track_id)
        assert np.array_equal(one.uv, other.uv)


def test_a_camera_that_is_none_is_counted() -> None:
    def spoil(message: Any, number: int) -> None:
        _with_camera(message, number)
        message.channels[1].values[:3] = np.nan, -1.0, 7.0

    made, out = feed("vins_mono", changed("vins_mono", CLOUD, spoil))
    assert made.counted["unknown_camera"] == 3 * len(of(Keyframe, out)) > 0


@pytest.mark.parametrize("source", ["openvins", "vins_fusion"])
def test_a_source_that_begins_anew_while_its_clock_goes_on(source: str) -> None:
    """Ids count from 0 again, and stand for other points: the session before keeps what it has."""
    data, options = layouts.scene(12), {"late": 0} if source == "vins_fusion" else {}
    began = sorted({int(one.stamp_ns) for one in data.keyframes})[6]
    first = next(one for one in data.keyframes if one.stamp_ns == began)
    turn = geometry.matrix_from_quaternion(first.orientation).T
    number: dict[float, float] = {}

    def anew(xyz: Any) -> None:
        xyz.x, xyz.y, xyz.z = (float(v) for v in turn @ (np.array([xyz.x, xyz.y, xyz.z]) - first.position))

    sent = []
    for one in getattr(layouts, source)(data, **options):
        message = copy.deepcopy(one.message)
        if message.header.stamp.sec * 10**9 + message.header.stamp.nanosec >= began - 200:
            if one.topic.endswith("_pose"):
                at = message.pose.pose
                q = np.array([at.orientation.x, at.orientation.y, at.orientation.z, at.orientation.w])
                turned = geometry.quaternion_from_matrix(turn @ geometry.matrix_from_quaternion(q))
                at.orientation.x, at.orientation.y, at.orientation.z, at.orientation.w = map(float, turned)
                anew(at.position)
            for channel, point in zip(getattr(message, "channels", []), getattr(message, "points", []), strict=True):
                channel.values[4] = number.setdefault(float(channel.values[4]), float(len(number)))
                anew(point)
        sent.append(one._replace(message=message))
    made, out = feed(source, sent)
    keyframes = of(Keyframe, out)
    assert [one.session_id for one in keyframes] == [int(one.stamp_ns >= began) for one in keyframes]
    assert {one.session_id for one in keyframes} == {0, 1}
    assert made.notes["begun_anew"].endswith("a new session")
    assert made.summary().endswith("in 2 sessions")
    assert "begun_anew" not in feed(source, getattr(layouts, source)(data, **options))[0].notes


def _w_first(message: Any, _: int) -> None:
    turn = message.pose.pose.orientation
    turn.x, turn.y, turn.z, turn.w = turn.w, turn.x, turn.y, turn.z


def _inverted(message: Any, _: int) -> None:
    turn, at = message.pose.pose.orientation, message.pose.pose.position
    back = geometry.matrix_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w])).T
    turn.x, turn.y, turn.z = -turn.x, -turn.y, -turn.z
    at.x, at.y, at.z = (float(v) for v in -back @ np.array([at.x, at.y, at.z]))


@pytest.mark.parametrize("source", ["openvins", "vins_fusion"])
@pytest.mark.parametrize(
    ("spoil", "end", "words"),
    [
        (_w_first, "_pose", "the poses (fixed frame from body) have quaternions with w first"),
        # The quaternion of an optical frame is the same with w first.
        (_w_first, "", "the poses (fixed frame from body) have quaternions with w first: put x, y, z, w into them"),
        (_inverted, "extrinsic", "the extrinsics (body from camera) "),
    ],
)
def test_poses_that_are_written_otherwise_are_named(
    source: str, spoil: Callable[[Any, int], None], end: str, words: str
) -> None:
    """By the points, which a source tells with the pixels that show them; nothing is taken for what it is not."""
    made, out = feed(source, changed(source, ODOMETRY, spoil, end))
    assert not of(Keyframe, out)
    assert made.counted["misread"] >= 2
    assert words in made.notes["misread"], made.notes["misread"]
