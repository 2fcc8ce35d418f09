# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels in C++ against those in numpy, on every quantity; and the inner iterations over points."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core import cameras, native_kernels, numpy_kernels, reduced, scaling, solver
from ba_node.core.numpy_kernels import NumpyKernels
from ba_node.core.objective import Objective
from ba_node.core.problem import Observations, Problem, State
from ba_node.core.result import Status
from tests.core.kernels import COST_MODELS, SHAPES, Make, built, near, pair, some_behind


@built
@pytest.mark.parametrize("options", COST_MODELS)
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_native_agrees_with_numpy(shape: dict[str, object], options: SolverOptions, make_problem: Make) -> None:
    problem = some_behind(make_problem(start_error=0.02, **shape)[0])
    oracle, kernels = pair(problem, options)
    assert kernels.gradient_norm == pytest.approx(oracle.gradient_norm, rel=1e-11)
    assert kernels.objective(problem.start) == pytest.approx(oracle.objective(problem.start), rel=1e-12)
    d_c, d_p = oracle.diagonals()
    near(d_c, kernels.diagonals()[0])
    near(d_p, kernels.diagonals()[1])
    a, b = (k.reduce(1e-3 * d_c + 1e-3, 1e-3 * d_p + 1e-3) for k in (oracle, kernels))
    near(a.rhs, b.rhs)
    near(a.dense(), b.dense())
    near(a.sparse().toarray(), b.sparse().toarray())
    near(a.diagonal_blocks()[0], b.diagonal_blocks()[0])
    x = np.random.default_rng(0).normal(size=len(a.rhs))
    near(a.product(x), b.product(x))
    step = np.asarray(np.linalg.solve(a.dense(), a.rhs), dtype=np.float64)
    (_, points_a, gain_a), (_, points_b, gain_b) = a.back_substitute(step), b.back_substitute(step)
    near(points_a, points_b, 1e-8)
    assert gain_b == pytest.approx(gain_a, rel=1e-8)


