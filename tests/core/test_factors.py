# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on keyframes: derivatives, their part of every equation, and what they do to a solution."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy

from ba_node.config import ConfigError, SolverOptions
from ba_node.core import native_kernels, reduced, solver
from ba_node.core.factors import FactorSum, RelativePoses
from ba_node.core.linear import PcgLimits
from ba_node.core.methods import METHODS
from ba_node.core.objective import Objective
from ba_node.core.problem import State
from tests.core.factors import (
    BACKENDS,
    Make,
    built,
    linearised,
    near,
    relative_poses,
    stepped,
    with_factors,
)

SHAPES: list[dict[str, object]] = [
    {},
    {"stereo": True, "depth": True, "fixed": 2},
    {"free_intrinsics": True},
    {"fixed": 0},
    {"fixed": 4},
    {"keyframes": 12, "seen_share": 0.05, "points": 60},
]


@pytest.mark.parametrize("kind", ["local", "global"])
def test_the_gradient_has_the_taylor_slope(kind: str, make_problem: Make) -> None:
    """What is left after the first-order term falls with the square of the step."""
    problem = with_factors(make_problem, fixed=1)
    factors = FactorSum(problem.factors, problem.fixed, kind)
    terms = factors.linearise(problem.start)
    assert terms.value == pytest.approx(factors.value(problem.start), rel=1e-14)
    step = np.random.default_rng(0).normal(size=(problem.n_keyframes, 6)) * ~problem.fixed[:, None]
    slope = float(np.sum(terms.gradient * step[~problem.fixed]))
    taus = (1e-3, 1e-4)
    left = [abs(factors.value(stepped(problem.start, t * step, kind)) - terms.value - t * slope) for t in taus]
    assert np.log10(left[0] / left[1]) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("kind", ["local", "global"])
def test_blocks_are_the_products_of_the_jacobians(kind: str, make_problem: Make) -> None:
    """Against the dense J'WJ of numeric derivatives, weights fixed."""
    problem = with_factors(make_problem, fixed=1)
    squared = tuple(
        dataclasses.replace(one, loss="squared") for one in problem.factors if isinstance(one, RelativePoses)
    )
    factors = FactorSum(squared, problem.fixed, kind)
    terms = factors.linearise(problem.start)
    free, n, h = np.flatnonzero(~problem.fixed), problem.n_keyframes, 1e-6
    columns = []
    for k in free:
        for i in range(6):
            step = np.zeros((n, 6))
            step[k, i] = h
            ends = (stepped(problem.start, sign * step, kind) for sign in (1, -1))
            a, b = (np.concatenate([one.residuals(end).ravel() for one in squared]) for end in ends)
            columns.append((a - b) / (2.0 * h))
    jacobian = np.stack(columns, axis=1)
    dense = terms.pairs.matrix(len(free), 6).toarray() + scipy.linalg.block_diag(*terms.diagonal)
    near(dense, jacobian.T @ jacobian, 1e-6)
    x = np.random.default_rng(0).normal(size=(len(free), 6))
    assert terms.curvature(x) == pytest.approx(float(x.ravel() @ dense @ x.ravel()), rel=1e-12)


