# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The loop: reaches the truth, never rises, never NaN, says why it stopped."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core import methods
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem, ProblemError, State
from ba_node.core.result import Iteration, Result, Status
from ba_node.core.solver import solve
from ba_node.io import bal

Make = Callable[..., tuple[Problem, State]]
SHAPES = [{}, {"stereo": True}, {"depth": True}, {"fixed": 2}, {"free_intrinsics": True, "points": 120, "keyframes": 6}]


def check(result: Result) -> None:
    """Assert what holds for every result."""
    assert result.state.is_finite()
    assert result.reason
    objectives = [row.objective for row in result.trace]
    assert all(b <= a for a, b in itertools.pairwise(objectives)), objectives


@pytest.mark.parametrize("method", list(methods.METHODS))
@pytest.mark.parametrize("shape", SHAPES)
def test_exact_data_is_fitted_exactly(method: str, shape: dict[str, object], make_problem: Make) -> None:
    problem, truth = make_problem(noise_px=0.0, **shape)
    options = dataclasses.replace(methods.options(method), max_iterations=120, function_tolerance=0.0)
    if problem.start.intrinsics.size:
        options = dataclasses.replace(options, t_eps=1e-3)
    result = solve(problem, options)
    check(result)
    if len(problem.observations.depth_m):
        return  # the depths are noisy
    assert result.objective_after < 1e-6 * result.objective_before, result.reason
    if int(problem.fixed.sum()) == 2 or len(problem.cameras.model) == 2:
        np.testing.assert_allclose(result.state.points, truth.points, atol=2e-3)


@pytest.mark.parametrize("tolerance", [1e-3, 0.0])
@pytest.mark.parametrize("kernels", ["numpy", "auto"])
def test_haste_leaves_for_later_what_the_state_does_not_need(
    kernels: str, tolerance: float, make_problem: Make
) -> None:
    problem, _ = make_problem(stereo=True)
    options = SolverOptions(kernels=kernels, function_tolerance=tolerance, max_iterations=6)
    calm, hasty = (solve(problem, options, weakest=True, in_haste=in_haste) for in_haste in (False, True))
    assert all(
        np.array_equal(*pair) for pair in zip(vars(calm.state).values(), vars(hasty.state).values(), strict=True)
    )
    assert np.isnan(hasty.trace[-1].gradient_norm) == (tolerance > 0.0)
    assert [row.gradient_norm for row in hasty.trace[:-1]] == [row.gradient_norm for row in calm.trace[:-1]]
    assert hasty.gradient_norm == calm.gradient_norm > 0.0
    assert hasty.weakest == calm.weakest > (0.0, 0.0)


def test_the_minimum_is_a_minimum(make_problem: Make) -> None:
    """At the end no random step lowers the robust objective: a route that uses no derivative."""
    problem, _ = make_problem(stereo=True)
    options = SolverOptions(loss="huber", function_tolerance=1e-14)
    result = solve(problem, options)
    objective = Objective(problem, options)
    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-4, 1e-5):
        keyframes = size * rng.normal(size=(problem.n_keyframes, 6)) * ~problem.fixed[:, None]
        points = size * rng.normal(size=(problem.n_points, 3))
        assert objective.value(objective.retract(result.state, keyframes, points)) > result.objective_after


def test_fixed_keyframes_do_not_move(make_problem: Make) -> None:
    problem, _ = make_problem(fixed=2)
    result = solve(problem, SolverOptions())
    np.testing.assert_array_equal(result.state.rotation[:2], problem.start.rotation[:2])
    np.testing.assert_array_equal(result.state.translation[:2], problem.start.translation[:2])


def test_huber_is_nearer_to_the_truth_than_squares_with_outliers(make_problem: Make) -> None:
    problem, truth = make_problem(stereo=True, points=80)
    uv = problem.observations.uv.copy()
    uv[::15] += 60.0
    problem = dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, uv=uv))
    errors = {}
    for loss in ("squared", "huber"):
        result = solve(problem, dataclasses.replace(SolverOptions(), loss=loss, max_iterations=60))
        check(result)
        errors[loss] = float(np.sqrt(np.mean((result.state.translation - truth.translation) ** 2)))
    assert errors["huber"] < 0.25 * errors["squared"], errors


def test_global_and_local_parameterisation_end_at_the_same_minimum(make_problem: Make) -> None:
    problem, _ = make_problem(stereo=True)
    ends = [
        solve(problem, dataclasses.replace(SolverOptions(), parameterisation=p, function_tolerance=1e-14))
        for p in ("local", "global")
    ]
    assert ends[0].objective_after == pytest.approx(ends[1].objective_after, rel=1e-9)


