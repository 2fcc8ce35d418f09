# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Group laws, and the closed forms against scipy's rotations, also at the edges: 0, 1e-7, pi."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from ba_node.core import geometry

VECTORS = hnp.arrays(np.float64, (4, 3), elements=st.floats(-2.0, 2.0))
ANGLES = (0.0, 1e-12, 1e-7, 9.9e-5, 1.01e-4, 0.29, 0.31, 1.0, 3.0, np.pi - 1e-7)


def axes(angle: float) -> np.ndarray:
    """Return rotation vectors of one angle about 20 axes."""
    v = np.random.default_rng(1).normal(size=(20, 3))
    return np.asarray(angle * v / np.linalg.norm(v, axis=1, keepdims=True))


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_agrees_with_scipy(angle: float) -> None:
    phi = axes(angle)
    np.testing.assert_allclose(geometry.so3_exp(phi), Rotation.from_rotvec(phi).as_matrix(), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(angle: float) -> None:
    phi = axes(angle)
    np.testing.assert_allclose(geometry.so3_log(geometry.so3_exp(phi)), phi, atol=4e-15, rtol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_right_jacobian_is_the_derivative_of_exp(angle: float) -> None:
    """Exp(phi + d) = Exp(phi) Exp(Jr d), by central differences."""
    phi, h = axes(angle), 1e-5
    analytic = geometry.right_jacobian(phi)
    for axis in np.eye(3):
        plus, minus = geometry.so3_exp(phi + h * axis), geometry.so3_exp(phi - h * axis)
        numeric = (
            geometry.so3_log(np.swapaxes(geometry.so3_exp(phi), 1, 2) @ plus)
            - geometry.so3_log(np.swapaxes(geometry.so3_exp(phi), 1, 2) @ minus)
        ) / (2 * h)
        np.testing.assert_allclose((analytic @ axis[:, None])[..., 0], numeric, atol=1e-9)


@given(VECTORS)
def test_rotations_stay_rotations(phi: np.ndarray) -> None:
    r = geometry.so3_exp(phi)
    np.testing.assert_allclose(r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, atol=1e-14)


@pytest.mark.slow
@given(VECTORS, VECTORS)
def test_quaternions_and_matrices_are_the_same_rotation(phi: np.ndarray, other: np.ndarray) -> None:
    r = geometry.so3_exp(phi) @ geometry.so3_exp(other)
    q = geometry.quaternion_from_matrix(r)
    assert np.all(q[:, 3] >= 0)
    np.testing.assert_allclose(geometry.matrix_from_quaternion(q), r, atol=5e-15)
    np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), r, atol=5e-15)
    np.testing.assert_allclose(geometry.matrix_from_quaternion(3.0 * q), r, atol=5e-15)


def test_half_turns_have_exact_quaternions() -> None:
    for i in range(3):
        r = -np.eye(3)
        r[i, i] = 1.0
        expected = np.zeros(4)
        expected[i] = 1.0
        np.testing.assert_array_equal(np.abs(geometry.quaternion_from_matrix(r)), expected)


@pytest.mark.slow
@given(VECTORS, VECTORS, VECTORS)
def test_rigid_transforms_form_a_group(phi: np.ndarray, t: np.ndarray, u: np.ndarray) -> None:
    r, s = geometry.so3_exp(phi), geometry.so3_exp(u)
    back = geometry.compose(*geometry.inverse(r, t), r, t)
    np.testing.assert_allclose(back[0], np.broadcast_to(np.eye(3), r.shape), atol=1e-14)
    np.testing.assert_allclose(back[1], 0.0, atol=1e-14)
    left = geometry.compose(*geometry.compose(r, t, s, u), s, t)
    right = geometry.compose(r, t, *geometry.compose(s, u, s, t))
    np.testing.assert_allclose(left[0], right[0], atol=1e-14)
    np.testing.assert_allclose(left[1], right[1], atol=1e-13)


def test_nearest_rotation_undoes_a_small_error() -> None:
    r = geometry.so3_exp(axes(1.0))
    noisy = r + 1e-6 * np.random.default_rng(0).normal(size=r.shape)
    repaired = geometry.nearest_rotation(noisy)
    np.testing.assert_allclose(repaired @ np.swapaxes(repaired, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=1e-14)
    np.testing.assert_allclose(repaired, r, atol=1e-5)


@pytest.mark.parametrize("error", [0.0, 1e-15, 1e-12, 1e-9, 1e-7])
def test_nearest_rotation_is_that_of_the_singular_values(error: float) -> None:
    noisy = geometry.so3_exp(axes(2.0)) + error * np.random.default_rng(1).normal(size=(*axes(2.0).shape, 3))
    u, _, vt = np.linalg.svd(noisy)
    np.testing.assert_allclose(geometry.nearest_rotation(noisy), u @ vt, atol=1e-15)


def test_nearest_rotation_of_a_reflection_is_no_reflection() -> None:
    found = geometry.nearest_rotation(np.diag([1.0, 1.0, -1.0])[None])
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-15)