@built
@pytest.mark.parametrize("shape", SHAPES)
def test_native_agrees_with_numpy(shape: dict[str, object], make_problem: Make) -> None:
    problem, options = with_factors(make_problem, **shape), SolverOptions(loss="huber")
    oracle, kernels = (linearised(problem, options, name) for name in ("numpy", "native"))
    plain = dataclasses.replace(problem, factors=())
    without = linearised(plain, options, "numpy")
    assert oracle.gradient_norm != pytest.approx(without.gradient_norm, rel=1e-6)
    assert kernels.gradient_norm == pytest.approx(oracle.gradient_norm, rel=1e-11)
    assert kernels.objective(problem.start) == pytest.approx(oracle.objective(problem.start), rel=1e-12)
    assert oracle.objective(problem.start) > without.objective(problem.start)
    (d_c, d_p), (n_c, n_p) = oracle.diagonals(), kernels.diagonals()
    near(d_c, n_c)
    near(d_p, n_p)
    a, b = (k.reduce(1e-3 * d_c + 1e-3, 1e-3 * d_p + 1e-3) for k in (oracle, kernels))
    near(a.rhs, b.rhs)
    near(a.dense(), b.dense())
    near(a.sparse().toarray(), b.sparse().toarray())
    near(a.dense(), np.asarray(a.sparse().toarray()))
    near(a.diagonal_blocks()[0], b.diagonal_blocks()[0])
    x = np.random.default_rng(0).normal(size=len(a.rhs))
    near(a.product(x), b.product(x))
    near(a.product(x), a.dense() @ x)
    step = np.asarray(np.linalg.solve(a.dense(), a.rhs), dtype=np.float64)
    (_, points_a, gain_a), (_, points_b, gain_b) = a.back_substitute(step), b.back_substitute(step)
    near(points_a, points_b, 1e-8)
    assert gain_b == pytest.approx(gain_a, rel=1e-8)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_every_linear_solver_gives_the_same_step(shape: dict[str, object], backend: str, make_problem: Make) -> None:
    problem = with_factors(make_problem, **shape)
    kernels = linearised(problem, SolverOptions(loss="huber"), backend)
    system = kernels.damp("diag", 1e-3)
    exact = np.linalg.solve(system.dense(), system.rhs)
    near(exact, system.solve_dense(), 1e-8)  # type: ignore[arg-type]
    if isinstance(system, native_kernels.NativeSystem):
        assert system.factor_size(10**6, 1e12).complete
    near(exact, system.solve_sparse(), 1e-8)  # type: ignore[arg-type]
    for kind in ("none", "schur_block", "schur_diag", "b_block", "b_diag"):
        for formed in (True, False):
            options = dataclasses.replace(
                SolverOptions(), linear_solver="pcg", preconditioner=kind, t_eps=1e-13, max_linear_iterations=5000
            )
            limits = PcgLimits(1e-13, 5000)
            found = reduced.ReducedSolver(options)._pcg(system, kernels.diagonals, limits, kind, formed=formed)
            assert found.x is not None
            near(exact, found.x, 5e-6)


@pytest.mark.parametrize("parameterisation_kind", ["local", "global"])
@pytest.mark.parametrize("side", ["points", "none", "adaptive"])
def test_every_side_takes_the_same_step(side: str, parameterisation_kind: str, make_problem: Make) -> None:
    problem, options = with_factors(make_problem), SolverOptions(parameterisation=parameterisation_kind)
    steps = []
    for eliminated in ("points", side):
        kernels = native_kernels.make(problem, dataclasses.replace(options, kernels="numpy", schur=eliminated))
        kernels.linearise(problem.start)
        system = kernels.damp("diag", 1e-3)
        dense = system.dense()
        near(dense, system.sparse().toarray())
        x = np.random.default_rng(0).normal(size=len(system.rhs))
        near(dense @ x, system.product(x))
        steps.append(system.back_substitute(np.asarray(np.linalg.solve(dense, system.rhs), np.float64)))
    for a, b in zip(*steps, strict=True):
        near(np.asarray(a), np.asarray(b), 1e-7)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("inner_iterations", [0, 3])
def test_a_step_knows_the_objective_where_it_leads(inner_iterations: int, backend: str, make_problem: Make) -> None:
    problem, options = with_factors(make_problem), SolverOptions(loss="huber")
    kernels = linearised(problem, options, backend)
    objective = Objective(problem, options)
    state = problem.start
    for _ in range(3):
        system = kernels.damp("diag", 1e-3)
        x = system.solve_dense()
        assert x is not None
        moved = kernels.step(state, system, x, inner_iterations)
        assert moved.objective == pytest.approx(objective.value(moved.state), rel=1e-12)
        state = dataclasses.replace(moved.state)
        # The first is taken up from the inner iterations, the second found anew: they are the same.
        taken_up, norm = kernels.linearise(moved.state), kernels.gradient_norm
        assert taken_up == pytest.approx(moved.objective, rel=1e-12)
        assert kernels.linearise(state) == pytest.approx(taken_up, rel=1e-12)
        assert kernels.gradient_norm == pytest.approx(norm, rel=1e-9)
    value, iterated = kernels.iterate_points(state, 2)
    assert value == pytest.approx(objective.value(iterated), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["local", "global"])
