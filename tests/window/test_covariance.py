# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node import window
from ba_node.config import Config
from ba_node.core import geometry, methods, parameterisation, solver
from ba_node.core.problem import Problem, State
from ba_node.scene.scene import Scene
from ba_node.window import covariance, gauge
from experiments.synthetic import SyntheticOptions, generate

EXACT = dataclasses.replace(methods.options("auto"), gradient_tolerance=1e-9, function_tolerance=1e-12)


def selection_of(baseline_m: float, keyframes: int = 6) -> window.Selection:
    """Return the first window of a recording without noise or drift: it starts at the truth."""
    options = SyntheticOptions(
        seed=2, keyframes=keyframes, landmarks=300, tracks=40, length_m=10.0, path="line", noise_px=0.0,
        outlier_share=0.0, drift_rotation_deg=0.0, drift_translation=0.0, baseline_m=baseline_m,
    )  # fmt: skip
    scene = Scene(Config().scene)
    for _, _, measurement in generate(options).timeline():
        scene.add(measurement)
    # The front-end's steps are not measured anew in a test: without them.
    selection = window.select(scene, Config().with_values({"odometry.enabled": False}))
    assert isinstance(selection, window.Selection), selection
    return selection


def positions(state: State) -> np.ndarray:
    return np.asarray(geometry.inverse(state.rotation, state.translation)[1])


def scaled(state: State, selection: window.Selection, measured: np.ndarray) -> State:
    """Return a state in the scale of the front-end's steps, about the keyframe that is held."""
    if not (selection.unscaled >= 0).any():
        return state
    found = positions(state)
    scale = gauge.step_ratio(measured, found)
    _, translation = geometry.inverse(np.swapaxes(state.rotation, 1, 2), found[0] + scale * (found - found[0]))
    return dataclasses.replace(state, translation=translation, points=found[0] + scale * (state.points - found[0]))


@pytest.mark.parametrize("baseline_m", [0.2, 0.0], ids=["stereo", "one camera, scale of the steps"])
def test_it_is_what_repeated_measurements_scatter_by(baseline_m: float) -> None:
    selection = selection_of(baseline_m)
    problem = dataclasses.replace(selection.problem, start=solver.solve(selection.problem, EXACT).state)
    assert (selection.unscaled >= 0).any() == (baseline_m == 0.0)
    measured, free = positions(problem.start), ~problem.fixed
    told, errors = [], []
    for seed in range(300):
        sample = noisy(problem, seed)
        state = scaled(solver.solve(sample, EXACT).state, selection, measured)
        moved = positions(state) - measured
        turn = geometry.so3_log(np.swapaxes(state.rotation, 1, 2) @ problem.start.rotation)
        errors.append(np.concatenate([moved, turn], axis=1)[free])
        if seed < 20:
            measured_once = dataclasses.replace(selection, problem=sample)
            told.append(covariance.covariances(measured_once, state, measured, EXACT).poses[free])
    # The scatter of 300 has a standard error of 4 %.
    ratio = np.std(errors, axis=0) / np.sqrt(np.diagonal(np.mean(told, axis=0), axis1=1, axis2=2))
    assert np.all(np.abs(ratio - 1.0) < 0.2), f"scatter over told deviation: {ratio.min():.2f} to {ratio.max():.2f}"


def noisy(problem: Problem, seed: int) -> Problem:
    obs = problem.observations
    uv = obs.uv + np.random.default_rng(seed).normal(size=obs.uv.shape) * obs.sigma_px[:, None]
    return dataclasses.replace(problem, observations=dataclasses.replace(obs, uv=uv))


def test_order_and_frame_are_those_of_ros() -> None:
    """A step in the solver's tangent, done as the solver does it, and seen as a move and a turn in the world."""
    rng = np.random.default_rng(3)
    rotation, translation = geometry.so3_exp(rng.normal(size=(4, 3))), rng.normal(size=(4, 3))
    back, position = geometry.inverse(rotation, translation)
    root = rng.normal(size=(4, 6, 6))
    got = covariance.in_world(root @ np.swapaxes(root, 1, 2), position)
    h, columns = 1e-6, []
    for j in range(6):
        stepped = parameterisation.retract("local", rotation, translation, h * root[:, :, j])
        after, moved = geometry.inverse(*stepped)
        turn = geometry.so3_log(after @ np.swapaxes(back, 1, 2))
        columns.append(np.concatenate([moved - position, turn], axis=1) / h)
    seen = np.stack(columns, axis=2)
    np.testing.assert_allclose(got, seen @ np.swapaxes(seen, 1, 2), atol=1e-4)


def test_the_condition_is_the_derivative_of_what_sets_the_scale() -> None:
    rng = np.random.default_rng(4)
    rotation, centre = geometry.so3_exp(rng.normal(size=(5, 3))), np.cumsum(rng.normal(size=(5, 3)), axis=0)
    measured = centre + 0.1 * rng.normal(size=(5, 3))
    members = np.array([0, 2, 3, 4])
    translation = -(rotation @ centre[:, :, None])[..., 0]

    def fit(step: np.ndarray) -> float:
        _, position = geometry.inverse(*parameterisation.retract("local", rotation, translation, step))
        long = np.linalg.norm(np.diff(measured[members], axis=0), axis=1)
        short = np.linalg.norm(np.diff(position[members], axis=0), axis=1)
        return float(long @ short - short @ short)

    got = covariance._scale_condition(members, measured, centre)
    h = 1e-6
    expected = np.zeros((5, 6))
    for k in range(5):
        for j in range(6):
            step = np.zeros((5, 6))
            step[k, j] = h
            expected[k, j] = (fit(step) - fit(-step)) / (2 * h)
    np.testing.assert_allclose(got, expected, atol=1e-7)


def test_held_poses_have_none() -> None:
    selection = selection_of(0.2)
    told = covariance.covariances(
        dataclasses.replace(selection, problem=noisy(selection.problem, 1)),
        selection.problem.start,
        positions(selection.problem.start),
        EXACT,
    ).poses
    assert (told[selection.problem.fixed] == 0.0).all()
    values = np.linalg.eigvalsh(told[~selection.problem.fixed])
    assert (values > 0.0).all(), "a covariance is positive definite"
