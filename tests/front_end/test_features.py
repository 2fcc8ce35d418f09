# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""New corners keep apart from those that are followed, and the weaker ones from the stronger."""

from __future__ import annotations

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
