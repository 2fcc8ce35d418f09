# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on keyframes: derivatives, their part of every equation, and what they do to a solution."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import scipy

from ba_node import native
from ba_node.config import ConfigError, SolverOptions
from ba_node.core import covariance, geometry, native_kernels, parameterisation, reduced, solver
from ba_node.core.factors import FactorSum, RelativePoses
from ba_node.core.kernels import Kernels
from ba_node.core.linear import PcgLimits
from ba_node.core.methods import METHODS
from ba_node.core.objective import Objective
from ba_node.core.priors import CustomFactors, Directions, PosePriors
from ba_node.core.problem import KeyframeFactors, Observations, PointPriors, Problem, ProblemError, State
from ba_node.core.result import Status

Make = Callable[..., tuple[Problem, State]]
built = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")
BACKENDS = ["numpy", pytest.param("native", marks=built)]
SHAPES: list[dict[str, object]] = [
    {},
    {"stereo": True, "depth": True, "fixed": 2},
    {"free_intrinsics": True},
    {"fixed": 0},
    {"fixed": 4},
    {"keyframes": 12, "seen_share": 0.05, "points": 60},
]


def relative_poses(state: State, pairs: list[tuple[int, int]], seed: int = 1, **fields: object) -> RelativePoses:
    """Return noisy measurements of pairs of keyframes at a state, with full weights of unlike size."""
    rng = np.random.default_rng(seed)
    i, j = np.array(pairs).T
    back = geometry.inverse(state.rotation[j], state.translation[j])
    rotation, translation = geometry.compose(state.rotation[i], state.translation[i], *back)
    n = len(pairs)
    root = np.diag([30.0, 20.0, 40.0, 9.0, 8.0, 7.0]) + rng.normal(size=(n, 6, 6))
    noise = rng.normal(0.0, 0.05, (n, 6))
    made = RelativePoses(np.array(pairs), rotation @ geometry.so3_exp(noise[:, :3]), translation + noise[:, 3:], root)
    return dataclasses.replace(made, **fields)  # type: ignore[arg-type]


def with_factors(make_problem: Make, **shape: object) -> Problem:
    """Return a problem with factors: consecutive, far apart, twice on a pair, in both orders, on fixed keyframes."""
    problem, truth = make_problem(start_error=0.02, **shape)
    n = problem.n_keyframes
    pairs = [*((k, k + 1) for k in range(n - 1)), (n - 1, 0), (2, 1), (1, 3)]
    kinds = (
        relative_poses(truth, pairs, loss="cauchy", loss_scale=2.0),
        relative_poses(truth, [(3, 4), (4, 2)], seed=2, loss="huber", loss_scale=1.5),
        relative_poses(truth, [(0, 3)], seed=3),
        relative_poses(truth, [(0, 4), (2, 4)], seed=4, loss="geman_mcclure", loss_scale=3.0),
    )
    return dataclasses.replace(problem, factors=(*kinds, *single_keyframe_factors(truth, n)))


@dataclasses.dataclass(frozen=True)
class EqualHeights(CustomFactors):
    """Factors as a user writes them: two keyframes are as high as each other, to 0.1 m."""

    def residuals(self, state: State) -> np.ndarray:
        height = -np.einsum("nij,ni->nj", state.rotation, state.translation)[:, 2]
        return np.asarray((height[self.keyframes[:, 1]] - height[self.keyframes[:, 0]])[:, None] / 0.1)


def single_keyframe_factors(truth: State, n: int) -> tuple[KeyframeFactors, ...]:
    """Return priors, directions and factors of one's own, all a little off the truth."""
    rng = np.random.default_rng(7)
    at = np.array([0, n - 1, 2, 2])
    rotation, centre = geometry.inverse(truth.rotation[at], truth.translation[at])
    arm = rng.normal(0.0, 0.3, (4, 3))
    where = centre + (rotation @ arm[:, :, None])[..., 0] + rng.normal(0.0, 0.05, (4, 3))
    root = np.diag([9.0, 8.0, 7.0, 5.0, 4.0, 3.0]) + 0.3 * rng.normal(size=(4, 6, 6))
    turned = rotation @ geometry.so3_exp(rng.normal(0.0, 0.05, (4, 3)))
    down = np.tile([0.0, 0.6, -0.8], (4, 1))
    seen = (truth.rotation[at] @ down[:, :, None])[..., 0]
    return (
        PosePriors(at[:, None], turned, where, arm, root, "cauchy", 2.0),
        Directions(at[:, None], down, seen[::-1], np.array([0.3, 0.5, 0.4, 0.6]), "huber", 1.5),
        EqualHeights(np.array([[0, 3], [3, 1]])),
    )


