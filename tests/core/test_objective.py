# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Residuals against the definition; both Jacobians against differences and by the Taylor slope (3.1.4)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core.loss import LOSSES
from ba_node.core.objective import Objective, reprojection_errors
from ba_node.core.problem import Problem, State

SHAPES = [
    {"stereo": True},
    {"depth": True},
    {"free_intrinsics": True},
    {"stereo": True, "depth": True, "distorted": False},
]
Make = Callable[..., tuple[Problem, State]]


def random_step(problem: Problem, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a step of unit size, rotation and intrinsics scaled to do about as much as a metre."""
    rng = np.random.default_rng(seed)
    size = 9 if problem.free_intrinsics else 6
    keyframes = rng.normal(size=(problem.n_keyframes, size))
    keyframes[:, :3] *= 0.1
    if size == 9:
        keyframes[:, 6:] *= [20.0, 0.05, 0.02]
    return keyframes, rng.normal(size=(problem.n_points, 3))


def whitened(objective: Objective, state: State) -> np.ndarray:
    """Return residuals under squared loss, where the weight is one."""
    return objective.linearise(state).residual


def product(objective: Objective, state: State, step: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return J p."""
    lin, obs = objective.linearise(state), objective.problem.observations
    moved = (lin.d_keyframe @ step[0][obs.keyframe][:, :, None])[..., 0]
    return np.asarray(moved + (lin.d_point @ step[1][obs.point][:, :, None])[..., 0])


@pytest.mark.parametrize("shape", SHAPES)
def test_errors_vanish_at_the_truth(shape: dict[str, bool], make_problem: Make) -> None:
    """The truth was projected observation by observation by the formula."""
    problem, truth = make_problem(noise_px=0.0, **shape)
    assert np.abs(reprojection_errors(problem, truth)).max() < 1e-10


@pytest.mark.parametrize("parameterisation", ["local", "global"])
@pytest.mark.parametrize("shape", SHAPES)
def test_jacobian_agrees_with_central_differences(
    parameterisation: str, shape: dict[str, bool], make_problem: Make
) -> None:
    problem, _ = make_problem(**shape)
    objective = Objective(problem, SolverOptions(parameterisation=parameterisation))
    lin, obs, h = objective.linearise(problem.start), problem.observations, 1e-6
    size = lin.d_keyframe.shape[2]
    relative = []
    for j in range(size + 3):
        keyframes, points = np.zeros((problem.n_keyframes, size)), np.zeros((problem.n_points, 3))
        (keyframes if j < size else points)[:, j if j < size else j - size] = h
        plus = whitened(objective, objective.retract(problem.start, keyframes, points))
        minus = whitened(objective, objective.retract(problem.start, -keyframes, -points))
        analytic = lin.d_keyframe[:, :, j] if j < size else lin.d_point[:, :, j - size]
        numeric = (plus - minus) / (2 * h)
        relative.append(np.mean(np.abs(numeric - analytic)) / np.mean(np.abs(analytic)))
    assert max(relative) < 1e-7, f"mean error per element, relative: {relative} over {len(obs)} observations"


@pytest.mark.parametrize("parameterisation", ["local", "global"])
@pytest.mark.parametrize("shape", SHAPES)
def test_taylor_remainder_falls_with_slope_two(
    parameterisation: str, shape: dict[str, bool], make_problem: Make
) -> None:
    problem, _ = make_problem(**shape)
    objective = Objective(problem, SolverOptions(parameterisation=parameterisation))
    keyframes, points = random_step(problem, 3)
    base, slope = whitened(objective, problem.start), product(objective, problem.start, (keyframes, points))
    taus = 2.0 ** -np.arange(8, 15)
    remainders = [
        np.linalg.norm(
            whitened(objective, objective.retract(problem.start, t * keyframes, t * points)) - base - t * slope
        )
        for t in taus
    ]
    order = np.polyfit(np.log(taus), np.log(remainders), 1)[0]
    assert order == pytest.approx(2.0, abs=0.1), f"slope {order:.3f}"


@pytest.mark.parametrize("per", ["observation", "component"])
@pytest.mark.parametrize("graduation", [np.inf, 0.5, 0.0])
@pytest.mark.parametrize("loss", list(LOSSES))
@pytest.mark.parametrize("shape", SHAPES)
def test_gradient_is_that_of_the_robust_objective(
    loss: str, graduation: float, per: str, shape: dict[str, bool], make_problem: Make
) -> None:
    """g = J' W r, by two routes: the linearisation, and central differences of the objective alone."""
    problem, _ = make_problem(start_error=0.02, **shape)
    objective = Objective(problem, SolverOptions(loss=loss, loss_scale_px=1.5, loss_per=per))
    objective.graduation = graduation
    lin = objective.linearise(problem.start)
    assert lin.objective == pytest.approx(objective.value(problem.start), rel=1e-14)
    step = random_step(problem, 5)
    analytic = float(np.sum(lin.residual * _weighted_product(objective, problem, step)))
    # Small, so that no residual crosses the edge of a truncated quadratic.
    h = 1e-7
    plus = objective.value(objective.retract(problem.start, h * step[0], h * step[1]))
    minus = objective.value(objective.retract(problem.start, -h * step[0], -h * step[1]))
    assert (plus - minus) / (2 * h) == pytest.approx(analytic, rel=1e-5)


def _weighted_product(objective: Objective, problem: Problem, step: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return product(objective, problem.start, step)


def test_the_loss_of_components_is_the_sum_of_both(make_problem: Make) -> None:
    """(4.20): Psi of u and of v, which for the squared loss is that of the observation."""
    problem, _ = make_problem(start_error=0.02)
    r = Objective(problem, SolverOptions()).errors(problem.start) / problem.observations.sigma_px[:, None]
    found = Objective(problem, SolverOptions(loss="huber", loss_per="component")).value(problem.start)
    near = np.minimum(np.abs(r), 1.0)
    assert found == pytest.approx(0.5 * np.sum(near * (2.0 * np.abs(r) - near)), rel=1e-12)
    squared = [
        Objective(problem, SolverOptions(loss_per=per)).value(problem.start) for per in ("observation", "component")
    ]
    assert squared[0] == pytest.approx(squared[1], rel=1e-14)


class TestPointsBehind:
    """Half of the points are turned to the other side of the camera."""

    @pytest.fixture
    def problem(self, make_problem: Make) -> Problem:
        problem, truth = make_problem(keyframes=2, fixed=0)
        points = truth.points.copy()
        points[::2, 2] *= -1.0
        return dataclasses.replace(problem, start=dataclasses.replace(truth, points=points))

    def test_constant_costs_but_does_not_pull(self, problem: Problem) -> None:
        lin = Objective(problem, SolverOptions(loss="huber", cheirality="constant")).linearise(problem.start)
        behind = np.flatnonzero(problem.observations.point % 2 == 0)
        assert not lin.d_point[behind].any() and not lin.residual[behind].any()
        in_front = Objective(problem, SolverOptions(loss="huber", cheirality="drop")).value(problem.start)
        # Huber at 1: Psi(100) = 2 * 100 - 1.
        assert lin.objective - in_front == pytest.approx(0.5 * 199.0 * len(behind), rel=1e-12)

    def test_keep_counts_the_plain_residual(self, problem: Problem) -> None:
        objective = Objective(problem, SolverOptions(cheirality="keep"))
        assert objective.value(problem.start) > Objective(problem, SolverOptions(cheirality="drop")).value(
            problem.start
        )
        assert np.isfinite(objective.linearise(problem.start).d_point).all()

    def test_errors_are_nan(self, problem: Problem) -> None:
        errors = reprojection_errors(problem, problem.start)
        np.testing.assert_array_equal(np.isnan(errors[:, 0]), problem.observations.point % 2 == 0)

    @pytest.mark.parametrize("cheirality", ["keep", "constant", "drop"])
    def test_a_point_in_the_camera_plane_stays_finite(self, problem: Problem, cheirality: str) -> None:
        points = problem.start.points.copy()
        points[0] = -problem.start.rotation[0].T @ problem.start.translation[0]
        state = dataclasses.replace(problem.start, points=points)
        lin = Objective(dataclasses.replace(problem, start=state), SolverOptions(cheirality=cheirality)).linearise(
            state
        )
        assert np.isfinite(lin.objective) and np.isfinite(lin.d_keyframe).all() and np.isfinite(lin.d_point).all()
