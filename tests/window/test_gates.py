# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Gates that widen with the bulk of the errors: short cuts give what the plain formula gives."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.window.initial_points import SPREAD, widened


@pytest.mark.parametrize("n", [10, 11, 40, 41])
def test_a_gate_is_that_of_the_median_to_the_last_bit(n: int) -> None:
    rng = np.random.default_rng(n)
    n_wide = 0
    for scale in np.geomspace(0.5, 3.0, 200):
        errors = scale * rng.rayleigh(size=n)
        errors[rng.random(n) < 0.05] = np.inf
        plain = max(6.0, SPREAD * float(np.median(errors)))
        assert widened(6.0, errors) == plain
        n_wide += plain > 6.0
    assert 20 < n_wide < 180, f"{n_wide} of 200 gates are wide: both ways must be taken"


@pytest.mark.parametrize("errors", [[1.0, 2.0], [2.0, 1.0], [1.0, 1.0], [0.0, 3.0]])
def test_a_median_at_the_gate(errors: list[float]) -> None:
    gate = SPREAD * float(np.median(errors))
    assert widened(gate, np.array(errors), 1) == gate
    below = float(np.nextafter(gate, 0.0))
    assert widened(below, np.array(errors), 1) == gate


def test_few_errors_widen_nothing() -> None:
    assert widened(6.0, np.full(9, 100.0)) == 6.0
    assert widened(6.0, np.empty(0), 1) == 6.0
