# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Redundant keyframes are taken out of the map: fewer of them, and hardly another error."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.estimate import Estimate
from ba_node.measurements import GravityDirection, Keyframe, Measurement, RelativePose
from ba_node.scene.constraints import joined_step
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from tests.scene.small import check_links
from tests.window.street import first, replayed

# By windows alone: how often a map is refined as a whole depends on how many keyframes it has.
WINDOW: dict[str, Any] = {"window.max_keyframes": 10, "factors.adjust_m": 0.0}
CHOSEN = WINDOW | {"scene.redundant_share": 0.7}
N = 60


@pytest.fixture(scope="module")
def data() -> SyntheticData:
    """Return a loop on which keyframes are 0.6 m apart."""
    return generate(SyntheticOptions(seed=6, keyframes=N, landmarks=1500, tracks=80, length_m=36.0))


def error_m(estimate: Estimate, data: SyntheticData, among: np.ndarray) -> float:
    """Return the rms distance of some keyframes (ids) to the truth, m."""
    here, there = (np.isin(one.keyframe_id, among) for one in (estimate.trajectory, data.truth))
    off = estimate.trajectory.position[here] - data.truth.position[there]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


@pytest.mark.slow
def test_a_third_fewer_keyframes_cost_a_few_percent(data: SyntheticData) -> None:
    _, whole = replayed(data, **WINDOW)
    backend, culled = replayed(data, **CHOSEN)
    left = culled.trajectory.keyframe_id
    assert len(left) <= 2 * N // 3, f"{len(left)} of {N} keyframes are left"
    assert left[0] == data.truth.keyframe_id[0]
    np.testing.assert_array_equal(left[-10:], data.truth.keyframe_id[-10:])
    assert not backend.report.warnings
    errors = [error_m(one, data, left) for one in (whole, culled)]
    assert errors[1] < 1.05 * errors[0] + 0.001, errors
    check_links(backend.scene)


@pytest.mark.slow
def test_what_is_named_stays_and_steps_lead_over_the_others(data: SyntheticData) -> None:
    """Keyframe 20 is an end of a relative pose, 22 has gravity; every step has a covariance."""
    ids = data.truth.keyframe_id.tolist()
    told = np.diag([1e-4] * 3 + [1e-6] * 3)

    def more(k: int, _: Keyframe) -> list[Measurement]:
        if k != 25:
            return []
        move = np.array([0.6, 0.0, 0.0])
        pose = RelativePose(0, ids[18], ids[20], False, 2.0 * move, np.array([0.0, 0.0, 0.0, 1.0]), np.eye(6).ravel())
        return [pose, GravityDirection(0, ids[22], np.array([0.0, 0.0, -1.0]), 0.1)]

    short = first(data, 40)
    keyframes = tuple(dataclasses.replace(one, covariance=told.ravel()) for one in short.keyframes)
    short = dataclasses.replace(short, keyframes=keyframes)
    backend, _ = replayed(short, more, **(CHOSEN | {"scene.redundant_share": 0.1}))
    scene = backend.scene
    left = scene.keyframes.keyframe_id[scene.order].tolist()
    assert {ids[0], ids[18], ids[20], ids[22]} <= set(left) and len(left) < 30
    assert set(scene.constraints.steps) <= set(left)
    # Over k steps in a row the variance of the rotation is k times as large.
    for before, after in itertools.pairwise(left):
        gap = ids.index(after) - ids.index(before)
        turned = np.trace(scene.constraints.steps[after][:3, :3]) / 3.0
        assert turned == pytest.approx(gap * 1e-6, rel=1e-6), (before, after)


def test_the_covariance_of_two_steps_is_that_of_drawn_ones() -> None:
    rng = np.random.default_rng(3)
    spread = [1e-3 * rng.normal(size=(6, 6)) for _ in range(2)]
    covariances = [one @ one.T for one in spread]
    turns = geometry.so3_exp(np.array([[0.3, -0.2, 0.5], [-0.4, 0.1, 0.2]]))
    moves = np.array([[1.0, 0.5, -0.2], [0.4, -1.0, 0.3]])
    noise = [rng.normal(size=(20000, 6)) @ one.T for one in spread]
    drawn = [(geometry.so3_exp(e[:, :3]) @ t, m + e[:, 3:]) for e, t, m in zip(noise, turns, moves, strict=True)]
    turn, move = geometry.compose(*drawn[0], *drawn[1])
    true = geometry.compose(turns[0], moves[0], turns[1], moves[1])
    off = np.concatenate([geometry.so3_log(turn @ true[0].T), move - true[1]], axis=1)
    found = joined_step(covariances[0], covariances[1], turns[0], turns[0] @ moves[1])
    np.testing.assert_allclose(np.cov(off.T), found, atol=0.05 * np.abs(found).max())
