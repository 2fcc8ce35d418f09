# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels in C++ against those in numpy, on every quantity; and the inner iterations over points."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core import cameras, native_kernels, numpy_kernels, reduced, solver
from ba_node.core.kernels import Kernels
from ba_node.core.numpy_kernels import NumpyKernels
from ba_node.core.objective import Objective
from ba_node.core.problem import Observations, Problem, State
from ba_node.core.result import Status

Make = Callable[..., tuple[Problem, State]]
SHAPES = {
    "pinhole": {"distorted": False},
    "distorted": {},
    "stereo": {"stereo": True},
    "depth": {"depth": True, "stereo": True},
    "own intrinsics": {"free_intrinsics": True},
    "nothing fixed": {"fixed": 0},
    "most fixed": {"fixed": 4},
}
COST_MODELS = [
    SolverOptions(),
    SolverOptions(loss="huber", loss_scale_px=1.5),
    SolverOptions(loss="huber", cheirality="constant"),
    SolverOptions(cheirality="drop"),
    SolverOptions(loss="cauchy", loss_scale_px=1.5, cheirality="constant"),
]
built = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")


def some_behind(problem: Problem) -> Problem:
    """Turn every seventh point to the other side of the cameras."""
    points = problem.start.points.copy()
    points[::7, 2] *= -1.0
    return dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points))


def made(problem: Problem, options: SolverOptions, kernels: str) -> Kernels:
    """Return numpy's kernels or those in C++."""
    return native_kernels.make(problem, dataclasses.replace(options, kernels=kernels))


def pair(problem: Problem, options: SolverOptions) -> tuple[Kernels, Kernels]:
    """Return the kernels of a problem in numpy and in C++, linearised at the start."""
    oracle, kernels = (made(problem, options, name) for name in ("numpy", "native"))
    assert oracle.linearise(problem.start) == pytest.approx(kernels.linearise(problem.start), rel=1e-12)
    return oracle, kernels


def near(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-11) -> None:
    """Assert that two arrays agree relative to their largest entry."""
    assert a.shape == b.shape
    scale = max(float(np.abs(a).max(initial=0.0)), 1e-300)
    assert float(np.abs(a - b).max(initial=0.0)) <= tolerance * scale


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
@pytest.mark.parametrize("options", COST_MODELS)
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_native_iterates_points_like_numpy(
    shape: dict[str, object], options: SolverOptions, make_problem: Make
) -> None:
    problem, _ = make_problem(start_error=0.02, **shape)
    oracle, kernels = pair(problem, options)
    (value_a, state_a), (value_b, state_b) = (k.iterate_points(problem.start, 3) for k in (oracle, kernels))
    assert value_b == pytest.approx(value_a, rel=1e-9)
    near(state_a.points, state_b.points, 1e-7)


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
@pytest.mark.parametrize("options", COST_MODELS)
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_native_linearises_where_inner_iterations_ended(
    shape: dict[str, object], options: SolverOptions, make_problem: Make
) -> None:
    """What inner iterations kept of their last look is what a linearisation there finds anew."""
    problem = some_behind(make_problem(start_error=0.02, **shape)[0])
    kernels = native_kernels.make(problem, options)
    kernels.linearise(problem.start)
    system = kernels.damp("diag", 1e-2)
    step = system.solve_dense()
    assert step is not None
    first = kernels.step(problem.start, system, step.copy(), 3).state
    oracle = made(problem, options, "numpy")

    def agree() -> None:
        assert kernels.linearise(first) == pytest.approx(oracle.linearise(first), rel=1e-12)
        assert kernels.gradient_norm == pytest.approx(oracle.gradient_norm, rel=1e-9)
        for ours, others in zip(kernels.diagonals(), oracle.diagonals(), strict=True):
            near(others, ours)
        a, b = (k.damp("diag", 1e-3) for k in (oracle, kernels))
        near(a.dense(), b.dense(), 1e-9)
        near(a.rhs, b.rhs, 1e-9)

    agree()
    # Another step was taken since, and rejected: the linearisation is one from the beginning.
    kernels.step(first, kernels.damp("diag", 1.0), step, 3)
    agree()