def test_pcg_and_cholesky_end_at_the_same_minimum(make_problem: Make) -> None:
    problem, _ = make_problem(stereo=True)
    ends = [
        solve(problem, dataclasses.replace(SolverOptions(), linear_solver=s, t_eps=1e-6, function_tolerance=1e-14))
        for s in ("cholesky", "pcg")
    ]
    assert ends[0].objective_after == pytest.approx(ends[1].objective_after, rel=1e-9)
    assert ends[0].linear_iterations == 0 and ends[1].linear_iterations > 0


def test_a_solve_is_repeatable_to_the_bit(make_problem: Make) -> None:
    problem, _ = make_problem(stereo=True, depth=True)
    a, b = solve(problem, SolverOptions()), solve(problem, SolverOptions())
    assert a.state.points.tobytes() == b.state.points.tobytes()


def test_the_caller_can_stop_it(make_problem: Make) -> None:
    problem, _ = make_problem()
    rows: list[Iteration] = []

    def stop_after_two(row: Iteration) -> bool:
        rows.append(row)
        return row.iteration < 2

    result = solve(problem, dataclasses.replace(SolverOptions(), function_tolerance=0.0), on_iteration=stop_after_two)
    assert result.status == Status.MAX_ITERATIONS and "stopped by the caller" in result.reason
    assert len(rows) == 3


class TestDegenerate:
    """Whatever comes, the result is finite and says why."""

    @pytest.mark.parametrize("method", list(methods.METHODS))
    @pytest.mark.parametrize("cheirality", ["keep", "constant", "drop"])
    def test_all_points_behind(self, method: str, cheirality: str, make_problem: Make) -> None:
        problem, truth = make_problem()
        start = dataclasses.replace(truth, points=truth.points * [1.0, 1.0, -1.0])
        options = dataclasses.replace(methods.options(method), cheirality=cheirality)
        check(solve(dataclasses.replace(problem, start=start), options))

    @pytest.mark.parametrize("method", list(methods.METHODS))
    def test_all_points_in_one_place(self, method: str, make_problem: Make) -> None:
        problem, truth = make_problem()
        start = dataclasses.replace(truth, points=np.tile([0.0, 0.0, 5.0], (len(truth.points), 1)))
        check(solve(dataclasses.replace(problem, start=start), methods.options(method)))

    @pytest.mark.parametrize("method", list(methods.METHODS))
    def test_points_at_the_camera_centres(self, method: str, make_problem: Make) -> None:
        problem, truth = make_problem()
        centre = -truth.rotation[1].T @ truth.translation[1]
        start = dataclasses.replace(truth, points=np.tile(centre, (len(truth.points), 1)))
        check(solve(dataclasses.replace(problem, start=start), methods.options(method)))

    @pytest.mark.parametrize("method", list(methods.METHODS))
    def test_one_keyframe(self, method: str, make_problem: Make) -> None:
        problem, _ = make_problem(keyframes=1, fixed=0)
        check(solve(problem, methods.options(method)))

    @pytest.mark.parametrize("method", list(methods.METHODS))
    def test_numbers_that_overflow(self, method: str, make_problem: Make) -> None:
        problem, truth = make_problem()
        start = dataclasses.replace(truth, points=truth.points * 1e200)
        check(solve(dataclasses.replace(problem, start=start), methods.options(method)))
        observations = dataclasses.replace(problem.observations, uv=problem.observations.uv * 1e200)
        result = solve(dataclasses.replace(problem, observations=observations), methods.options(method))
        assert result.state.is_finite() and result.reason
        # A truncated quadratic is finite there too, and flat.
        assert result.status == (Status.CONVERGED if method == "irls_tq" else Status.FAILED)

    def test_no_observations_no_points_nothing_free(self, make_problem: Make) -> None:
        problem, _ = make_problem()
        none = {f.name: getattr(problem.observations, f.name)[:0] for f in dataclasses.fields(problem.observations)}
        empty = dataclasses.replace(problem, observations=type(problem.observations)(**none))
        assert solve(empty, SolverOptions()).status == Status.SKIPPED
        check(solve(dataclasses.replace(problem, fixed=np.ones(problem.n_keyframes, bool)), SolverOptions()))

    def test_points_without_observations_stay(self, make_problem: Make) -> None:
        problem, _ = make_problem()
        points = np.concatenate([problem.start.points, [[1.0, 2.0, 3.0]]])
        result = solve(
            dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points)), SolverOptions()
        )
        check(result)
        np.testing.assert_array_equal(result.state.points[-1], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"keyframe": 99}, "keyframe index 99"),
        ({"point": 10**6}, "point index 1000000"),
        ({"camera": -1}, "camera index -1"),
        ({"uv": np.nan}, "uv of row 0"),
        ({"sigma_px": 0.0}, "sigma_px of observation 0"),
    ],
)
def test_problems_that_make_no_sense_are_refused(change: dict[str, float], words: str, make_problem: Make) -> None:
    problem, _ = make_problem()
    ((name, value),) = change.items()
    array = getattr(problem.observations, name).copy()
    array[-1 if name == "point" else 0] = value
    broken = dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, **{name: array}))
    with pytest.raises(ProblemError, match=words):
        solve(broken, SolverOptions())


