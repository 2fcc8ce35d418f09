# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core import cameras, geometry, objective, triangulation
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.core.triangulation import Rays, errors, parallax, rays_of, triangulate

both = pytest.mark.parametrize(
    "backend",
    ["numpy", pytest.param("native", marks=pytest.mark.skipif(native.kernels is None, reason="no C++ kernels built"))],
)
_OFFSET = np.array([4.0e5, 5.0e6, 100.0])


def make_problem(seed: int, n_kf: int = 4, n_pt: int = 30, noise_px: float = 0.0, offset: float = 0.0) -> Problem:
    """Return a body with a plumb_bob and an equidistant camera that sees points 5 to 20 m ahead, at the true state."""
    rng = np.random.default_rng(seed)
    models = [
        cameras.parameters("plumb_bob", np.array([400.0, 410, 320, 240]), np.array([-0.1, 0.02, 1e-3, -1e-3, 0])),
        cameras.parameters("equidistant", np.array([300.0, 300, 320, 240]), np.array([0.01, -0.005, 0.001, 0])),
    ]
    rig = Cameras(
        geometry.so3_exp(rng.normal(0, 0.05, (2, 3))),
        np.array([[0.0, 0, 0], [-0.5, 0, 0]]),
        np.array([m for m, _ in models], np.uint8),
        np.stack([p for _, p in models]),
    )
    rotation = geometry.so3_exp(rng.normal(0, 0.05, (n_kf, 3)))
    position = rng.normal(0, 1.0, (n_kf, 3)) + offset * _OFFSET
    points = rng.uniform([-4, -3, 5], [4, 3, 20], (n_pt, 3)) + offset * _OFFSET
    state = State(*geometry.inverse(rotation, position), points, np.empty((0, 3)))
    point, keyframe, camera = (a.ravel() for a in np.meshgrid(range(n_pt), range(n_kf), range(2), indexing="ij"))
    n = len(point)
    empty = Observations(keyframe, camera, point, np.zeros((n, 2)), np.ones(n), np.empty(0), np.empty(0))
    problem = Problem(state, np.zeros(n_kf, bool), rig, empty)
    uv = objective.reprojection_errors(problem, state) + noise_px * rng.normal(size=(n, 2))
    return dataclasses.replace(problem, observations=dataclasses.replace(empty, uv=uv))


def take(problem: Problem, rows: np.ndarray) -> Problem:
    obs = problem.observations
    parts = {f.name: getattr(obs, f.name) for f in dataclasses.fields(obs)}
    return dataclasses.replace(
        problem, observations=Observations(**{k: v[rows] if len(v) else v for k, v in parts.items()})
    )


@both
def test_without_rays_no_point_has_a_place(backend: str) -> None:
    none = rays_of(make_problem(1)).part(np.zeros(240, bool))
    found = triangulate(none, 2, backend)
    assert np.isnan(found.points).all()
    assert not found.measured.any()


@both
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_exact_rays_give_the_exact_point(backend: str, offset: float) -> None:
    problem = make_problem(1, offset=offset)
    found = triangulate(rays_of(problem), problem.n_points, backend)
    error = np.abs(found.points - problem.start.points).max()
    assert error < (1e-6 if offset else 1e-9), f"largest error {error:.2e} m"


@both
def test_noise_is_weighed_close_to_the_reprojection_optimum(backend: str) -> None:
    problem = make_problem(2, noise_px=0.5)
    points = triangulate(rays_of(problem), problem.n_points, backend).points
    cost = _cost(problem, points)
    rng = np.random.default_rng(0)
    # No nearby point is clearly better: the algebraic minimum is the reprojection minimum to within 2 %.
    for size in (0.003, 0.01, 0.03):
        for _ in range(20):
            moved = _cost(problem, points + size * rng.normal(size=points.shape))
            share = np.min(moved / cost)
            assert share > 0.98, f"a step of {size} m lowers the cost of a point to {share:.3f} of it"


