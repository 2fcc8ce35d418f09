# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A tiny experiment on a sphere that is made, so that no data set is needed."""

from __future__ import annotations

import pytest

from experiments.thesis.experiments import Case, Experiment
from experiments.thesis.tasks import Measure, Run

TINY = Experiment(
    "9.9",
    "a tiny experiment",
    (
        Case("DINM", Run("10-253", "dinm", (), 4, (0, 3)), {"seconds": 10.0, "objective": 25.2}, seeds=1),
        Case("LMA-CD", Run("10-253", "lma_cd", (), 3), {"seconds": 5.0}, seeds=1),
        Case("Taylor", Measure("10-253", "taylor"), {"slope": 2.0}),
        Case("the problem", Measure("10-253", "layout")),
    ),
    ("seconds", "objective", "steps", "slope", "end"),
    ("9.10",),
    ("curves", "reprojection", "histograms", "layout"),
    note="With a & in its note.",
)


@pytest.fixture
def tiny() -> Experiment:
    return TINY
