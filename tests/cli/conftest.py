# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Small recordings and problems to run commands on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ba_node.io.bal import BalProblem, write_bal
from ba_node.offline.recording import record
from experiments.synthetic import SyntheticOptions, generate

KEYFRAMES = 8
TRACKS = 60


@pytest.fixture(scope="session")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a stereo recording of 8 keyframes with ground truth."""
    path = tmp_path_factory.mktemp("bag") / "small.mcap"
    options = SyntheticOptions(seed=5, keyframes=KEYFRAMES, landmarks=600, tracks=TRACKS, path="line", length_m=10.0)
    data = generate(options)
    record(path, data.timeline(), data.truth)
    return path


def make_bal(seed: int = 0) -> BalProblem:
    """Return four BAL cameras that look at 30 points, with noise on the points' start."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2.0, -2.0, -9.0], [2.0, 2.0, -5.0], (30, 3))
    shift = np.arange(4)[:, None] * [0.4, 0.1, 0.0]
    cameras = np.hstack([np.zeros((4, 3)), shift, np.tile([500.0, -0.02, 0.001], (4, 1))])
    camera_index, point_index = (index.ravel() for index in np.meshgrid(np.arange(4), np.arange(30), indexing="ij"))
    local = points[point_index] + shift[camera_index]
    p = -local[:, :2] / local[:, 2:]
    squared = np.sum(p * p, axis=1, keepdims=True)
    uv = 500.0 * (1.0 - 0.02 * squared + 0.001 * squared**2) * p
    start = points + rng.normal(0.0, 0.02, points.shape)
    return BalProblem(cameras, start, camera_index, point_index, uv)


@pytest.fixture(scope="session")
def bal_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a BAL problem that has an exact solution."""
    path = tmp_path_factory.mktemp("bal") / "four.txt"
    write_bal(path, make_bal())
    return path
