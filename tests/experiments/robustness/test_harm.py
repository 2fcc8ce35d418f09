# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a replay did harm, from files with known errors."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ba_node.estimate import Poses
from ba_node.io.trajectory import write_tum
from experiments.robustness.harm import SessionResult, messages_of, session_results
from tests.conftest import make_poses


def shifted(poses: Poses, by: float) -> Poses:
    """Return poses with every other one moved by a length: an RMSE of half of it after alignment, about."""
    move = np.zeros((len(poses), 3))
    move[::2, 0] = by
    return dataclasses.replace(poses, position=poses.position + move)


def test_each_session_is_compared_with_the_truth(tmp_path: Path) -> None:
    truth = make_poses(40, seed=1)
    for name, rows, published in ((".", slice(0, 20), 0.0), ("session_3", slice(20, 40), 0.2)):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        write_tum(folder / "trajectory_input.tum", shifted(truth[rows], 0.1))
        write_tum(folder / "trajectory.tum", shifted(truth[rows], published))
    good, bad = session_results(tmp_path, truth)
    assert (good.folder, bad.folder, good.keyframes) == (tmp_path, tmp_path / "session_3", 20)
    assert good.published_m < 1e-9 and good.harmless
    assert good.input_m == pytest.approx(0.05, rel=0.1) and bad.published_m == pytest.approx(0.1, rel=0.1)
    assert not bad.harmless


def test_a_body_that_stands_still_is_compared_without_alignment(tmp_path: Path) -> None:
    truth = make_poses(10, seed=2)
    truth = dataclasses.replace(truth, position=np.zeros((10, 3)))
    write_tum(tmp_path / "trajectory_input.tum", truth)
    write_tum(tmp_path / "trajectory.tum", dataclasses.replace(truth, position=np.full((10, 3), 0.1)))
    (error,) = session_results(tmp_path, truth)
    assert error.input_m == 0.0 and error.published_m == pytest.approx(0.1 * np.sqrt(3.0))


@pytest.mark.parametrize(
    ("input_m", "published_m", "input_deg", "published_deg", "harmless"),
    [
        (1.0, 1.1, 1.0, 1.1, True),
        (1.0, 1.106, 1.0, 1.0, False),
        (0.0, 0.005, 0.0, 0.1, True),
        (1.0, 1.0, 1.0, 1.3, False),
    ],
)
def test_bound(input_m: float, published_m: float, input_deg: float, published_deg: float, harmless: bool) -> None:
    assert SessionResult(Path(), 1, input_m, published_m, input_deg, published_deg).harmless is harmless


def test_words_are_those_for_a_user() -> None:
    older = {"warnings": {"held": "step of 60 m"}, "rejected": {}}
    report = {"attention": ["one"], "rejected": {"bad_pose": 2}, "older_sessions": [older], "median_px": {"input": 3}}
    assert messages_of(report).splitlines() == ["held: step of 60 m", "one", "bad_pose: 2"]
