# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.config import ConfigError, SolverOptions
from ba_node.core.bordered import (
    TIME,
    Shared,
    SharedKernels,
    SharedState,
    Unknown,
    moved_cameras,
    place_of,
    shared_jacobian,
    solve_shared,
)
from ba_node.core.cameras import Model, project
from ba_node.core.methods import options
from ba_node.core.objective import Objective
from ba_node.core.problem import Cameras, Observations, Problem, State
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
def test_the_jacobian_by_all_of_a_camera_is_that_of_finite_differences(model: Model) -> None:
    problem, cameras = scene(model, 1.0)
    wanted = unknowns((0, 1), (2,), *((column,) for column in range(4, 12 if model == Model.RATIONAL else 8)))
    objective, uv = Objective(problem, AUTO), problem.observations.uv
    state = SharedState(**vars(problem.start), cameras=cameras, z=np.zeros(len(wanted)), uv=uv)

    def errors(theta: FloatArray) -> FloatArray:
        return objective.through(moved_cameras(cameras, wanted, theta), uv).errors(state).ravel()

    analytic = shared_jacobian(objective, state, Shared(tuple(wanted))).toarray()
    for column in range(len(wanted)):
        step = np.zeros(len(wanted))
        step[column] = 1e-6
        numeric = (errors(step) - errors(-step)) / 2e-6
        np.testing.assert_allclose(analytic[:, column], numeric, rtol=1e-4, atol=1e-4, err_msg=str(wanted[column]))


@pytest.mark.slow
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
    result, end = solve_shared(problem, Shared(tuple(wanted)), dataclasses.replace(AUTO, linear_solver=linear_solver))
    found = end.cameras
    assert result.status.usable
    assert result.objective_before > 1e3
    assert result.objective_after < 1e-10
    np.testing.assert_allclose(found.params[:, :5], truth.params[:, :5], rtol=1e-5)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-6)


def test_with_nothing_free_it_is_the_solver_itself() -> None:
    problem, _ = scene(Model.RATIONAL, 1.0)
    result, end = solve_shared(problem, Shared(()), AUTO)
    np.testing.assert_array_equal(end.cameras.params, problem.cameras.params)
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
    chosen = dataclasses.replace(SolverOptions(), **change)  # type: ignore[arg-type]
    with pytest.raises(ConfigError) as error:
        solve_shared(problem, Shared(tuple(unknowns((0, 1)))), chosen)
    assert words in str(error.value)


def test_gradient_and_model_are_those_of_the_objective_with_a_prior_and_a_clock() -> None:
    """Along any step the objective falls as the bordered equations say, to second order."""
    problem, _ = scene(Model.RATIONAL, 1.0)
    rng = np.random.default_rng(8)
    wanted = (*unknowns((0, 1), (4,)), Unknown(0, (TIME,)), Unknown(1, (TIME,)))
    basis = (
        np.diag([10.0, 0.1, 10.0, 0.1, *(0.01 * np.ones(6)), 0.01, 0.01]) @ np.linalg.qr(rng.normal(size=(12, 5)))[0]
    )
    flow = rng.normal(size=(len(problem.observations), 2)) * 100.0
    shared = Shared(wanted, basis, rng.normal(size=5), flow)
    kernels = SharedKernels(problem, AUTO, shared)
    value = kernels.linearise(kernels.start)
    system = kernels.damp("none", 1e-9)
    n = len(system.rhs)
    ratios = []
    for size in (1e-3, 1e-4):
        step = kernels.step(kernels.start, system, size * np.linspace(-1.0, 1.0, n), 0)
        ratios.append(abs(value - step.objective - step.predicted) / abs(step.predicted))
        kernels.linearise(kernels.start)
    assert ratios[1] < 1e-2 and ratios[1] < 0.3 * ratios[0], ratios