def near(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-11) -> None:
    """Assert that two arrays agree relative to their largest entry."""
    assert a.shape == b.shape
    scale = max(float(np.abs(a).max(initial=0.0)), 1e-300)
    assert float(np.abs(a - b).max(initial=0.0)) <= tolerance * scale


def stepped(state: State, step: np.ndarray, kind: str = "local") -> State:
    """Return a state after a step (n_kf, 6)."""
    rotation, translation = parameterisation.retract(kind, state.rotation, state.translation, step)
    return dataclasses.replace(state, rotation=rotation, translation=translation)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.02, 1.0, 3.0])
def test_jacobians_are_those_of_differences(angle: float, make_problem: Make) -> None:
    """Also for measurements far from the state."""
    problem, truth = make_problem()
    factors = relative_poses(truth, [(0, 1), (3, 1), (2, 4)])
    turn = geometry.so3_exp(angle * np.array([[1.0, 0.0, 0.0], [0.6, -0.8, 0.0], [0.48, 0.6, 0.64]]))
    factors = dataclasses.replace(factors, rotation=factors.rotation @ turn)
    jacobian = factors.jacobians(problem.start)
    h = 1e-6
    for place in range(2):
        for k in range(6):
            steps = np.zeros((3, problem.n_keyframes, 6))
            steps[np.arange(3), factors.keyframes[:, place], k] = h
            moved = [
                [factors.residuals(stepped(problem.start, sign * steps[n]))[n] for sign in (1, -1)] for n in range(3)
            ]
            numeric = np.array([(a - b) / (2.0 * h) for a, b in moved])
            near(jacobian[:, place, :, k], numeric, 1e-6)


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


def linearised(problem: Problem, options: SolverOptions, backend: str) -> Kernels:
    """Return kernels linearised at the start."""
    kernels = native_kernels.make(problem, dataclasses.replace(options, kernels=backend))
    kernels.linearise(problem.start)
    return kernels


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


@pytest.mark.parametrize("backend", BACKENDS)
def test_factors_alone_are_solved(backend: str, make_problem: Make) -> None:
    """No observation and no point: the chain ends where it was measured."""
    problem, truth = make_problem()
    none = {name: array[:0] for name, array in vars(problem.observations).items()}
    start = dataclasses.replace(problem.start, points=np.empty((0, 3)))
    chain = relative_poses(truth, [(0, 1), (1, 2), (2, 3), (3, 4)])
    problem = dataclasses.replace(
        problem, start=start, observations=dataclasses.replace(problem.observations, **none), factors=(chain,)
    )
    result = solver.solve(problem, dataclasses.replace(SolverOptions(), kernels=backend, function_tolerance=0.0))
    assert result.status.usable
    assert result.objective_after < 1e-18
    back = geometry.inverse(result.state.rotation[1:], result.state.translation[1:])
    rotation, translation = geometry.compose(result.state.rotation[:-1], result.state.translation[:-1], *back)
    near(chain.rotation, rotation, 1e-9)
    near(chain.translation, translation, 1e-9)
    empty = dataclasses.replace(problem, factors=())
    assert solver.solve(empty, SolverOptions()).status == Status.SKIPPED


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_outlier_bends_nothing_else(backend: str, make_problem: Make) -> None:
    """One step of 60 m among sound ones: with Cauchy's loss the others end as if it were not there."""
    problem, truth = make_problem(keyframes=6, start_error=0.001, noise_px=0.1, stereo=True)
    pairs = [(k, k + 1) for k in range(5)]
    root = np.broadcast_to(np.diag([50.0, 50.0, 50.0, 10.0, 10.0, 10.0]), (5, 6, 6))
    sound = relative_poses(truth, pairs, root_information=root, loss="cauchy", loss_scale=3.0)
    jumped = sound.translation.copy()
    jumped[2, 0] += 60.0
    options = dataclasses.replace(SolverOptions(), kernels=backend, function_tolerance=1e-12)
    others = sound.take(np.array([0, 1, 3, 4]), np.arange(6))
    ends = [
        solver.solve(dataclasses.replace(problem, factors=(kind,)), options).state
        for kind in (others, dataclasses.replace(sound, translation=jumped))
    ]
    moved = np.linalg.norm(ends[1].translation - ends[0].translation, axis=1)
    assert moved.max() < 1e-3