@pytest.mark.parametrize("backend", ["numpy", pytest.param("auto", marks=built)])
def test_scipy_finds_the_same_optimum(backend: str, name: str, make_problem: Make) -> None:
    """Points and factors together; scipy gets residuals alone and differentiates them itself."""
    problem, truth = make_problem(keyframes=4, points=12, start_error=0.01)
    factors = relative_poses(truth, [(0, 1), (1, 2), (2, 3), (3, 1)])
    problem = dataclasses.replace(problem, factors=(factors,))
    options, free = SolverOptions(parameterisation=name), ~problem.fixed
    objective = Objective(problem, options)
    n = 6 * int(free.sum())

    def state_at(x: np.ndarray) -> State:
        step = np.zeros((problem.n_keyframes, 6))
        step[free] = x[:n].reshape(-1, 6)
        return dataclasses.replace(stepped(problem.start, step), points=problem.start.points + x[n:].reshape(-1, 3))

    def residuals(x: np.ndarray) -> np.ndarray:
        state = state_at(x)
        return np.concatenate([objective.point_rows(state).residual.ravel(), factors.residuals(state).ravel()])

    found = scipy.optimize.least_squares(residuals, np.zeros(n + 36), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    options = dataclasses.replace(options, kernels=backend, function_tolerance=1e-15, max_iterations=200)
    result = solver.solve(problem, options)
    assert result.objective_after == pytest.approx(found.cost, rel=1e-9)
    expected = state_at(found.x)
    near(expected.rotation, result.state.rotation, 1e-6)
    near(expected.translation, result.state.translation, 1e-6)


@pytest.mark.slow
def test_named_methods_end_where_the_default_ends(make_problem: Make) -> None:
    problem = with_factors(make_problem, points=60)
    problem = dataclasses.replace(problem, factors=problem.factors[2:3])
    exact = dataclasses.replace(SolverOptions(), function_tolerance=1e-14, max_iterations=500)
    expected = solver.solve(problem, exact).objective_after
    for name in ("lma_cd", "bal", "dinm", "adinm", "local_dinm"):
        options = dataclasses.replace(METHODS[name], max_iterations=500)
        assert solver.solve(problem, options).objective_after == pytest.approx(expected, rel=1e-5), name


def test_eliminating_keyframes_is_refused(make_problem: Make) -> None:
    problem = with_factors(make_problem)
    with pytest.raises(ConfigError, match="schur = cameras"):
        solver.solve(problem, dataclasses.replace(SolverOptions(), schur="cameras"))


def test_what_is_remembered_of_a_window_is_not_taken_for_another(make_problem: Make) -> None:
    """The same steps with other keyframes fixed, and other steps with the same, couple other pairs."""
    problem = with_factors(make_problem, fixed=1)
    other = np.roll(problem.fixed, 2)
    steps = tuple(one for one in problem.factors if isinstance(one, RelativePoses))
    fewer = tuple(one.take(np.arange(len(one) - 1), np.arange(problem.n_keyframes)) for one in steps)
    for factors, fixed in ((steps, problem.fixed), (steps, other), (fewer, problem.fixed), (steps, problem.fixed)):
        found = FactorSum(factors, fixed)
        number = np.cumsum(~fixed) - 1
        ends = np.concatenate([one.keyframes for one in factors])
        free = number[np.sort(ends[~fixed[ends].any(axis=1)], axis=1)]
        expected = np.unique(free, axis=0)
        np.testing.assert_array_equal(np.stack([found.rows, found.columns], axis=1), expected)