@built
def test_native_knows_once_where_inner_iterations_ended(make_problem: Make) -> None:
    kernels = native_kernels.make(make_problem()[0], SolverOptions(kernels="native"))
    assert isinstance(kernels, native_kernels.NativeKernels)
    iterated = kernels.iterate_points(make_problem()[0].start, 2)[1]
    assert kernels._kernel.linearise_prepared()
    assert not kernels._kernel.linearise_prepared()
    kernels.linearise(iterated)
    assert not kernels._kernel.linearise_prepared()


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
def test_inner_iterations_move_points_only_and_never_make_one_worse(backend: str, make_problem: Make) -> None:
    problem, _ = make_problem(start_error=0.05)
    kernels = native_kernels.make(problem, SolverOptions(loss="huber", kernels=backend))
    value, state = kernels.iterate_points(problem.start, 3)
    objective = Objective(problem, SolverOptions(loss="huber"))
    assert value == pytest.approx(objective.value(state), rel=1e-12)
    before, after = (
        np.bincount(problem.observations.point, objective.point_rows(s).cost) for s in (problem.start, state)
    )
    assert np.all(after <= before)
    assert value < 0.5 * objective.value(problem.start)
    np.testing.assert_array_equal(state.rotation, problem.start.rotation)


@pytest.mark.parametrize("shape", [{}, {"stereo": True, "depth": True}, {"free_intrinsics": True}])
@pytest.mark.parametrize("steps", [1, 3])
def test_rows_kept_by_inner_iterations_are_those_of_the_state(
    shape: dict[str, object], steps: int, make_problem: Make
) -> None:
    """After a step the linearisation takes up what inner iterations worked out; it is as good as a fresh one."""
    problem, _ = make_problem(start_error=0.05, **shape)
    options = SolverOptions(loss="huber")
    kernels = NumpyKernels(problem, options)
    kernels.linearise(problem.start)
    system = kernels.damp("diag", 1e-4)
    x = system.solve_dense()
    assert x is not None
    moved = kernels.step(problem.start, system, x, steps)
    fresh = NumpyKernels(problem, options)
    assert kernels.linearise(moved.state) == pytest.approx(fresh.linearise(moved.state), rel=1e-13)
    for name in ("b", "c", "e", "gradient_c", "gradient_p"):
        near(getattr(kernels._equations, name), getattr(fresh._equations, name))


def test_rows_of_one_surrogate_do_not_serve_the_next(make_problem: Make) -> None:
    problem, _ = make_problem(start_error=1e-4)
    options = SolverOptions(loss="truncated_quadratic")
    kernels, fresh = NumpyKernels(problem, options), NumpyKernels(problem, options)
    kernels.graduate(0.1)
    kernels.linearise(problem.start)
    system = kernels.damp("diag", 1e-4)
    x = system.solve_dense()
    assert x is not None
    state = kernels.step(problem.start, system, x, 3).state
    first = kernels.linearise(state)
    kernels.graduate(10.0)
    fresh.graduate(10.0)
    assert kernels.linearise(state) == fresh.linearise(state) != first


@pytest.mark.parametrize("backend", ["numpy", pytest.param("native", marks=built)])
def test_points_whose_views_disagree_do_not_creep(
    backend: str, make_problem: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two views 40 px apart: within fifty steps as low as IRLS alone is after four hundred, and lower."""
    problem, _ = make_problem(keyframes=2, points=30)
    uv = problem.observations.uv.copy()
    uv[::2] += np.random.default_rng(3).normal(0.0, 40.0, (len(uv[::2]), 2))
    problem = dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, uv=uv))
    options = SolverOptions(loss="huber", loss_scale_px=1.0)

    def lowest(kernels: Kernels, rounds: int) -> float:
        value, state = np.inf, problem.start
        for _ in range(rounds):
            value, state = kernels.iterate_points(state, 10)
        return value

    quick = lowest(made(problem, options, backend), 5)
    monkeypatch.setattr("ba_node.core.inner_iterations._RADIAL", 0.0)
    creeping = [lowest(NumpyKernels(problem, options), rounds) for rounds in (5, 40)]
    assert quick < creeping[1] < creeping[0]
    assert quick == pytest.approx(1087.124648, abs=1e-5)


def test_iterating_what_is_at_its_best_changes_nothing(make_problem: Make) -> None:
    problem, _ = make_problem()
    kernels = NumpyKernels(problem, SolverOptions())
    value, state = kernels.iterate_points(problem.start, 20)
    for _ in range(20):
        before, (value, state) = value, kernels.iterate_points(state, 20)
    assert value == pytest.approx(before, rel=1e-14)
    assert kernels.linearise(state) == pytest.approx(value, rel=1e-13)


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