@built
@pytest.mark.parametrize("damping", ["none", "identity", "diag", "inc"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_native_steps_as_numpy_does(shape: dict[str, object], damping: str, make_problem: Make) -> None:
    """Damping, dense Cholesky, and the state after the step with and without inner iterations; fixed keyframes stay."""
    problem, _ = make_problem(start_error=0.02, **shape)
    both = pair(problem, SolverOptions(loss="huber"))
    for inner_iterations in (0, 3):
        systems = [kernels.damp(damping, 1e-2) for kernels in both]
        near(systems[0].dense(), systems[1].dense())
        near(systems[0].rhs, systems[1].rhs)
        steps = [system.solve_dense() for system in systems]
        if steps[0] is None or steps[1] is None:
            assert damping == "none", "a damped system is positive definite"
            continue
        near(steps[0], steps[1], 1e-6)
        a, b = (
            kernels.step(problem.start, system, steps[0], inner_iterations)
            for kernels, system in zip(both, systems, strict=True)
        )
        assert b.predicted == pytest.approx(a.predicted, rel=1e-6)
        assert b.damping == pytest.approx(a.damping, rel=1e-6, abs=1e-300)
        assert b.before_inner == pytest.approx(a.before_inner, rel=1e-6)
        assert b.objective == pytest.approx(a.objective, rel=1e-6)
        assert (b.objective == b.before_inner) == (inner_iterations == 0)
        for field in dataclasses.fields(State):
            near(getattr(a.state, field.name), getattr(b.state, field.name), 1e-6)
        np.testing.assert_array_equal(b.state.rotation[problem.fixed], problem.start.rotation[problem.fixed])


@built
def test_a_step_that_is_not_finite_has_no_objective(make_problem: Make) -> None:
    problem, _ = make_problem()
    for kernels in pair(problem, SolverOptions()):
        system = kernels.damp("diag", 1e-3)
        moved = kernels.step(problem.start, system, np.full(len(system.rhs), np.nan), 3)
        assert np.isnan(moved.before_inner) and np.isnan(moved.objective)


@built
@pytest.mark.parametrize("n", [1, 7, 8, 9, 25, 65, 130])
def test_dense_cholesky_of_any_size(n: int, make_problem: Make) -> None:
    """Sizes around those of registers and blocks: n free keyframes, 6 n unknowns."""
    small, _ = make_problem()
    times = -(-n // small.n_keyframes)
    start, obs = small.start, small.observations
    count = small.n_keyframes * times
    state = State(
        np.tile(start.rotation, (times, 1, 1)),
        np.tile(start.translation, (times, 1)),
        np.tile(start.points, (times, 1)),
        start.intrinsics,
    )
    names = ("camera", "uv", "sigma_px", "depth_m", "depth_sigma_m")
    copies = {name: np.concatenate([getattr(obs, name)] * times) for name in names}
    copies["keyframe"] = np.concatenate([obs.keyframe + i * small.n_keyframes for i in range(times)])
    copies["point"] = np.concatenate([obs.point + i * small.n_points for i in range(times)])
    problem = Problem(state, np.arange(count) >= n, small.cameras, Observations(**copies))
    system = pair(problem, SolverOptions())[1].damp("diag", 1e-3)
    x = system.solve_dense()
    assert x is not None and len(x) == 6 * n
    near(system.dense() @ x, system.rhs, 1e-9)


@built
@pytest.mark.parametrize("kind", ["none", "identity", "diag", "inc"])
def test_native_measures_steps_as_numpy_does(kind: str, make_problem: Make) -> None:
    """By the diagonal that was not damped, whatever the damping."""
    problem, _ = make_problem(start_error=0.02)
    both = pair(problem, SolverOptions())
    x = np.random.default_rng(0).normal(size=6 * both[0].n_free)
    d_c, _ = scaling.scaled_space(kind, both[0].diagonals())
    expected = float(np.sum((d_c.ravel() * x) ** 2))
    for kernels in both:
        system = kernels.damp("diag", 1e3)
        assert system.length2(kind, x, kernels.diagonals) == pytest.approx(expected, rel=1e-10)
        for bad in (np.nan, np.inf):
            assert not np.isfinite(system.length2(kind, np.where(np.arange(len(x)) == 3, bad, x), kernels.diagonals))


@built
@pytest.mark.parametrize("model", ["shape", "fisheye"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_native_measures_residuals_as_numpy_does(shape: dict[str, object], model: str, make_problem: Make) -> None:
    """With points behind the cameras."""
    problem = some_behind(make_problem(start_error=0.02, **shape)[0])
    if model == "fisheye":
        kinds = problem.cameras.model.copy()
        kinds[-1] = cameras.Model.EQUIDISTANT
        problem = dataclasses.replace(problem, cameras=dataclasses.replace(problem.cameras, model=kinds))
    oracle, found = (native_kernels.residual_norms(problem, problem.start, name) for name in ("numpy", "native"))
    assert len(found) == len(problem.observations) > 100
    behind = np.isinf(oracle)
    assert 0 < np.count_nonzero(behind) < len(oracle)
    np.testing.assert_array_equal(np.isinf(found), behind)
    near(oracle[~behind], found[~behind])


@built
@pytest.mark.parametrize("backend", ["numpy", "native"])
def test_residuals_of_nothing_are_nothing(backend: str, make_problem: Make) -> None:
    problem = make_problem()[0]
    none = {name: getattr(problem.observations, name)[:0] for name in vars(problem.observations)}
    empty = dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, **none))
    assert native_kernels.residual_norms(empty, problem.start, backend).shape == (0,)


@built
@pytest.mark.parametrize("name", ["rational_polynomial", "equidistant"])
def test_native_has_every_camera_model(name: str, make_problem: Make) -> None:
    """One camera of the given model and one plumb_bob, in one rig."""
    problem, _ = make_problem(stereo=True)
    coefficients = np.array(
        [0.1, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.01] if "rational" in name else [0.02, -0.01, 3e-3, 1e-3]
    )
    model, params = cameras.parameters(name, np.array([400.0, 410.0, 320.0, 240.0]), coefficients)
    cams = problem.cameras
    both = dataclasses.replace(cams, model=np.array([model, 0], np.uint8), params=np.stack([params, cams.params[1]]))
    oracle, kernels = pair(dataclasses.replace(problem, cameras=both), SolverOptions(loss="huber"))
    systems = [kernel.reduce(*kernel.diagonals()).dense() for kernel in (oracle, kernels)]
    near(systems[0], systems[1])


@built
@pytest.mark.parametrize("options", COST_MODELS)
def test_native_sees_as_far_round_as_numpy(options: SolverOptions, make_problem: Make) -> None:
    """A fisheye and a plain camera in one rig, points on all sides of both."""
    problem, _ = make_problem(stereo=True, points=120, start_error=0.02)
    coefficients = np.array([0.01, -2e-3, 3e-4, -2e-5])
    model, params = cameras.parameters("equidistant", np.array([200.0, 210.0, 320.0, 240.0]), coefficients)
    cams = problem.cameras
    both = dataclasses.replace(cams, model=np.array([model, 0], np.uint8), params=np.stack([params, cams.params[1]]))
    rng = np.random.default_rng(3)
    points = rng.normal(size=(120, 3))
    points *= rng.uniform(2.0, 6.0, (120, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    start = dataclasses.replace(problem.start, points=points)
    problem = dataclasses.replace(problem, cameras=both, start=start)
    seen = Objective(problem, options)
    x_cam = seen.in_camera(start)[problem.observations.camera == 0]
    assert np.count_nonzero((x_cam[:, 2] < 0.0) & ~cameras.behind(x_cam, np.array([1], np.uint8))) > 50
    of_fisheye = (problem.observations.camera == 0)[:, None]
    uv = problem.observations.uv + np.where(of_fisheye, np.nan_to_num(seen.errors(start)) + rng.normal(), 0.0)
    problem = dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, uv=uv))
    expected, found = (native_kernels.residual_norms(problem, start, name) for name in ("numpy", "native"))
    np.testing.assert_array_equal(np.isinf(found), np.isinf(expected))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    oracle, kernels = pair(problem, options)
    systems = [kernel.reduce(*kernel.diagonals()).dense() for kernel in (oracle, kernels)]
    near(systems[0], systems[1])


@built
def test_native_numbers_images_of_many_keyframes_and_cameras(make_problem: Make) -> None:
    """More than 2^20 pairs of keyframe and camera, few of them seen, in no order."""
    small, _ = make_problem(stereo=True)
    cams, start, obs = small.cameras, small.start, small.observations
    more = dataclasses.replace(
        cams,
        rotation=np.tile(cams.rotation, (600, 1, 1)),
        translation=np.tile(cams.translation, (600, 1)),
        model=np.tile(cams.model, 600),
        params=np.tile(cams.params, (600, 1)),
    )
    state = dataclasses.replace(
        start, rotation=np.tile(start.rotation, (200, 1, 1)), translation=np.tile(start.translation, (200, 1))
    )
    spread = dataclasses.replace(
        obs, keyframe=995 - 5 * (obs.point % 7) + obs.keyframe, camera=2 * (599 - 3 * obs.point) + obs.camera
    )
    problem = Problem(state, np.tile(small.fixed, 200), more, spread)
    assert problem.n_keyframes * len(more.model) > 2**20
    oracle, kernels = pair(problem, SolverOptions())
    near(oracle.diagonals()[0], kernels.diagonals()[0])


@pytest.mark.parametrize("backend", ["numpy", pytest.param("native", marks=built)])
@pytest.mark.parametrize("linear_solver", ["cholesky", "pcg"])
def test_large_systems_are_solved_without_a_dense_s(
    backend: str, linear_solver: str, make_problem: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the limit for dense S at zero the solve takes the sparse and the matrix-free way to the same minimum."""
    problem, _ = make_problem(stereo=True, points=60)
    options = dataclasses.replace(
        SolverOptions(), kernels=backend, linear_solver=linear_solver, t_eps=1e-6, function_tolerance=1e-14
    )
    dense = solver.solve(problem, options)
    for module in (reduced, numpy_kernels):
        monkeypatch.setattr(module, "DENSE_LIMIT", 0)
    other = solver.solve(problem, options)
    assert other.objective_after == pytest.approx(dense.objective_after, rel=1e-9)


@built
def test_native_solves_end_where_numpy_ends(make_problem: Make) -> None:
    problem, _ = make_problem(stereo=True, depth=True)
    ends = [
        solver.solve(problem, dataclasses.replace(SolverOptions(), kernels=b, function_tolerance=1e-14))
        for b in ("numpy", "native")
    ]
    assert ends[1].objective_after == pytest.approx(ends[0].objective_after, rel=1e-10)


def test_native_is_refused_where_it_lacks_something(make_problem: Make) -> None:
    problem, _ = make_problem()
    options = SolverOptions(parameterisation="global", kernels="native")
    with pytest.raises(native_kernels.KernelsError, match="native"):
        native_kernels.make(problem, options)
    result = solver.solve(problem, options)
    assert result.status == Status.FAILED and "kernels native" in result.reason


def test_without_a_compiler_numpy_takes_over(make_problem: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "kernels", None)
    problem, _ = make_problem()
    assert isinstance(native_kernels.make(problem, SolverOptions()), NumpyKernels)
    assert solver.solve(problem, SolverOptions()).status.usable