def _cost(problem: Problem, points: np.ndarray) -> np.ndarray:
    error = objective.reprojection_errors(problem, dataclasses.replace(problem.start, points=points))
    return np.bincount(problem.observations.point, np.sum(error * error, axis=1))


def test_parallax_of_two_views_is_the_angle_between_the_rays() -> None:
    problem = make_problem(3)
    two = take(problem, (problem.observations.camera == 0) & (problem.observations.keyframe < 2))
    rays = rays_of(two)
    d = rays.direction.reshape(-1, 2, 3)
    expected = np.arctan2(np.linalg.norm(np.cross(d[:, 0], d[:, 1]), axis=1), np.sum(d[:, 0] * d[:, 1], axis=1))
    np.testing.assert_allclose(parallax(rays, problem.n_points), expected, rtol=1e-9)


def test_parallax_of_many_views_is_at_least_half_the_largest_angle() -> None:
    problem = make_problem(4, n_kf=6)
    rays = rays_of(problem)
    d = rays.direction.reshape(problem.n_points, -1, 3)
    largest = np.arccos(np.clip(d @ np.swapaxes(d, 1, 2), -1, 1)).max(axis=(1, 2))
    found = parallax(rays, problem.n_points)
    assert (found <= largest + 1e-7).all()
    assert (found >= 0.5 * largest).all(), f"smallest share {np.min(found / largest):.3f}"


@both
def test_a_measured_depth_places_a_point_from_one_view(backend: str) -> None:
    problem = make_problem(5)
    first = take(problem, (problem.observations.camera == 0) & (problem.observations.keyframe == 0))
    depth = objective.Objective(first, SolverOptions()).in_camera(first.start)[:, 2]
    obs = dataclasses.replace(first.observations, depth_m=depth, depth_sigma_m=0.02 * depth)
    found = triangulate(rays_of(dataclasses.replace(first, observations=obs)), problem.n_points, backend)
    assert found.measured.all()
    error = np.abs(found.points - problem.start.points).max()
    assert error < 1e-9, f"largest error {error:.2e} m"


@both
def test_one_view_without_depth_gives_no_point_and_others_are_not_disturbed(backend: str) -> None:
    problem = make_problem(6)
    obs = problem.observations
    keep = (obs.point != 3) | ((obs.keyframe == 0) & (obs.camera == 0))
    found = triangulate(rays_of(take(problem, keep & (obs.point != 5))), problem.n_points, backend)
    assert np.isnan(found.points[[3, 5]]).all()
    assert found.parallax_rad[3] == 0.0
    others = np.setdiff1d(np.arange(problem.n_points), [3, 5])
    assert np.abs(found.points[others] - problem.start.points[others]).max() < 1e-9


def test_pixels_outside_the_lens_are_left_out() -> None:
    problem = make_problem(7)
    uv = problem.observations.uv.copy()
    # plumb_bob with k1 < 0 folds back far out: no ray goes through this pixel.
    uv[0] = (1e6, 1e6)
    rays = rays_of(dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, uv=uv)))
    assert len(rays.point) in (len(uv) - 1, len(uv))
    assert np.isfinite(rays.direction).all()


@both
@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 50.0))
def test_any_rays_give_finite_points_or_nan_marks(backend: str, seed: int, noise_px: float) -> None:
    problem = make_problem(seed, n_kf=3, n_pt=5, noise_px=noise_px)
    found = triangulate(rays_of(problem), problem.n_points, backend)
    assert np.isfinite(found.points).all()
    assert np.isfinite(found.parallax_rad).all()


@both
def test_identical_rays_do_not_raise(backend: str) -> None:
    problem = make_problem(8)
    rays = rays_of(take(problem, (problem.observations.camera == 0) & (problem.observations.keyframe == 0)))
    rows = np.repeat(np.arange(len(rays.point)), 2)
    twice = dataclasses.replace(rays, **{f.name: getattr(rays, f.name)[rows] for f in dataclasses.fields(rays)})
    found = triangulate(twice, problem.n_points, backend)
    assert np.isfinite(found.points).all()
    assert found.parallax_rad.max() == 0.0


@pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_kernels_agree(offset: float) -> None:
    problem = make_problem(9, n_pt=200, noise_px=2.0, offset=offset)
    rng = np.random.default_rng(9)
    depth = objective.Objective(problem, SolverOptions()).in_camera(problem.start)[:, 2]
    depth *= np.where(rng.random(len(depth)) < 0.1, rng.uniform(0.9, 1.1, len(depth)), np.nan)
    obs = dataclasses.replace(problem.observations, depth_m=depth, depth_sigma_m=0.02 * depth)
    # One to eight views of each, and some with none; rays in any order.
    kept = rng.random(len(obs)) < rng.random(200)[obs.point]
    rays = rays_of(take(dataclasses.replace(problem, observations=obs), rng.permutation(np.flatnonzero(kept))))
    ours, oracle = triangulate(rays, 200, "native"), triangulate(rays, 200, "numpy")
    np.testing.assert_array_equal(ours.measured, oracle.measured)
    np.testing.assert_allclose(ours.parallax_rad, oracle.parallax_rad, rtol=1e-12, atol=1e-12)
    wide = np.isnan(oracle.points[:, 0]) | oracle.measured | (oracle.parallax_rad > 0.01)
    assert np.count_nonzero(wide) > 150
    np.testing.assert_allclose(ours.points[wide], oracle.points[wide], rtol=1e-9, atol=1e-7)


def test_pieces_of_many_observations_give_the_same_to_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem(seed=9, noise_px=0.5)
    whole = rays_of(problem)
    error = errors(whole, problem.start.points)
    monkeypatch.setattr(triangulation, "_AT_ONCE", 7)
    pieces = rays_of(problem)
    for field in dataclasses.fields(whole):
        np.testing.assert_allclose(getattr(pieces, field.name), getattr(whole, field.name), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(errors(pieces, problem.start.points), error, rtol=1e-9)


def test_a_point_does_not_depend_on_those_it_is_worked_on_with() -> None:
    """Points of 2 to 40 views, in any order: each as if it were alone, to the last bit."""
    if native.kernels is None:
        pytest.skip("no C++ kernels built")
    rng = np.random.default_rng(8)
    views = rng.integers(2, 40, 100)
    point = np.repeat(np.arange(100), views)
    place = rng.uniform([-2, -2, 5], [2, 2, 10], (100, 3))
    centre = rng.uniform(-1.0, 1.0, (len(point), 3))
    away = place[point] - centre + rng.normal(0.0, 0.02, (len(point), 3))
    direction = away / np.linalg.norm(away, axis=1, keepdims=True)
    none = np.full(len(point), np.nan)
    rays = Rays(point, centre, direction, np.full(len(point), 500.0), none, none)
    together = triangulate(rays, 100)
    for k in range(100):
        own = rays.part(point == k)
        alone = triangulate(dataclasses.replace(own, point=np.zeros(len(own.point), np.intp)), 1)
        for all_of_them, one in zip(vars(together).values(), vars(alone).values(), strict=True):
            np.testing.assert_array_equal(all_of_them[k], one[0], err_msg=f"point {k} of {views[k]} views")


def test_symmetric_systems_are_solved_column_by_column() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(50, 3, 3))
    matrix, rhs = root @ np.swapaxes(root, 1, 2), rng.normal(size=(50, 3))
    matrix[-1], rhs[-1] = 0.0, 0.0
    entries = np.stack([matrix[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))])
    found = triangulation._solved(entries, rhs.T)
    expected = np.linalg.solve(matrix[:-1], rhs[:-1, :, None])[..., 0]
    np.testing.assert_allclose(found[:-1], expected, rtol=1e-7)
    np.testing.assert_array_equal(found[-1], np.zeros(3), err_msg="nothing tells where a point without rays is")