def test_unknown_method_lists_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="local_dinm"):
        methods.options("gauss")


class TestLadybug:
    """The real problem that the thesis measures on."""

    @pytest.fixture
    def problem(self, shared_data: Path) -> Problem:
        return bal.to_problem(bal.read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"))

    def test_start_objective(self, problem: Problem) -> None:
        assert round(Objective(problem, SolverOptions()).value(problem.start), 2) == 850912.46

    @pytest.mark.slow
    def test_local_dinm(self, problem: Problem) -> None:
        result = solve(problem, dataclasses.replace(methods.options("local_dinm"), max_iterations=50))
        check(result)
        assert result.objective_after <= 13500.0

    @pytest.mark.slow
    def test_auto_reaches_the_best_known_objective(self, problem: Problem) -> None:
        """13344.246 is the best of the published solvers under the same rule."""
        result = solve(problem, dataclasses.replace(methods.options("auto"), max_iterations=60))
        check(result)
        assert result.objective_after <= 13344.246 * 1.001

    @pytest.mark.parametrize(("loss", "lowest"), [("squared", 13344.2405), ("huber", 7647.9357)])
    def test_points_that_creep_do_not_keep_the_last_digits_waiting(
        self, loss: str, lowest: float, problem: Problem
    ) -> None:
        options = dataclasses.replace(methods.options("auto"), loss=loss, max_iterations=15, function_tolerance=0.0)
        assert solve(problem, options).objective_after <= lowest * (1.0 + 1e-6)

    @pytest.mark.parametrize("loss", ["squared", "huber"])
    def test_the_region_saves_steps_that_cholesky_cannot_solve(self, loss: str, problem: Problem) -> None:
        """Near the end damping alone falls until S breaks down; the region holds steps back in its place."""
        chosen = dataclasses.replace(methods.options("auto"), loss=loss, function_tolerance=1e-9, max_iterations=100)
        found = solve(problem, chosen)
        alone = solve(problem, dataclasses.replace(chosen, trust_region="none"))
        for result in (found, alone):
            assert result.status is Status.CONVERGED and min(row.damping for row in result.trace) >= 1e-14
        assert found.objective_after == pytest.approx(alone.objective_after, rel=1e-7)
        rejected = [sum(not row.accepted for row in result.trace) for result in (found, alone)]
        assert rejected[0] < rejected[1] and len(found.trace) <= len(alone.trace), rejected


@pytest.mark.parametrize("name", ["dubrovnik-1-1-pre.txt", "dubrovnik-3-7-18-pre.txt", "dubrovnik-3-7-pre.txt"])
@pytest.mark.parametrize("method", list(methods.METHODS))
def test_small_real_problems_stop_with_a_reason(method: str, name: str, shared_data: Path) -> None:
    problem = bal.to_problem(bal.read_bal(shared_data / "gtsam-dubrovnik-small" / name))
    check(solve(problem, methods.options(method)))


def test_curved_valleys_end_at_their_floor_from_any_start(shared_data: Path) -> None:
    """dubrovnik-3-7 has fewer equations than unknowns, so that its minimum is 0, at the end of a curved valley."""
    problem = bal.to_problem(bal.read_bal(shared_data / "gtsam-dubrovnik-small" / "dubrovnik-3-7-pre.txt"))
    options = dataclasses.replace(methods.options("auto"), max_iterations=100, function_tolerance=1e-8)
    rng = np.random.default_rng(1)
    for scale in (0.0, *[1.0] * 8):
        start = dataclasses.replace(
            problem.start,
            translation=problem.start.translation + scale * rng.normal(0.0, 0.02, problem.start.translation.shape),
            points=problem.start.points + scale * rng.normal(0.0, 0.05, problem.start.points.shape),
        )
        result = solve(dataclasses.replace(problem, start=start), options)
        check(result)
        assert result.objective_after < 1e-9, (result.objective_after, result.reason)
