# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Which way is up, and which axes a picture from above has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.estimate import Poses
from ba_node.offline.figures import trajectory_figures
from ba_node.offline.run_folder import Comparison
from ba_node.offline.viewpoint import page, seen_from, upwards
from experiments.synthetic import SyntheticOptions, generate

N = 20
WAY, STILL = np.linspace(0.0, 9.0, N), np.zeros(N)
# Axes of a camera that looks along x of a body of REP 103, of one that looks down from it (its top is in front), and of
# one on an IMU whose x is upwards.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
OVER = np.diag([1.0, -1.0, -1.0])
ON_IMU = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def poses(x: FloatArray, y: FloatArray, z: FloatArray, turned: FloatArray | None = None) -> Poses:
    """Return poses at positions, all turned alike (3, 3)."""
    orientation = geometry.quaternion_from_matrix(np.tile(np.eye(3) if turned is None else turned, (N, 1, 1)))
    return Poses(np.arange(N, dtype=np.uint64), np.arange(N), np.stack([x, y, z], axis=1), orientation)


@pytest.mark.parametrize(
    ("what", "path", "camera", "axes"),
    [
        ("a straight street in camera axes", poses(0.01 * WAY, 0.05 * WAY, WAY), np.eye(3), (0, 2)),
        ("the same, its camera not known", poses(0.01 * WAY, 0.05 * WAY, WAY), None, (0, 2)),
        ("standing still, camera axes", poses(STILL, STILL, STILL), np.eye(3), (0, 2)),
        ("standing still, REP 103", poses(STILL, STILL, STILL), AHEAD, (0, 1)),
        ("standing still, nothing known", poses(STILL, STILL, STILL), None, (0, 1)),
        ("up a lift, REP 103", poses(STILL, STILL, WAY), AHEAD, (0, 1)),
        ("up a lift, camera axes", poses(STILL, -WAY, STILL), np.eye(3), (0, 2)),
        ("in a vertical plane, REP 103", poses(np.sin(WAY), STILL, WAY), AHEAD, (0, 1)),
        ("along a front, which it looks at, REP 103", poses(STILL, WAY, np.sin(WAY)), AHEAD, (0, 1)),
        ("a street, REP 103", poses(WAY, 0.1 * WAY, 0.2 * WAY), AHEAD, (0, 1)),
        ("the same, its camera not known", poses(WAY, 0.1 * WAY, 0.2 * WAY), None, (0, 1)),
        ("a drone that looks down, REP 103", poses(np.cos(WAY), np.sin(WAY), 0.3 * WAY), DOWN, (0, 1)),
        # x of the fixed frame is to the right, y backwards, z upwards: the camera's y is forwards, its z down.
        (
            "the same in camera axes",
            poses(np.cos(WAY), np.sin(WAY), 0.01 * WAY, np.diag([1.0, -1, -1])),
            np.eye(3),
            (0, 1),
        ),
        ("a drone everywhere", poses(np.cos(WAY), np.sin(2.0 * WAY), np.sin(3.0 * WAY)), AHEAD, (0, 1)),
        ("an IMU whose x is upwards", poses(0.1 * WAY, np.sin(WAY), WAY), ON_IMU, (1, 2)),
        ("nothing", poses(STILL, STILL, STILL)[:0], None, (0, 1)),
    ],
)
def test_from_above_is_across_the_axis_that_is_upright(
    what: str, path: Poses, camera: FloatArray | None, axes: tuple[int, int]
) -> None:
    assert seen_from(upwards(path, camera))[:2] == axes, what


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_picture_is_not_mirrored(axis: int, sign: float) -> None:
    up = sign * np.eye(3)[axis] + 0.3
    right, upwards_in_picture, along = seen_from(up)
    assert along == axis
    assert np.cross(np.eye(3)[right], np.eye(3)[upwards_in_picture]) @ up > 0.0


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_picture_that_is_higher_than_wide_is_turned_and_not_mirrored(axis: int, sign: float) -> None:
    up = sign * np.eye(3)[axis]
    right, upwards_in_picture, _ = seen_from(up)
    wide = WAY[:, None] * (2.0 * np.eye(3)[right] + np.eye(3)[upwards_in_picture])
    high = WAY[:, None] * (0.1 * np.eye(3)[right] + np.eye(3)[upwards_in_picture])
    assert page(up, [wide]) == (right, upwards_in_picture, False) == page(up, [wide[:0]])
    across, upright, is_reversed = page(up, [high, high[:3]])
    assert (across, upright, is_reversed) == (upwards_in_picture, right, True)
    assert np.cross(np.eye(3)[across], -np.eye(3)[upright]) @ up > 0.0


def test_a_map_is_upright_in_the_axes_of_its_reference() -> None:
    """The estimate in camera axes, its reference with z upwards: the picture is the reference's."""
    truth = generate(SyntheticOptions(keyframes=12, landmarks=300, tracks=40)).truth
    turn = AHEAD.T
    orientation = geometry.quaternion_from_matrix(turn @ geometry.matrix_from_quaternion(truth.orientation))
    ours = replace(truth, position=truth.position @ turn.T, orientation=orientation)
    for against, names in ((truth, "xy"), (None, "xz")):
        figures, _ = trajectory_figures(Comparison("here", None, ours, against, np.empty((0, 3)), "se3"))
        titles = [figures[0].layout[axis]["title"] for axis in ("xaxis", "yaxis")]
        assert sorted(titles) == [f"{name} [m]" for name in names]
