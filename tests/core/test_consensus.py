# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node import native
from ba_node.core import consensus, geometry, triangulation
from ba_node.core.triangulation import Rays

both = pytest.mark.parametrize(
    "backend",
    ["numpy", pytest.param("native", marks=pytest.mark.skipif(native.kernels is None, reason="no C++ kernels built"))],
)
PX_PER_RAD = 500.0
GATE = 6.0


def make_rays(
    seed: int, views: int, points: int = 50, wrong: float = 0.0, step_m: float = 0.5
) -> tuple[Rays, np.ndarray]:
    """Return rays from a line of cameras to points 5 to 10 m away, noise of 1 sigma, and which of them are wrong."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([-2, -2, 5], [2, 2, 10], (points, 3))
    point, view = (a.ravel() for a in np.meshgrid(range(points), range(views), indexing="ij"))
    centre = step_m * view[:, None] * np.array([1.0, 0.0, 0.0])
    away = place[point] - centre
    direction = away / np.linalg.norm(away, axis=1, keepdims=True)
    turn = rng.normal(size=(len(point), 3)) / PX_PER_RAD
    bad = rng.random(len(point)) < wrong
    # 20 to 90 sigmas off.
    axis = np.cross(direction[bad], rng.normal(size=(int(bad.sum()), 3)))
    turn[bad] = rng.uniform(0.04, 0.18, (len(axis), 1)) * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    direction = (geometry.so3_exp(turn) @ direction[:, :, None])[..., 0]
    n = len(point)
    return Rays(point, centre, direction, np.full(n, PX_PER_RAD), np.full(n, np.nan), np.full(n, np.nan)), bad


@both
@pytest.mark.parametrize(("views", "wrong", "lost"), [(12, 0.0, 0.0), (12, 0.4, 0.005), (30, 0.6, 0.01)])
def test_the_right_views_agree_however_many_are_wrong(backend: str, views: int, wrong: float, lost: float) -> None:
    rays, bad = make_rays(1, views, wrong=wrong)
    _, agrees = consensus.triangulate(rays, 50, GATE, backend)
    assert np.mean(~agrees[~bad]) <= lost, f"{np.mean(~agrees[~bad]):.2%} of the right views are lost"
    if bad.any():
        assert np.mean(agrees[bad]) < 0.15, f"{np.mean(agrees[bad]):.2%} of the wrong views are believed"


@both
@pytest.mark.parametrize(("gate", "some_change"), [(1.5, True), (60.0, False)])
def test_points_are_where_all_rays_that_agree_see_them(backend: str, gate: float, some_change: bool) -> None:
    """Some rays of a few points agree with what all others give, and not with the best pair, or the other way round."""
    rays, _ = make_rays(3, 12)
    found, agrees = consensus.triangulate(rays, 51, gate, backend)
    changed = np.unique(rays.point[agrees != consensus.agreeing(rays, 51, gate, backend)])
    assert (0 < len(changed) < 50) == some_change
    of_these = triangulation.triangulate(rays.part(agrees), 51, backend)
    for one, other in zip(vars(found).values(), vars(of_these).values(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.isnan(found.points[50]).all()


@pytest.mark.skipif(native.kernels is None, reason="no C++ kernels built")
@pytest.mark.parametrize("views", [1, 2, 3, 10, 11, 25])
def test_kernels_agree(views: int) -> None:
    rays, _ = make_rays(views, views, wrong=0.4)
    distance = np.where(np.arange(len(rays.point)) % 3 == 0, 7.0, np.nan)
    for measured in (rays.distance_m, distance):
        each = dataclasses.replace(rays, distance_m=measured, distance_sigma_m=0.1 * measured)
        numpy, compiled = (consensus.agreeing(each, 50, GATE, name) for name in ("numpy", "native"))
        np.testing.assert_array_equal(numpy, compiled)
        (found, of_found), (ours, of_ours) = (consensus.triangulate(each, 50, GATE, n) for n in ("numpy", "native"))
        np.testing.assert_array_equal(of_found, of_ours)
        np.testing.assert_array_equal(found.measured, ours.measured)
        np.testing.assert_allclose(ours.points, found.points, rtol=1e-6)


@both
def test_no_point_and_points_without_rays(backend: str) -> None:
    rays, _ = make_rays(0, 2, points=3)
    assert consensus.agreeing(rays, 10, GATE, backend).all()
    assert consensus.agreeing(rays.part(np.zeros(6, bool)), 10, GATE, backend).shape == (0,)


@both
def test_a_standing_camera_agrees_on_a_direction(backend: str) -> None:
    """A mismatch and a right view meet somewhere near, but the others see the point far away."""
    rays, bad = make_rays(3, 6, wrong=0.2, step_m=1e-4)
    agrees = consensus.agreeing(rays, 50, GATE, backend)
    most = np.bincount(rays.point, ~bad, 50)[rays.point] >= 4
    assert agrees[most & ~bad].all()
    assert not agrees[most & bad].any()
