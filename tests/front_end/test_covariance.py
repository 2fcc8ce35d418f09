# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""How sure steps are said to be."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.estimate import Transform
from ba_node.front_end.covariance import Lengths


@pytest.mark.parametrize(("scatter", "told"), [(0.0, 0.0), (0.003, 0.0), (0.03, 0.03)])
def test_how_lengths_of_an_odometry_scatter_is_learned(scatter: float, told: float) -> None:
    """Beyond what images are unsure by, and not by what they all differ by."""
    rng, lengths = np.random.default_rng(2), Lengths()
    before, step = Transform(np.eye(3), np.zeros(3)), np.array([0.0, 0.1, 1.0])
    assert lengths.noise == 0.02
    for share in 1.01 + scatter * rng.standard_normal(30):
        after = [Transform(np.eye(3), -length * step) for length in (1.0, share)]
        lengths.compare(before, *after)
    assert lengths.noise == pytest.approx(told, abs=0.25 * told + 0.001)