def test_covariance_counts_factors(make_problem: Make) -> None:
    """A precise factor between a free and a fixed keyframe makes the free one precise, at the same unit variance."""
    problem, truth = make_problem(noise_px=1.0, start_error=0.001, stereo=True)
    tight = relative_poses(truth, [(0, 4)], root_information=1e5 * np.eye(6)[None])
    measured = geometry.compose(
        truth.rotation[0], truth.translation[0], *geometry.inverse(truth.rotation[4], truth.translation[4])
    )
    tight = dataclasses.replace(tight, rotation=measured[0][None], translation=measured[1][None])
    options = SolverOptions()
    found = []
    for factors in ((), (tight,)):
        posed = dataclasses.replace(problem, factors=factors)
        state = solver.solve(posed, options).state
        found.append(covariance.pose_covariances(posed, state, options, np.empty((4, 6, 0))))
    plain, precise = (np.sqrt(np.trace(one[3])) for one in found)
    assert precise < 1e-3 * plain


def test_bad_factors_are_named(make_problem: Make) -> None:
    problem, truth = make_problem()
    good = relative_poses(truth, [(0, 1), (1, 2)])
    bad = {
        "out of range": {"keyframes": np.array([[0, 1], [1, 9]])},
        "in itself": {"keyframes": np.array([[0, 1], [2, 2]])},
        "not finite": {"translation": np.full((2, 3), np.nan)},
        "no rotation": {"rotation": 2.0 * good.rotation},
        "shape": {"root_information": np.eye(6)},
        "loss 'tukey'": {"loss": "tukey"},
        "scale": {"loss_scale": 0.0},
    }
    for text, fields in bad.items():
        wrong = dataclasses.replace(good, **fields)  # type: ignore[arg-type]
        with pytest.raises(ProblemError, match=text):
            dataclasses.replace(problem, factors=(wrong,)).check()


def test_derivatives_of_priors_and_directions_are_those_of_differences(make_problem: Make) -> None:
    problem, truth = make_problem()
    for kind in single_keyframe_factors(truth, problem.n_keyframes):
        state, places = problem.start, range(kind.keyframes.shape[1])
        analytic, h = kind.jacobians(state), 1e-6
        for place in places:
            for axis in range(6):
                step = np.zeros((len(kind.keyframes), problem.n_keyframes, 6))
                step[np.arange(len(step)), kind.keyframes[:, place], axis] = h
                ends = [
                    np.array([kind.residuals(stepped(state, sign * one))[i] for i, one in enumerate(step)])
                    for sign in (1.0, -1.0)
                ]
                difference = (ends[0] - ends[1]) / (2.0 * h)
                assert np.abs(analytic[:, place, :, axis] - difference).max() < 1e-6, (type(kind), place, axis)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_prior_of_a_point_is_its_mahalanobis_distance(backend: str, make_problem: Make) -> None:
    """The objective grows by half the squared distance; the optimum is that of scipy's weighted mean."""
    problem, truth = make_problem(start_error=0.0, stereo=True, noise_px=0.0)
    rng = np.random.default_rng(3)
    a = rng.normal(size=(2, 3, 3))
    covariance_ = 1e-4 * (a @ np.swapaxes(a, 1, 2) + 0.5 * np.eye(3))
    off = np.array([[0.01, -0.02, 0.03], [0.02, 0.01, -0.01]])
    priors = PointPriors(np.array([4, 11]), truth.points[[4, 11]] - off, covariance_)
    options = dataclasses.replace(SolverOptions(), kernels=backend, loss="squared", function_tolerance=1e-14)
    problem = dataclasses.replace(problem, start=truth, point_priors=priors, fixed=np.ones(problem.n_keyframes, bool))
    result = solver.solve(problem, options)
    expected = 0.5 * sum(e @ np.linalg.inv(c) @ e for e, c in zip(off, covariance_, strict=True))
    assert result.objective_before == pytest.approx(expected, rel=1e-5)
    assert result.state.translation.shape == truth.translation.shape
    loose = dataclasses.replace(
        problem, observations=Observations(*(v[:0] for v in vars(problem.observations).values()))
    )
    alone = solver.solve(loose, options).state.points[[4, 11]]
    np.testing.assert_allclose(alone, priors.position, atol=1e-6)
