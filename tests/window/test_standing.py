# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Which share of the tracks stands, and what is done where it is small."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node import window
from ba_node.arrays import FloatArray
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core.problem import Problem
from ba_node.estimate import Poses
from ba_node.evaluation.metrics import absolute_error
from ba_node.scene.scene import Scene
from ba_node.window.selection import Selection
from ba_node.window.standing import CAUSE, Shares, of_map, shares
from experiments.robustness.faults import spoiled
from experiments.synthetic import SyntheticOptions, generate

# Loops of 20 m; the front-end is very good, or poor.
DRIVE = {"keyframes": 40, "length_m": 20.0, "path": "loop", "tracks": 200, "landmarks": 3000, "outlier_share": 0.0}
GOOD = {"drift_rotation_deg": 0.05, "drift_translation": 0.005}
POOR = {"drift_rotation_deg": 0.5, "drift_translation": 0.03}


def selected(baseline_m: float = 0.12) -> Selection:
    """Return a window whose poses are the true ones, nearly."""
    data = generate(SyntheticOptions(
        seed=5, keyframes=20, length_m=10.0, path="line", landmarks=3000, tracks=200, outlier_share=0.0,
        drift_rotation_deg=0.001, drift_translation=0.0001, baseline_m=baseline_m,
    ))  # fmt: skip
    scene = Scene(Config().scene)
    for _, _, measurement in data.timeline():
        scene.add(measurement)
    selection = window.select(scene, Config())
    assert isinstance(selection, Selection), selection
    return selection


def asked(selection: Selection, uv: FloatArray, kernels: str = "auto") -> Shares | None:
    """Return which shares stand by the poses of a window, with other pixels."""
    whole, right = selection.whole, selection.observations.uv
    problem = dataclasses.replace(whole, observations=dataclasses.replace(whole.observations, uv=uv))
    poses = selection.measured, (whole.start.rotation, whole.start.translation)
    refined, inlier = np.ones(whole.n_keyframes, bool), np.all(uv == right, axis=1)
    return shares(problem, refined, inlier if inlier.any() else ~inlier, poses, kernels)


def wandering(problem: Problem, share: float, px: float) -> FloatArray:
    """Return pixels of which a share of the points wanders to the right, so many px a keyframe."""
    obs = problem.observations
    own = np.random.default_rng(1).random(problem.n_points) < share
    uv = obs.uv.copy()
    uv[own[obs.point], 0] += px * obs.keyframe[own[obs.point]]
    return uv


@pytest.mark.parametrize("kernels", ["native", "numpy"])
@pytest.mark.parametrize("baseline_m", [0.0, 0.12])
def test_what_moves_does_not_stand(baseline_m: float, kernels: str) -> None:
    selection = selected(baseline_m)
    for share in (0.0, 0.3, 0.6, 0.9):
        found = asked(selection, wandering(selection.whole, share, 6.0), kernels=kernels)
        assert found is not None
        stands = 1.0 - share
        # What lies along the way seems to stand still; one camera does not tell what moves along its rays.
        assert 0.85 * stands - 0.03 <= found.by_solution <= stands + 0.12, f"{share}: {found}"
        assert found.by_front_end == pytest.approx(found.by_solution, abs=0.03)


def test_mismatches_tell_nothing() -> None:
    selection = selected()
    rng, uv = np.random.default_rng(2), selection.observations.uv.copy()
    wrong = rng.random(len(uv)) < 0.03
    uv[wrong] = rng.random((int(wrong.sum()), 2)) * [640.0, 480.0]
    found = asked(selection, uv)
    assert found is not None and found.by_solution > 0.7, found
    # Nor those near by.
    uv[wrong] = selection.observations.uv[wrong] + rng.uniform(8.0, 30.0, (int(wrong.sum()), 2))
    found = asked(selection, uv)
    assert found is not None and found.by_solution > 0.7, found


def test_noise_is_not_as_stated() -> None:
    selection = selected()
    obs = selection.observations
    uv = obs.uv + 2.0 * obs.sigma_px[:, None] * np.random.default_rng(3).normal(size=obs.uv.shape)
    found = asked(selection, uv)
    assert found is not None and found.by_solution > 0.7, found


@pytest.mark.parametrize(("has_scale", "poor", "good"), [(True, 0.475, 0.54), (False, 0.6, 0.75)])
def test_good_steps_ask_for_more(has_scale: bool, poor: float, good: float) -> None:
    for front_end, least in ((0.0, poor), (0.7 * good, good)):
        assert Shares(front_end, least - 0.01).too_few(has_scale)
        assert not Shares(front_end, least + 0.01).too_few(has_scale)


def replayed(rig: str, share: float, seed: int, odometry: dict[str, float]) -> tuple[Backend, float, float]:
    """Return the back-end, and how many times as far from the truth as what came in its poses are, m and deg."""
    recording = spoiled("outliers_moving", rig, share, seed, **DRIVE, **odometry)
    backend = Backend(Config())
    for _ in backend.replay(iter(recording.measurements)):
        pass
    after = backend.estimate().trajectory

    def errors(poses: Poses) -> tuple[float, float]:
        metres = absolute_error(poses, recording.truth, "se3").translation.rmse
        return metres, absolute_error(poses, recording.truth, "none").rotation.rmse

    (m, deg), (before_m, before_deg) = errors(after), errors(recording.odometry)
    return backend, m / before_m, deg / before_deg


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "share", "seed"), [("stereo", 0.7, 0), ("stereo", 0.9, 1), ("mono", 0.9, 0), ("rgbd", 0.9, 1)]
)
def test_where_most_moves_what_came_in_stands(rig: str, share: float, seed: int) -> None:
    """They ended at up to 20 times what came in."""
    backend, metres, turns = replayed(rig, share, seed, GOOD)
    assert max(metres, turns) <= 1.1, f"{metres:.2f} and {turns:.2f} times what came in"
    if metres == 1.0:
        assert any(CAUSE in text or "move" in text for text in backend.report.warnings), backend.report.warnings


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "seed"), [("stereo", 0), ("rgbd", 1)])
def test_where_the_majority_stands_poor_odometry_is_mended(rig: str, seed: int) -> None:
    backend, metres, turns = replayed(rig, 0.4, seed, POOR)
    assert max(metres, turns) <= 0.4, f"{metres:.2f} and {turns:.2f} times what came in"
    shares = of_map(backend.scene, backend.config)
    assert shares is not None and shares.by_solution > 0.5 and shares.by_front_end < 0.1, shares
