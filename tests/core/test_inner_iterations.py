# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core import native_kernels
from ba_node.core.kernels import Kernels
from ba_node.core.numpy_kernels import NumpyKernels
from ba_node.core.objective import Objective
from tests.core.kernels import COST_MODELS, SHAPES, Make, built, made, near, pair, some_behind


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
@pytest.mark.parametrize("inner_iterations", [0, 2])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_native_goes_back_where_a_step_was_not_taken(
    shape: dict[str, object], inner_iterations: int, make_problem: Make
) -> None:
    """A step writes over what was kept where it began; that comes back to the bit if the step is rejected."""
    problem = make_problem(start_error=0.02, **shape)[0]
    kernels = native_kernels.make(problem, SolverOptions(kernels="native"))
    value = kernels.linearise(problem.start)
    system = kernels.damp("diag", 1e-2)
    before = [system.dense().copy(), system.rhs.copy(), *kernels.diagonals(), kernels.gradient()]
    step = system.solve_dense()
    assert step is not None
    kernels.step(problem.start, system, step, inner_iterations)
    system = kernels.damp("diag", 1e-2)
    after = [system.dense(), system.rhs, *kernels.diagonals(), kernels.gradient()]
    for one, other in zip(after, before, strict=True):
        np.testing.assert_array_equal(one, other)
    assert kernels.linearise(problem.start) == value


@built
def test_native_knows_once_where_a_step_ended(make_problem: Make) -> None:
    problem = make_problem()[0]
    kernels = native_kernels.make(problem, SolverOptions(kernels="native"))
    assert isinstance(kernels, native_kernels.NativeKernels)
    kernels.linearise(problem.start)
    system = kernels.damp("diag", 1e-2)
    state = kernels.step(problem.start, system, np.zeros(system.unknowns), 2).state
    assert kernels._kernel.linearise_prepared()
    assert not kernels._kernel.linearise_prepared()
    kernels.linearise(state)
    assert not kernels._kernel.linearise_prepared()


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


@pytest.mark.parametrize("backend", ["numpy", pytest.param("native", marks=built)])
def test_points_step_for_no_less_than_the_solve_ends_for(backend: str, make_problem: Make) -> None:
    """What a point's step promises is told by the gain of an exact one; near the end it is that, to a tenth or so."""
    problem, _ = make_problem(start_error=0.002)
    of_point, options = problem.observations.point, SolverOptions(kernels=backend, function_tolerance=0.0)
    start = native_kernels.make(problem, options).iterate_points(problem.start, 1)[1]
    problem = dataclasses.replace(problem, start=start)
    exact, hasty = (
        native_kernels.make(problem, dataclasses.replace(options, function_tolerance=tolerance))
        .iterate_points(start, 1)[1]
        .points
        for tolerance in (0.0, 1e-2)
    )
    before, after = (
        np.bincount(of_point, Objective(problem, options).point_rows(s).cost)
        for s in (start, dataclasses.replace(start, points=exact))
    )
    promise, moved = (before - after) / before, np.any(hasty != start.points, axis=1)
    assert moved[promise > 2e-4].all() and not moved[promise < 5e-5].any()
    assert 0 < np.count_nonzero(moved) < np.count_nonzero(np.any(exact != start.points, axis=1))
    np.testing.assert_array_equal(hasty[moved], exact[moved])


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
