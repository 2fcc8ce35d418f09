# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every named method on the five spheres of the thesis ends with a finite result and a reason, and never rises.

Ladybug-49 and dubrovnik-3-7 are in tests/core/test_methods.py. One step of lma_cd on the largest takes minutes in
numpy: what it comes to with the C++ kernels is recorded for Table 5.4.
"""

from __future__ import annotations

import functools
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from ba_node.core.methods import METHODS
from ba_node.core.problem import Problem
from ba_node.core.result import Status
from ba_node.core.solver import solve
from ba_node.io.bal import to_problem
from ba_node.offline.solver_settings import solver_options
from experiments.thesis.sphere import generate_sphere
from experiments.thesis.sphere_file import start_of
from experiments.thesis.sphere_options import PRESETS

ITERATIONS = {"10-253": 50, "10-289": 50, "50-1000": 6, "100-4000": 1, "500-5000": 1}
LARGE = ("100-4000", "500-5000")
RECORDED = Path(__file__).resolve().parents[3] / "docs" / "thesis_results.json"
GRID = [
    pytest.param(size, method, marks=pytest.mark.slow if size in LARGE else ())
    for size in PRESETS
    for method in METHODS
    if (size, method) != ("500-5000", "lma_cd")
]


@functools.lru_cache(maxsize=1)
def sphere(size: str) -> Problem:
    return to_problem(start_of(generate_sphere(PRESETS[size])))


@pytest.mark.slow
@pytest.mark.parametrize(("size", "method"), GRID)
def test_method_on_sphere(size: str, method: str) -> None:
    settings = [f"max_iterations={ITERATIONS[size]}", *(["cap=5"] if size in LARGE else [])]
    result = solve(sphere(size), solver_options(method, settings))
    assert result.status in (Status.CONVERGED, Status.MAX_ITERATIONS, Status.STALLED), result.reason
    assert result.reason
    assert result.state.is_finite()
    objectives = [row.objective for row in result.trace]
    assert np.isfinite(objectives).all()
    assert all(b <= a for a, b in itertools.pairwise(objectives)), objectives
    assert len(objectives) > 1


def test_lma_cd_on_the_largest_is_recorded() -> None:
    recorded = json.loads(RECORDED.read_text())["5.4"]["LMA-CD, C++"]
    assert recorded["steps"] >= 1.0 and recorded["objective"] < 0.5 * 1.422e8
