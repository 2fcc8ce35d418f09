# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Projection against its definition, derivatives against differences, and the way back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.core import cameras

K = np.array([500.0, 510.0, 320.0, 240.0])
COEFFICIENTS = {
    "plumb_bob": np.array([-0.3, 0.1, 1e-3, -2e-3, 0.01]),
    "rational_polynomial": np.array([0.3, 0.1, 1e-3, -2e-3, 0.01, 0.2, 0.05, 0.01]),
    "equidistant": np.array([0.01, -0.02, 3e-3, 1e-3]),
}
MODELS = list(COEFFICIENTS)


def rows(name: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return model and parameters of n equal cameras."""
    model, params = cameras.parameters(name, K, COEFFICIENTS[name])
    return np.full(n, model, np.uint8), np.tile(params, (n, 1))


def points(n: int, seed: int = 0) -> np.ndarray:
    """Return points in front of a camera."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.normal(0.0, 0.6, (n, 2)), rng.uniform(1.5, 4.0, n)])


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_agree_with_central_differences(name: str) -> None:
    x, h = points(60), 1e-6
    model, params = rows(name, 60)
    uv, d_x, d_i = cameras.project_jacobian(x, model, params)
    np.testing.assert_allclose(uv, cameras.project(x, model, params), atol=1e-12)
    for j, axis in enumerate(np.eye(3)):
        numeric = (cameras.project(x + h * axis, model, params) - cameras.project(x - h * axis, model, params)) / (
            2 * h
        )
        np.testing.assert_allclose(d_x[:, :, j], numeric, atol=1e-6)
    for j, column in enumerate((4, 5), start=1):
        step = h * np.eye(cameras.N_PARAMS)[column]
        numeric = (cameras.project(x, model, params + step) - cameras.project(x, model, params - step)) / (2 * h)
        np.testing.assert_allclose(d_i[:, :, j], numeric, atol=1e-6)


def test_focal_derivative_is_the_distorted_ray() -> None:
    x = points(10)
    model, params = rows("plumb_bob", 10)
    _, _, d_i = cameras.project_jacobian(x, model, params)
    uv = cameras.project(x, model, params)
    np.testing.assert_allclose(d_i[:, :, 0] * K[:2] + K[2:], uv, atol=1e-10)


@pytest.mark.parametrize("name", MODELS)
@given(st.integers(0, 10_000))
def test_normalise_inverts_project(name: str, seed: int) -> None:
    x = points(8, seed)
    x[:, :2] = np.clip(x[:, :2], -1.0, 1.0)
    model, params = rows(name, 8)
    ray = cameras.normalise(cameras.project(x, model, params), model, params)
    np.testing.assert_allclose(ray, x[:, :2] / x[:, 2:], atol=1e-8)


def test_equidistant_is_smooth_at_the_optical_axis() -> None:
    x = np.array([[0.0, 0.0, 1.0], [1e-9, 0.0, 1.0], [1e-5, 0.0, 1.0]])
    model, params = rows("equidistant", 3)
    uv, d_x, _ = cameras.project_jacobian(x, model, params)
    np.testing.assert_allclose(uv[:, 0], K[2] + K[0] * x[:, 0], atol=1e-9)
    np.testing.assert_allclose(d_x[:, 0, 0], K[0], rtol=1e-9)


def test_models_can_be_mixed() -> None:
    x = points(2)
    pairs = [rows(name, 2) for name in ("plumb_bob", "equidistant")]
    model = np.array([pairs[0][0][0], pairs[1][0][1]])
    params = np.stack([pairs[0][1][0], pairs[1][1][1]])
    mixed = cameras.project(x, model, params)
    np.testing.assert_array_equal(mixed[0], cameras.project(x, *pairs[0])[0])
    np.testing.assert_array_equal(mixed[1], cameras.project(x, *pairs[1])[1])


@pytest.mark.parametrize("name", MODELS)
def test_one_row_of_parameters_serves_all_points(name: str) -> None:
    x = points(7)
    model, params = rows(name, 7)
    for one, all_rows in zip(
        cameras.project_jacobian(x, model[:1], params[:1]), cameras.project_jacobian(x, model, params), strict=True
    ):
        np.testing.assert_array_equal(one, all_rows)
    assert cameras.project_jacobian(x, model, params, intrinsics=False)[2].shape == (7, 2, 0)


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_derivatives_by_the_point_do_not_depend_on_what_else_is_wanted(scale: float) -> None:
    x = points(7)
    model, params = rows("plumb_bob", 7)
    params[:, cameras.DISTORTION] *= scale
    uv, d_x, _ = cameras.project_jacobian(x, model, params, intrinsics=False)
    for one, other in zip((uv, d_x), cameras.project_jacobian(x, model, params), strict=False):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(uv, cameras.project(x, model, params), rtol=1e-14)


def test_six_parameters_are_enough_for_radial_distortion() -> None:
    x = points(7)
    model, params = rows("plumb_bob", 7)
    params[:, 6:] = 0.0
    for short, whole in zip(
        cameras.project_jacobian(x, model, params[:, :6]), cameras.project_jacobian(x, model, params), strict=True
    ):
        np.testing.assert_array_equal(short, whole)


def test_pixels_without_a_ray_are_nan() -> None:
    """A strong barrel distortion folds over: beyond its largest radius nothing projects."""
    model, params = cameras.parameters("plumb_bob", K, np.array([-0.3, 0.0, 0.0, 0.0]))
    far = cameras.normalise(np.array([[5000.0, 240.0]]), np.array([model], np.uint8), params[None])
    assert np.isnan(far).all()


def test_zeros_beyond_the_model_and_an_empty_name_are_let_pass() -> None:
    model, params = cameras.parameters("rational_polynomial", K, np.arange(14.0) * (np.arange(14) < 8))
    np.testing.assert_array_equal(params[4:], np.arange(8.0))
    assert model == cameras.Model.RATIONAL
    _, undistorted = cameras.parameters("", K, np.zeros(5))
    np.testing.assert_array_equal(undistorted, [*K, *np.zeros(8)])


@pytest.mark.parametrize(
    ("name", "k", "d", "words"),
    [
        ("thin_prism", K, [], "thin_prism"),
        ("", K, [0.1, 0.0, 0.0, 0.0], "distortion_model '' is not supported: choose one of"),
        ("rational_polynomial", K, [0.1] * 12, "12 coefficients"),
        ("plumb_bob", K, [0.1, 0.2, 0.3], "3 coefficients"),
        ("plumb_bob", [0.0, 500.0, 1.0, 1.0], [], "focal"),
        ("plumb_bob", [np.nan, 500.0, 1.0, 1.0], [], "not finite"),
        ("equidistant", K, [0.1, 0.2, np.inf, 0.0], "not finite"),
    ],
)
def test_bad_cameras_are_refused_by_name(name: str, k: list[float], d: list[float], words: str) -> None:
    with pytest.raises(cameras.CameraError, match=words):
        cameras.parameters(name, np.asarray(k), np.asarray(d))


def _turning_point(name: str, d: list[float]) -> tuple[float, float]:
    """Return the radius where widest() says that a distortion folds, and where the projection itself turns back."""
    model, params = cameras.parameters(name, np.array([1.0, 1.0, 0.0, 0.0]), np.array(d))
    top = np.deg2rad(88.5)
    angle = np.linspace(1e-3, top, 20_001)
    x = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    u = cameras.project(x, np.array([model], np.uint8), params[None])[:, 0]
    back = np.flatnonzero(np.diff(u) <= 0.0)
    return cameras.widest(model, params), float(u[back[0]]) if len(back) else np.inf


@pytest.mark.parametrize(
    ("name", "d"),
    [
        ("plumb_bob", [-0.5, 0.0, 0.0, 0.0]),
        ("plumb_bob", [-0.3, 0.1, 0.0, 0.0, -0.05]),
        ("rational_polynomial", [0.5, -0.2, 0.0, 0.0, -0.01, 0.9, 0.1, 0.0]),
        ("equidistant", [-0.2, 0.0, 0.0, 0.0]),
        ("equidistant", [0.01, -0.05, 0.0, -0.02]),
    ],
)
def test_where_a_distortion_folds_over(name: str, d: list[float]) -> None:
    said, found = _turning_point(name, d)
    assert np.isfinite(found)
    assert said == pytest.approx(found, rel=1e-4)


def test_sound_distortions_do_not_fold() -> None:
    assert _turning_point("plumb_bob", [0.1, 0.02, 0.0, 0.0]) == (np.inf, np.inf)
    assert _turning_point("equidistant", [0.01, 0.001, 0.0, 0.0]) == (np.inf, np.inf)
    assert _turning_point("plumb_bob", [0.0] * 5) == (np.inf, np.inf)


def around(n: int, widest_deg: float, seed: int = 0) -> np.ndarray:
    """Return points all around a camera, up to an angle from its axis."""
    rng = np.random.default_rng(seed)
    angle = np.deg2rad(widest_deg) * np.sqrt(rng.random(n))
    turn, distance = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(0.5, 8.0, n)
    ray = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    return ray * distance[:, None]


def wide(n: int) -> tuple[np.ndarray, np.ndarray]:
    model, params = cameras.parameters("equidistant", K, np.array([0.01, -2e-3, 3e-4, -2e-5]))
    return np.full(n, model, np.uint8), np.tile(params, (n, 1))


def test_a_fisheye_sees_behind_its_image_plane() -> None:
    """By the definition, point by point."""
    x = around(200, 148.0)
    model, params = wide(200)
    assert 50 < np.count_nonzero(x[:, 2] < 0.0) < 180
    assert not cameras.behind(x, model).any()
    for point, uv in zip(x, cameras.project(x, model, params), strict=True):
        angle = np.arccos(point[2] / np.linalg.norm(point))
        k1, k2, k3, k4 = params[0, 4:8]
        radius = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        turn = np.arctan2(point[1], point[0])
        expected = K[:2] * radius * [np.cos(turn), np.sin(turn)] + K[2:]
        np.testing.assert_allclose(uv, expected, rtol=1e-11)


def test_derivatives_beyond_90_degrees_agree_with_central_differences() -> None:
    x, h = around(200, 148.0, seed=1), 1e-6
    model, params = wide(200)
    uv, d_x, d_i = cameras.project_jacobian(x, model, params)
    np.testing.assert_allclose(uv, cameras.project(x, model, params), atol=1e-10)
    for j, axis in enumerate(np.eye(3)):
        there, back = (cameras.project(x + step * axis, model, params) for step in (h, -h))
        np.testing.assert_allclose(d_x[:, :, j], (there - back) / (2 * h), atol=3e-5)
    for j, column in enumerate((4, 5), start=1):
        step = h * np.eye(cameras.N_PARAMS)[column]
        there, back = (cameras.project(x, model, params + sign * step) for sign in (1.0, -1.0))
        np.testing.assert_allclose(d_i[:, :, j], (there - back) / (2 * h), atol=1e-5)


def test_rays_invert_project_all_around() -> None:
    x = around(300, 149.0, seed=2)
    x[0] = (0.0, 0.0, 2.0)
    model, params = wide(300)
    ray = cameras.rays(cameras.project(x, model, params), model, params)
    np.testing.assert_allclose(ray, x / np.linalg.norm(x, axis=1)[:, None], atol=1e-9)
    flat = cameras.normalise(cameras.project(x, model, params), model, params)
    np.testing.assert_array_equal(np.isnan(flat[:, 0]), x[:, 2] < 0.0)


def test_what_a_camera_cannot_see() -> None:
    x = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, -0.5], [0.1, 0.0, -1.0], [0.0, 0.0, 0.0], [1e-9, 0, 0]])
    straight, fisheye = (np.array([model], np.uint8) for model in (0, 1))
    assert cameras.behind(x, straight).tolist() == [False, True, True, True, True, True]
    assert cameras.behind(x, fisheye).tolist() == [False, False, False, True, True, True]
    assert cameras.behind(x[1:3], np.array([0, 1], np.uint8)).tolist() == [True, False]


def test_pixels_outside_the_image_circle_have_no_ray() -> None:
    model, params = wide(2)
    far = np.array([[K[0] * 3.0, 0.0], [5000.0, 0.0]]) + K[2:]
    assert np.isnan(cameras.rays(far, model, params)).all()
