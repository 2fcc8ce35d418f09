# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""An image that comes again is turned away where the front-end has moved, and only there."""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.measurements import FeatureTracks
from ba_node.scene.still_images import StillImages

EYE, HERE = np.eye(3), np.zeros(3)


def ahead(by_m: float) -> FloatArray:
    return np.array([by_m, 0.0, 0.0])


def image(keyframe: int, uv: FloatArray, camera: int = 0) -> FeatureTracks:
    return FeatureTracks(0, keyframe, camera, np.arange(len(uv), dtype=np.uint64), uv)


def pixels(count: int = 40, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(0.0, 600.0, (count, 2)).astype(np.float32).astype(np.float64)


def test_the_same_image_after_a_step_is_none() -> None:
    still, uv = StillImages(), pixels()
    assert not still.why(image(0, uv), EYE, HERE)
    words = still.why(image(1, uv), EYE, ahead(0.5))
    assert "camera 0 in keyframe 1 sees exactly what it saw in keyframe 0" in words and "moved by 0.5 m" in words
    # Each is held against the one that came first, not against the one before.
    assert "keyframe 0" in still.why(image(2, uv), EYE, ahead(0.55))
    turned = geometry.so3_exp(np.array([0.0, 0.0, 0.1]))
    assert "5.7 deg" in StillImages().why(image(0, uv), EYE, HERE) + still.why(image(3, uv), turned, HERE)


def test_steps_that_are_small_add_up() -> None:
    still, uv = StillImages(), pixels()
    found = [bool(still.why(image(k, uv), EYE, ahead(0.03 * k))) for k in range(8)]
    assert found == [False] * 4 + [True] * 4


def test_a_body_that_stands_may_see_the_same() -> None:
    still, uv = StillImages(), pixels()
    assert not any(still.why(image(k, uv), EYE, ahead(0.001 * k)) for k in range(20))


def test_noise_of_the_last_digits_is_a_new_image() -> None:
    """As that of any camera; a few points at the border that stay, and images that share few points, say nothing."""
    still, uv = StillImages(), pixels()
    for k in range(5):
        now = uv + 1e-3 * np.random.default_rng(k).normal(size=uv.shape)
        now[:20] = uv[:20]
        assert not still.why(image(k, now), EYE, ahead(0.5 * k))
    few = StillImages()
    assert not any(few.why(image(k, uv[:9]), EYE, ahead(0.5 * k)) for k in range(5))


def test_each_camera_by_itself() -> None:
    still, uv = StillImages(), pixels()
    for k in range(4):
        at = ahead(0.5 * k)
        assert not still.why(image(k, pixels(seed=k)), EYE, at)
        assert bool(still.why(image(k, uv, camera=1), EYE, at)) == (k > 0)
