# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""An odometry that is wrong beside images is named; a sound one is left in peace."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest

from ba_node.config.front_end import FrontEndOptions
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end import FrontEnd, Images
from ba_node.front_end.streams import OdometryBuffer
from tests.front_end import world

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")

COUNT = 30
Way = list[Transform]


@functools.cache
def drive() -> tuple[Transform, ...]:
    """Return poses along a way that bends to both sides and nods."""
    poses, pose = [], Transform(np.eye(3), np.zeros(3))
    for i in range(COUNT):
        poses.append(pose)
        turn = np.array([0.006 * np.sin(0.5 * i), 0.03 * np.sin(0.35 * i), 0.0])
        pose = pose.after(Transform(geometry.so3_exp(turn), np.array([0.03 * np.sin(0.35 * i), 0.0, 0.22])))
    return tuple(poses)


@functools.cache
def seen(mode: str) -> tuple[Images, ...]:
    rig = world.rig(2 if mode == "stereo" else 1)
    return tuple(world.images(rig, pose, i, depth=mode == "rgbd") for i, pose in enumerate(drive()))


def told(mode: str, odometry: Way, images: tuple[Images, ...] | None = None) -> tuple[dict[str, int], str]:
    """Return counts and notes of causes that have to do with the odometry."""
    rig = world.rig(2 if mode == "stereo" else 1)
    front_end = FrontEnd(rig, FrontEndOptions(max_features=300))
    notes: list[str] = []
    for one, pose in zip(images or seen(mode), odometry, strict=True):
        notes += front_end.process(one, pose).notes
    counts = {cause: n for cause, n in front_end.counts.items() if cause.startswith("odometry")}
    return counts, "\n".join(note for note in notes if "odometry" in note)


def turned(x: float, y: float, z: float) -> Transform:
    return Transform(geometry.so3_exp(np.array([x, y, z])), np.zeros(3))


def noisy(pose: Transform, rng: np.random.Generator) -> Transform:
    turn = geometry.so3_exp(0.002 * rng.normal(size=3))
    return Transform(pose.rotation @ turn, pose.translation + 0.01 * rng.normal(size=3))


def at(frame: float) -> Transform:
    """Return the pose between two images."""
    frame = min(max(frame, 0.0), COUNT - 1.001)
    buffer = OdometryBuffer()
    for i, pose in enumerate(drive()):
        buffer.add(i * world.STEP_NS, pose)
    found = buffer.at(round(frame * world.STEP_NS))
    assert found is not None
    return found


OPTICAL = Transform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["mono", "stereo", "rgbd"])
@pytest.mark.parametrize("name", ["as it is", "noisy", "from elsewhere"])
def test_a_sound_odometry_is_left_in_peace(mode: str, name: str) -> None:
    rng, elsewhere = np.random.default_rng(5), turned(2.0, 0.3, 1.0)
    change: dict[str, Callable[[Transform], Transform]] = {
        "as it is": lambda pose: pose,
        "noisy": lambda pose: noisy(pose, rng),
        "from elsewhere": elsewhere.after,
    }
    assert told(mode, [change[name](pose) for pose in drive()]) == ({}, "")


FAULTS: dict[str, tuple[Callable[[], Way], str, str]] = {
    "millimetres": (
        lambda: [Transform(p.rotation, 1000.0 * p.translation) for p in drive()],
        "odometry_unit",
        "are they millimetres?",
    ),
    "stands still": (lambda: [drive()[0]] * COUNT, "odometry_still", "stands still while images move"),
    "optical axes": (lambda: [p.after(OPTICAL) for p in drive()], "odometry_axes", "optical axes"),
    "body axes": (lambda: [p.after(OPTICAL.inverse()) for p in drive()], "odometry_axes", "optical axes"),
    "another body frame": (
        lambda: [p.after(turned(0.0, 0.0, np.pi)) for p in drive()],
        "odometry_axes",
        "turned by 180 degrees",
    ),
    "inverted": (lambda: [p.inverse() for p in drive()], "odometry_inverted", "fixed frame from body"),
    "positions in NED": (
        lambda: [Transform(p.rotation, NED @ p.translation) for p in drive()],
        "odometry_frames",
        "turned by 180 degrees against that of its orientations",
    ),
    "0.1 s late": (lambda: [at(i - 1.0) for i in range(COUNT)], "odometry_stamps", "0.10 s later than"),
    "0.2 s early": (lambda: [at(i + 2.0) for i in range(COUNT)], "odometry_stamps", "0.20 s earlier than"),
}


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["mono", pytest.param("stereo", marks=pytest.mark.slow), "rgbd"])
@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_named(mode: str, name: str) -> None:
    make, cause, words = FAULTS[name]
    counts, notes = told(mode, make())
    assert list(counts) == [cause], notes
    assert words in notes


def test_another_unit_is_told_where_depths_are() -> None:
    counts, notes = told("rgbd", [Transform(p.rotation, 0.8 * p.translation) for p in drive()])
    assert list(counts) == ["odometry_unit"], notes
    assert "0.8 times as long" in notes or "0.79" in notes


@pytest.mark.parametrize("mode", ["mono", "stereo"])
def test_images_that_stand_still_while_the_odometry_moves(mode: str) -> None:
    first = seen(mode)[0]
    still = tuple(world.without(first, stamp_ns=one.stamp_ns) for one in seen(mode))
    counts, notes = told(mode, list(drive()), still)
    assert list(counts) == ["odometry_moves"], notes
    assert "images stand still while the odometry went" in notes
