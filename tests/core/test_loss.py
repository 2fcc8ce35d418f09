# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Losses by their formulas, and the surrogates that lead up to the truncated quadratic."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.core.loss import LOSSES, evaluate

NORM = np.linspace(0.0, 12.0, 1201)
GRADUATIONS = [np.inf, 1e-3, 0.3, 1.0, 10.0, 1e3]


@pytest.mark.parametrize("graduation", GRADUATIONS)
@pytest.mark.parametrize("loss", list(LOSSES))
def test_weight_is_the_slope_of_the_cost(loss: str, graduation: float) -> None:
    """w = Psi'(x) / (2 x) (4.23), by central differences away from the edges."""
    x, h = NORM[1:] + 0.0031, 1e-6
    plus, minus = (evaluate(loss, x + s * h, 2.0, graduation)[0] for s in (1.0, -1.0))
    slope = (plus - minus) / (2 * h) / (2 * x)
    _, weight = evaluate(loss, x, 2.0, graduation)
    assert np.abs(slope - weight).max() < 1e-6, f"{loss}: {np.abs(slope - weight).max():.1e}"


@pytest.mark.parametrize("loss", list(LOSSES))
def test_weights_are_in_the_unit_interval_and_costs_rise(loss: str) -> None:
    cost, weight = evaluate(loss, NORM, 2.0)
    assert cost[0] == 0.0 and weight[0] == 1.0
    assert np.all(weight >= 0.0) and np.all(weight <= 1.0)
    assert np.all(np.diff(cost) >= 0.0)
    near = NORM < 0.02
    np.testing.assert_allclose(cost[near], NORM[near] ** 2, rtol=1e-3)
    huge, light = evaluate(loss, np.array([1e150]), 2.0)
    assert np.isfinite(huge).all() and np.isfinite(light).all()


def test_surrogates_lie_below_the_loss_and_become_it() -> None:
    cost, _ = evaluate("truncated_quadratic", NORM, 2.0)
    before = np.zeros_like(cost)
    for mu in GRADUATIONS[1:]:
        surrogate, weight = evaluate("truncated_quadratic", NORM, 2.0, mu)
        assert np.all(surrogate <= cost + 1e-12) and np.all(surrogate >= before - 1e-12)
        assert np.all(weight >= 0.0) and np.all(weight <= 1.0)
        before = surrogate
    assert np.abs(before - cost).max() < 1e-2
    # Nearly convex at first: even far out it pulls.
    assert np.all(evaluate("truncated_quadratic", NORM, 2.0, 1e-3)[1] > 0.0)


def test_unknown_loss_lists_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="squared, huber, truncated_quadratic, cauchy, geman_mcclure"):
        evaluate("l1", NORM, 1.0)
