# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ba_node.check import two_view
from ba_node.check.two_view import Pair, Pose
from ba_node.core import geometry

PX = 1.0 / 400.0


def scene(seed: int = 0, n: int = 200, noise_px: float = 0.0) -> tuple[Pair, Pose, NDArray[np.float64]]:
    """Return rays of n points 3 to 8 m away, the pose, and the depths in a."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 8.0], (n, 3))
    pose = Pose(geometry.so3_exp(np.array([0.02, -0.1, 0.05])), np.array([0.3, 0.05, -0.2]))
    moved = points @ pose.rotation.T + pose.translation
    rays = [part[:, :2] / part[:, 2:] + noise_px * PX * rng.normal(size=(n, 2)) for part in (points, moved)]
    return Pair(rays[0], rays[1], 2.0 * PX), pose, points[:, 2]


def test_exact_pose_explains_all() -> None:
    pair, pose, depth = scene()
    assert np.abs(two_view.residuals(pair, pose)).max() < 1e-12
    in_a, in_b, parallax = two_view.depths(pair, pose)
    assert np.abs(in_a - depth).max() < 1e-9
    assert (in_b > 0.0).all()
    assert parallax.min() > 0.0
    assert two_view.share(pair, pose) == 1.0
    assert two_view.share(pair, Pose(pose.rotation, -pose.translation)) < 0.1


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5])
def test_estimate(outliers: float) -> None:
    pair, pose, _ = scene(1, 400, noise_px=0.5)
    rng = np.random.default_rng(2)
    bad = rng.random(len(pair)) < outliers
    b = np.where(bad[:, None], pair.b + rng.uniform(-0.2, 0.2, pair.b.shape), pair.b)
    found = two_view.estimate(Pair(pair.a, b, pair.gate))
    assert found is not None
    assert found.turned_from(pose) < 0.25
    assert found.direction_from(pose) < 2.0


def test_sampson_distance_is_that_of_the_nearest_rays() -> None:
    """To first order it is the length of the smallest change of both rays that makes them meet."""
    pair, pose, _ = scene(3, 1)
    moved = Pair(pair.a + 1e-5, pair.b, pair.gate)
    residual = two_view.residuals(moved, pose)[0]
    step = 1e-7
    gradient = []
    for i in range(4):
        shift = np.zeros((2, 1, 2))
        shift[i // 2, 0, i % 2] = step
        other = Pair(moved.a + shift[0], moved.b + shift[1], pair.gate)
        gradient.append((two_view.residuals(other, pose)[0] - residual) / step)
    assert abs(np.linalg.norm(gradient) - 1.0) < 1e-3


def test_rotation_alone_keeps_the_direction() -> None:
    pair, pose, _ = scene(4, 300, noise_px=0.3)
    start = Pose(geometry.so3_exp(np.array([0.0, 0.02, 0.0])) @ pose.rotation, pose.translation)
    found = two_view.refined(pair, start, free=3)
    assert found.turned_from(pose) < 0.1
    assert found.direction_from(pose) < 1e-9


def test_too_few() -> None:
    pair, _, _ = scene(5, two_view.MIN_PAIRS - 1)
    assert two_view.estimate(pair) is None


def test_nonsense_gives_none_or_few() -> None:
    rng = np.random.default_rng(6)
    pair = Pair(rng.normal(size=(60, 2)), rng.normal(size=(60, 2)), PX)
    found = two_view.estimate(pair)
    assert found is None or two_view.share(pair, found) < 0.5
    same = Pair(pair.a, pair.a, PX)
    found = two_view.estimate(same)
    assert found is None or found.turned_from(Pose(np.eye(3), np.zeros(3))) < 0.5
