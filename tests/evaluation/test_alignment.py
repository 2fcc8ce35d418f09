# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ba_node.evaluation.alignment import Alignment, EvaluationError, Kind, align

FloatArray = NDArray[np.float64]


def cloud(seed: int, n: int = 20) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * [3.0, 2.0, 0.5]


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.01, 100.0), n=st.integers(4, 50))
def test_recovers_a_similarity(seed: int, scale: float, n: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    translation = rng.normal(size=3) * 10.0
    points = rng.normal(size=(n, 3))
    found = align(points, scale * points @ rotation.T + translation, "sim3")
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, translation, atol=1e-9 * (10.0 + scale))
    assert found.scale == pytest.approx(scale, rel=1e-9)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_agrees_with_scipy_on_noisy_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = cloud(seed)
    y = Rotation.random(random_state=rng).apply(x) + rng.normal(size=x.shape) * 0.3 + [1.0, 2.0, 3.0]
    expected, _ = Rotation.align_vectors(y - y.mean(axis=0), x - x.mean(axis=0))
    for kind in ("se3", "sim3"):
        np.testing.assert_allclose(align(x, y, kind).rotation, expected.as_matrix(), atol=1e-7)


@pytest.mark.parametrize("kind", ["se3", "sim3"])
def test_no_small_change_does_better(kind: Kind) -> None:
    rng = np.random.default_rng(7)
    x = cloud(1)
    y = 1.7 * Rotation.from_rotvec([0.3, -0.4, 0.9]).apply(x) + rng.normal(size=x.shape) * 0.2
    best = align(x, y, kind)

    def cost(a: Alignment) -> float:
        return float(np.sum((a.apply(x) - y) ** 2))

    for step in (1e-3, -1e-3):
        for axis in np.eye(3):
            turned = Rotation.from_rotvec(step * axis).as_matrix() @ best.rotation
            assert cost(Alignment(turned, best.translation, best.scale)) > cost(best)
            assert cost(Alignment(best.rotation, best.translation + step * axis, best.scale)) > cost(best)
        if kind == "sim3":
            assert cost(Alignment(best.rotation, best.translation, best.scale + step)) > cost(best)


@pytest.mark.parametrize("kind", ["se3", "sim3"])
def test_a_mirror_image_is_not_answered_with_a_reflection(kind: Kind) -> None:
    x = cloud(2)
    found = align(x, x * [1.0, 1.0, -1.0], kind)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)


def test_points_in_a_plane_are_aligned() -> None:
    x = cloud(3) * [1.0, 1.0, 0.0]
    rotation = Rotation.from_euler("xyz", [0.4, -1.0, 2.0])
    found = align(x, rotation.apply(x) + 5.0, "se3")
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-9)
    assert found.scale == 1.0


def test_none_changes_nothing() -> None:
    x = cloud(4, n=1)
    np.testing.assert_array_equal(align(x, x + 1.0, "none").apply(x), x)


def line(n: int) -> FloatArray:
    return np.outer(np.arange(n), [1.0, 2.0, -0.5])


@pytest.mark.parametrize(
    ("estimate", "reference", "message"),
    [
        (cloud(0, 2), cloud(1, 2), "2 points cannot be aligned"),
        (np.ones((5, 3)), cloud(1, 5), "5 points of the estimate lie in one place"),
        (cloud(1, 5), line(5), "5 points of the reference lie on one straight line"),
        (cloud(1, 5), cloud(1, 6), r"shape \(6, 3\)"),
        (cloud(1, 5), np.full((5, 3), np.nan), "point 0 of the reference is not finite"),
        (1e160 * cloud(1, 5), cloud(1, 5), "point 0 of the estimate is not finite or beyond 1e12 m"),
    ],
)
def test_what_cannot_be_aligned_is_refused(estimate: FloatArray, reference: FloatArray, message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        align(estimate, reference, "se3")


def test_crossed_planes_have_no_unique_rotation() -> None:
    # Both spread in a plane, but what varies in one does not vary with what varies in the other.
    x = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    y = np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    with pytest.raises(EvaluationError, match="share no plane"):
        align(x, y, "se3")


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(EvaluationError, match="choose one of none, se3, sim3"):
        align(cloud(0), cloud(0), "affine")  # type: ignore[arg-type]
