# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.config import ConfigError, SolverOptions
from ba_node.core.cameras import Model, project
from ba_node.core.methods import options
from ba_node.core.objective import Objective
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.core.self_calibration import (
    CalibratedState,
    Unknown,
    calibrate,
    moved_cameras,
    params_jacobian,
    place_of,
    theta_jacobian,
)
from ba_node.core.solver import solve

AUTO = dataclasses.replace(
    options("auto"), trust_region="none", function_tolerance=1e-12, max_iterations=100, damping_policy="nielsen"
)
LENS = {
    Model.RATIONAL: [600.0, 610.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -2e-3, 3e-3, 0.01, 0.005, 0.001],
    Model.EQUIDISTANT: [300.0, 310.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, 0.0, 0.0, 0.0, 0.0],
}


def scene(model: Model, noise_px: float = 0.0) -> tuple[Problem, Cameras]:
    """Return six frames of a rig of two cameras of one model in front of 60 points, and the true cameras."""
    rng = np.random.default_rng(4)
    points = rng.uniform([-3.0, -3.0, 5.0], [3.0, 3.0, 9.0], (60, 3))
    rotation = np.tile(np.eye(3), (6, 1, 1))
    translation = rng.normal(0.0, 1.0, (6, 3)) * [1.0, 1.0, 0.5]
    cameras = Cameras(
        np.tile(np.eye(3), (2, 1, 1)),
        np.array([[0.0, 0.0, 0.0], [-0.3, 0.02, 0.0]]),
        np.full(2, model, np.uint8),
        np.tile(LENS[model], (2, 1)),
    )
    point, frame, camera = (index.ravel() for index in np.meshgrid(range(60), range(6), range(2), indexing="ij"))
    x_cam = points[point] + translation[frame] + cameras.translation[camera]
    uv = project(x_cam, cameras.model[camera], cameras.params[camera]) + rng.normal(0.0, noise_px, (len(point), 2))
    none = np.empty(0)
    observations = Observations(frame, camera, point, uv, np.ones(len(uv)), none, none)
    start = State(rotation, translation, points, np.empty((0, 3)))
    return Problem(start, np.zeros(6, dtype=bool), cameras, observations), cameras


def unknowns(*groups: tuple[int, ...]) -> list[Unknown]:
    """Return the groups of columns as unknowns of both cameras, and the place of the second."""
    return [*(Unknown(camera, group) for camera in (0, 1) for group in groups), *place_of(1)]


@pytest.mark.parametrize("model", list(Model))
def test_derivatives_are_those_of_finite_differences(model: Model) -> None:
    rng = np.random.default_rng(1)
    x_cam = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0], (20, 3))
    params = np.array(LENS[model])
    analytic = params_jacobian(x_cam, model, params)
    for column in range(12 if model == Model.RATIONAL else 8):
        step = np.zeros(12)
        step[column] = 1e-6
        ends = [project(x_cam, np.full(20, model, np.uint8), (params + s * step)[None]) for s in (1.0, -1.0)]
        np.testing.assert_allclose(analytic[:, :, column], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("model", list(Model))
def test_the_jacobian_by_all_of_a_camera_is_that_of_finite_differences(model: Model) -> None:
    problem, cameras = scene(model, 1.0)
    state = CalibratedState(**vars(problem.start), cameras=cameras)
    wanted = unknowns((0, 1), (2,), (4,), (5,))
    objective = Objective(problem, AUTO)

    def errors(theta: FloatArray) -> FloatArray:
        return objective.through(moved_cameras(cameras, wanted, theta)).errors(state).ravel()

    analytic = theta_jacobian(objective, state, wanted).toarray()
    for column in range(len(wanted)):
        step = np.zeros(len(wanted))
        step[column] = 1e-6
        numeric = (errors(step) - errors(-step)) / 2e-6
        np.testing.assert_allclose(analytic[:, column], numeric, rtol=1e-4, atol=1e-4, err_msg=str(wanted[column]))


@pytest.mark.parametrize("model", list(Model))
@pytest.mark.parametrize("linear_solver", ["dense", "sparse"])
def test_wrong_cameras_are_found_again(model: Model, linear_solver: str) -> None:
    problem, truth = scene(model)
    # Focal lengths and centres determine each other with the poses only as far as the points' shape allows.
    fixed = np.arange(6) < 2
    wrong = dataclasses.replace(
        truth, params=truth.params * 1.0, translation=truth.translation + np.array([[0.0] * 3, [0.01, 0.0, 0.0]])
    )
    wrong.params[:, :2] *= 1.02
    wrong.params[:, 2:4] += 3.0
    wrong.params[:, 4] += 0.01
    problem = dataclasses.replace(problem, cameras=wrong, fixed=fixed)
    wanted = unknowns((0,), (1,), (2,), (3,), (4,))
    result, found = calibrate(problem, wanted, dataclasses.replace(AUTO, linear_solver=linear_solver))
    assert result.status.usable
    assert result.objective_before > 1e3
    assert result.objective_after < 1e-10
    np.testing.assert_allclose(found.params[:, :5], truth.params[:, :5], rtol=1e-5)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-6)


def test_with_nothing_free_it_is_the_solver_itself() -> None:
    problem, _ = scene(Model.RATIONAL, 1.0)
    result, cameras = calibrate(problem, [], AUTO)
    np.testing.assert_array_equal(cameras.params, problem.cameras.params)
    plain = solve(problem, dataclasses.replace(AUTO, kernels="numpy", linear_solver="dense"))
    assert result.objective_after == pytest.approx(plain.objective_after, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"trust_region": "diag"}, "trust_region = diag: cameras are refined with trust_region = none alone"),
        ({"schur": "none"}, "schur = none"),
        ({"linear_solver": "pcg"}, "take linear_solver and kernels = auto"),
        ({"kernels": "native"}, "take linear_solver and kernels = auto"),
    ],
)
def test_what_cannot_be_had_is_named(change: dict[str, str], words: str) -> None:
    problem, _ = scene(Model.RATIONAL)
    with pytest.raises(ConfigError) as error:
        calibrate(problem, unknowns((0, 1)), dataclasses.replace(SolverOptions(), **change))  # type: ignore[arg-type]
    assert words in str(error.value)
