# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.config import TracksConfig
from ba_node.core import cameras, objective
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.window.initial_points import initial_points, poses_gate

GATES = TracksConfig(min_parallax_deg=1.0, max_triangulation_px=12.0)
POINT = np.array([0.5, -0.3, 10.0])


def problem_of(baseline_m: float = 1.0, shift_px: float = 0.0, depth_m: float | None = None, views: int = 2) -> Problem:
    """Return cameras side by side that see one point; the last one sees it ``shift_px`` too low."""
    model, params = cameras.parameters("plumb_bob", np.array([500.0, 500, 320, 240]), np.zeros(5))
    rig = Cameras(np.eye(3)[None], np.zeros((1, 3)), np.array([model], np.uint8), params[None])
    translation = np.array([[-baseline_m * i, 0.0, 0.0] for i in range(views)])
    state = State(np.tile(np.eye(3), (views, 1, 1)), translation, POINT[None], np.empty((0, 3)))
    zeros = np.zeros(views, np.intp)
    obs = Observations(np.arange(views), zeros, zeros, np.zeros((views, 2)), np.ones(views), np.empty(0), np.empty(0))
    problem = Problem(state, np.zeros(views, bool), rig, obs)
    uv = objective.reprojection_errors(problem, state)
    uv[-1, 1] += shift_px
    obs = dataclasses.replace(obs, uv=uv)
    if depth_m is not None:
        depth = np.array([depth_m] + [np.nan] * (views - 1))
        obs = dataclasses.replace(obs, depth_m=depth, depth_sigma_m=0.02 * depth)
    return dataclasses.replace(problem, observations=obs)


def first(problem: Problem, guess: object = (np.nan, np.nan, np.nan)) -> np.ndarray:
    return np.asarray(initial_points(problem, np.array([guess], float), GATES, poses_gate(problem, GATES))[0])


def test_two_views_with_parallax_are_triangulated() -> None:
    np.testing.assert_allclose(first(problem_of()), POINT, atol=1e-9)


def test_too_little_parallax_gives_nothing() -> None:
    # 0.1 m at 10 m is 0.57 degrees.
    assert np.isnan(first(problem_of(baseline_m=0.1))).all()


def test_too_large_an_error_gives_nothing() -> None:
    assert np.isnan(first(problem_of(shift_px=60.0))).all()


def test_a_point_behind_a_camera_gives_nothing() -> None:
    problem = problem_of()
    # Rays that part in front of the cameras meet behind them.
    uv = problem.observations.uv[::-1].copy()
    crossed = dataclasses.replace(problem.observations, uv=uv)
    assert np.isnan(first(dataclasses.replace(problem, observations=crossed))).all()


def test_one_view_with_depth_is_enough_without_it_is_not() -> None:
    np.testing.assert_allclose(first(problem_of(views=1, depth_m=10.0)), POINT, atol=1e-9)
    assert np.isnan(first(problem_of(views=1))).all()


def test_a_guess_that_fits_is_taken_as_it_is() -> None:
    guess = POINT + np.array([0.01, 0.0, 0.1])
    np.testing.assert_array_equal(first(problem_of(), guess), guess)
    np.testing.assert_array_equal(first(problem_of(baseline_m=0.01), guess), guess)


def test_a_guess_that_does_not_fit_yields_to_a_triangulation() -> None:
    np.testing.assert_allclose(first(problem_of(), POINT + np.array([2.0, 0, 0])), POINT, atol=1e-9)


@pytest.mark.parametrize("problem", [problem_of(baseline_m=0.1), problem_of(shift_px=60.0)])
def test_a_bad_guess_is_better_than_none(problem: Problem) -> None:
    guess = POINT + np.array([2.0, 0, 0])
    np.testing.assert_array_equal(first(problem, guess), guess)


def test_a_guess_behind_the_cameras_is_worth_nothing() -> None:
    assert np.isnan(first(problem_of(baseline_m=0.1), -POINT)).all()
