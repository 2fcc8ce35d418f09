# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""New corners are the best of their cells, keep apart from those that are there, and weaker from stronger ones."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from ba_node.front_end import features


@pytest.mark.parametrize("taken", [0, 120])
def test_corners_keep_apart(taken: int) -> None:
    """As every pair of them, one by one, says; between new ones the distance itself is enough."""
    rng = np.random.default_rng(6)
    found = rng.integers(0, 200, (150, 2)).astype(np.float64)
    followed = rng.integers(0, 200, (taken, 2)).astype(np.float64)
    distance = 10.0
    free = [uv for uv in found if all(np.hypot(*(uv - other)) > distance for other in followed)]
    expected = [uv for i, uv in enumerate(free) if all(np.hypot(*(uv - other)) >= distance for other in free[:i])]
    assert 0 < len(expected) < len(free)
    assert np.array_equal(features._apart(found, followed, distance), expected)
    assert not len(features._apart(found, found, distance))


@pytest.mark.parametrize("border", [1, 12])
def test_corners_are_the_best_of_their_cells(border: int) -> None:
    """As one look at the whole image says, cell by cell."""
    rng = np.random.default_rng(7)
    image: Any = cv2.GaussianBlur(rng.integers(0, 256, (190, 260), np.uint8), (0, 0), 2.0)
    allowed = rng.random(image.shape) > 0.3
    allowed[60:120, 100:180] = False
    count = 150
    strength = np.where(allowed, cv2.cornerMinEigenVal(image, features._BLOCK, ksize=3), 0.0)
    side = int(np.sqrt(allowed.sum() / (1.6 * count)))
    best = set()
    for top in range(border, 190 - border - side + 1, side):
        for left in range(border, 260 - border - side + 1, side):
            cell = strength[top : top + side, left : left + side]
            row, column = np.unravel_index(int(cell.argmax()), cell.shape)
            if cell.max() > features._WEAKEST:
                best.add((left + int(column), top + int(row)))
    found = {(int(x), int(y)) for x, y in features.corners(image, allowed, np.empty((0, 2)), count, border)}
    assert 50 < len(found) <= count
    assert found <= best
