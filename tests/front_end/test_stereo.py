# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Disparities have no bias: between pixels, on slanted ground, where texture is weak, and with another exposure."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from ba_node.front_end import stereo
from ba_node.front_end.frame import soften

SHAPE, FINE = (200, 320), 4


def pair(first: float, slant: tuple[float, float], contrast: float, gain: float = 1.0) -> tuple[Any, Any, Any, Any]:
    """Return two images of a plane, places in the first one, and their true disparities."""
    rng = np.random.default_rng(round(1000 * first))
    h, w = SHAPE
    texture = cv2.GaussianBlur(rng.normal(size=(h * FINE, (w + 120) * FINE)).astype(np.float32), (0, 0), 1.5 * FINE)
    texture = cv2.blur(texture * contrast / texture.std() + 110.0, (FINE, FINE))
    x, y = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
    a, b = slant

    def seen(column: Any) -> Any:
        return cv2.remap(
            texture, ((column + 60.5) * FINE - 0.5).astype(np.float32), ((y + 0.5) * FINE - 0.5).astype(np.float32),
            cv2.INTER_LINEAR,
        )  # fmt: skip

    left = seen(x)
    # d = first + a (x - w/2) + b (y - h/2) in the left image, x_right = x - d.
    right = gain * seen((x + first - a * w / 2 + b * (y - h / 2)) / (1.0 - a))
    both = [np.clip(np.round(image + rng.normal(size=SHAPE) * 1.5), 0, 255).astype(np.uint8) for image in (left, right)]
    grid = np.meshgrid(np.arange(60.0, 280.0, 9.0), np.arange(25.0, 175.0, 9.0))
    uv = np.stack(grid, axis=2).reshape(-1, 2)
    return both[0], both[1], uv, first + a * (uv[:, 0] - w / 2) + b * (uv[:, 1] - h / 2)


CASES = [
    *((f"tenth_{k}", 6.0 + 0.1 * k, (0.0, 0.0), 30.0, 1.0, 0.015, 0.04) for k in range(10)),
    *((f"road_{k}", 16.0 + 0.25 * k, (0.0, 0.33), 30.0, 1.0, 0.015, 0.08) for k in range(4)),
    ("wall", 14.3, (0.2, 0.0), 30.0, 1.0, 0.015, 0.08),
    ("weak_texture", 6.3, (0.0, 0.0), 5.0, 1.0, 0.02, 0.12),
    ("exposure", 6.7, (0.0, 0.1), 30.0, 1.2, 0.015, 0.06),
]


@pytest.mark.parametrize(
    ("first", "slant", "contrast", "gain", "bias", "spread"), [case[1:] for case in CASES], ids=[c[0] for c in CASES]
)
def test_disparities_have_no_bias(
    first: float, slant: tuple[float, float], contrast: float, gain: float, bias: float, spread: float
) -> None:
    left, right, uv, truth = pair(first, slant, contrast, gain)
    start = truth + np.random.default_rng(1).uniform(-1.0, 1.0, len(uv))
    found = stereo.measure(soften(left), soften(right), uv, (start, np.zeros((len(uv), 2))), 21, np.zeros(len(uv)))
    error = (found.value - truth)[found.found]
    assert found.found.mean() > 0.8, f"{found.found.mean():.2f} found"
    assert abs(np.median(error)) < bias, f"bias {np.median(error):+.4f} px"
    assert np.median(np.abs(error)) < spread, f"spread {np.median(np.abs(error)):.4f} px"
    tilt = np.median(found.slant[found.found], axis=0)
    assert np.allclose(tilt, slant, atol=0.01), f"slant {tilt}, expected {slant}"


def test_first_disparities_are_near() -> None:
    left, right, uv, truth = pair(17.3, (0.0, 0.2), 30.0)
    value, slant = stereo.look_up(stereo.dense(left, right, 64, False), uv, 0.5)
    assert np.nanmedian(np.abs(value - truth)) < 0.5
    assert np.median(slant[:, 1]) == pytest.approx(0.2, abs=0.06)


def test_second_camera_on_the_left() -> None:
    left, right, uv, truth = pair(9.4, (0.0, 0.0), 30.0)
    value, _ = stereo.look_up(stereo.dense(right, left, 64, True), uv, 0.5)
    assert np.nanmedian(value + truth) == pytest.approx(0.0, abs=0.6)


def test_another_thing_is_not_found() -> None:
    left, _, uv, truth = pair(6.5, (0.0, 0.0), 30.0)
    _, other, _, _ = pair(7.7, (0.0, 0.0), 30.0)
    found = stereo.measure(soften(left), soften(other), uv, (truth, np.zeros((len(uv), 2))), 21, np.zeros(len(uv)))
    assert found.found.mean() < 0.02
