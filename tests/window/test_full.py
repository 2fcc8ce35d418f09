# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a solve of everything that need no back-end."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.config import Config
from ba_node.window import full


def test_scale_of_a_keyframe_is_the_median_over_its_points() -> None:
    rng = np.random.default_rng(5)
    group = rng.integers(0, 50, size=400)
    group[group == 7] = 8
    group[:2], group[2:5] = 60, 61
    values = rng.normal(1.0, 0.1, size=400)
    expected = np.ones(70)
    for k in np.unique(group):
        if np.count_nonzero(group == k) >= 3:
            expected[k] = np.median(values[group == k])
    assert np.count_nonzero(expected != 1.0) > 45
    assert expected[60] == 1.0
    np.testing.assert_array_equal(full._medians(values, group, 70), expected)


def test_a_method_that_is_asked_for_brings_its_own_loss_and_all_stop_late() -> None:
    config = Config().with_values({"solver.loss": "cauchy"}).solver
    found = {method: full.options(config, method) for method in ("", "local_dinm", "irls_huber", "irls_tq")}
    losses = {method: options.loss for method, options in found.items()}
    assert losses == {
        "": "cauchy", "local_dinm": "cauchy", "irls_huber": "huber", "irls_tq": "truncated_quadratic"
    }  # fmt: skip
    assert found["irls_tq"].annealing == "gnc" and found[""].annealing == "none"
    assert {options.function_tolerance for options in found.values()} == {1e-6}
    given = dataclasses.replace(config, function_tolerance=1e-9)
    assert full.options(given).function_tolerance == 1e-9
