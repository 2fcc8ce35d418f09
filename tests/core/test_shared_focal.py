# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Shared f, k1 and k2: the kernels in C++ beside those of numpy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node import native
from ba_node.config import ConfigError, SolverOptions
from ba_node.core.bordered import Shared, SharedKernels, Unknown, place_of, solve_shared
from ba_node.core.cameras import Model, project
from ba_node.core.methods import options
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.core.shared_focal import FocalKernels, applies, solve_cameras

pytestmark = pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
AUTO = dataclasses.replace(
    options("auto"), trust_region="none", function_tolerance=1e-12, max_iterations=40, cheirality="drop"
)
FOCAL, K1, K2 = (0, 1), (4,), (5,)


def scene(model: Model = Model.RATIONAL, loss_px: float = 0.3) -> Problem:
    """Return nine frames, of one of three cameras each, in front of 80 points; the cameras are off."""
    rng = np.random.default_rng(7)
    points = rng.uniform([-3.0, -3.0, 5.0], [3.0, 3.0, 9.0], (80, 3))
    n = 9
    params = np.zeros((3, 12))
    params[0, :6] = [600.0, 600.0, 320.0, 240.0, -0.1, 0.02]
    params[1, :6] = [500.0, 500.0, 310.5, 250.0, 0.05, 0.0]
    params[2, :6] = [450.0, 450.0, 300.0, 240.0, 0.0, 0.0]
    cameras = Cameras(np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)), np.full(3, model, np.uint8), params)
    translation = rng.normal(0.0, 1.0, (n, 3)) * [1.0, 1.0, 0.5]
    frame, point = (index.ravel() for index in np.meshgrid(range(n), range(80), indexing="ij"))
    order = np.argsort(point, kind="stable")
    frame, point = frame[order], point[order]
    camera = frame % 3
    uv = project(points[point] + translation[frame], cameras.model[camera], params[camera])
    uv += rng.normal(0.0, loss_px, uv.shape)
    off = params.copy()
    off[:, :2] *= 1.02
    none = np.empty(0)
    start = State(np.tile(np.eye(3), (n, 1, 1)), translation, points + rng.normal(0.0, 0.02, (80, 3)), np.empty((0, 3)))
    observations = Observations(frame, camera, point, uv, np.full(len(uv), 0.5), none, none)
    return Problem(start, np.zeros(n, bool), dataclasses.replace(cameras, params=off), observations)


def shared(*groups: tuple[int, ...]) -> Shared:
    return Shared(tuple(Unknown(camera, group) for camera in range(3) for group in groups))


@pytest.mark.parametrize(
    ("model", "groups", "linear_solver", "loss"),
    [
        (Model.RATIONAL, (FOCAL,), "dense", "squared"),
        (Model.RATIONAL, (FOCAL, K1), "sparse", "cauchy"),
        (Model.RATIONAL, (FOCAL, K1, K2), "dense", "squared"),
        (Model.EQUIDISTANT, (FOCAL, K1, K2), "sparse", "cauchy"),
        (Model.EQUIDISTANT, (K2,), "dense", "squared"),
    ],
)
def test_both_kernels_take_the_same_way(
    model: Model, groups: tuple[tuple[int, ...], ...], linear_solver: str, loss: str
) -> None:
    problem, chosen = scene(model), dataclasses.replace(AUTO, linear_solver=linear_solver, loss=loss)
    assert applies(problem, shared(*groups), chosen)
    quick, end = solve_cameras(problem, shared(*groups), chosen, clock=lambda: 0.0, on_iteration=None)
    slow, reference = solve_shared(problem, shared(*groups), chosen)
    assert quick.objective_after == pytest.approx(slow.objective_after, rel=1e-9)
    assert quick.objective_after < 0.9 * quick.objective_before
    for ours, theirs in zip(quick.trace[:4], slow.trace[:4], strict=True):
        assert ours.objective == pytest.approx(theirs.objective, rel=1e-7)
        assert ours.gradient_norm == pytest.approx(theirs.gradient_norm, rel=1e-4)
    np.testing.assert_allclose(end.cameras.params, reference.cameras.params, rtol=2e-3, atol=1e-4)
    moved = end.cameras.params - problem.cameras.params
    np.testing.assert_allclose(end.z, [moved[u.camera, u.columns[0]] for u in shared(*groups).unknowns])


def test_one_system_is_that_of_the_other_kernels() -> None:
    problem, kernels = scene(), []
    for kind in (FocalKernels, SharedKernels):
        made = kind(problem, AUTO, shared(FOCAL, K1))
        made.linearise(made.problem.start if isinstance(made, FocalKernels) else made.start)
        kernels.append(made.damp("diag", 1e-3))
    ours, theirs = kernels
    scale = 1.0 / np.sqrt(np.diagonal(theirs.dense()))
    np.testing.assert_allclose(
        ours.dense() * scale * scale[:, None], theirs.dense() * scale * scale[:, None], atol=1e-7
    )
    np.testing.assert_allclose(ours.sparse().toarray(), ours.dense(), rtol=1e-12, atol=1e-6)
    np.testing.assert_allclose(ours.rhs * scale, theirs.rhs * scale, atol=1e-5 * np.abs(theirs.rhs * scale).max())


def test_other_problems_are_left_to_the_other_kernels() -> None:
    problem = scene()
    for wanted in (shared((0,)), shared((2,)), Shared(tuple(place_of(1)))):
        assert not applies(problem, wanted, AUTO)
    focal = shared(FOCAL)
    assert not applies(problem, focal, dataclasses.replace(AUTO, kernels="numpy"))
    assert not applies(dataclasses.replace(problem, fixed=np.arange(9) == 0), focal, AUTO)
    rig = dataclasses.replace(problem.observations, camera=problem.observations.point % 3)
    assert not applies(dataclasses.replace(problem, observations=rig), focal, AUTO)
    with pytest.raises(ConfigError, match="trust_region"):
        solve_cameras(problem, focal, SolverOptions(trust_region="diag"), clock=lambda: 0.0, on_iteration=None)
