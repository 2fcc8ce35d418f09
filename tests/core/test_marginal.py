# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Marginalisation: the null space, and that nothing of what was taken out is lost or counted twice."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import covariance, marginal, methods, parameterisation, solver
from ba_node.core.marginalisation import marginalise
from ba_node.core.problem import Problem, State
from ba_node.core.rows import rows_of

MakeProblem = Callable[..., tuple[Problem, State]]
EXACT = dataclasses.replace(methods.options("auto"), cheirality="constant", function_tolerance=1e-14)


def solved(problem: Problem) -> State:
    return solver.solve(problem, EXACT).state


def prior_of(
    problem: Problem, state: State, stays: np.ndarray, options: SolverOptions = EXACT
) -> marginal.MarginalPrior:
    """Return the prior of all rows of a problem on keyframes that stay, of those that are free."""
    free = np.flatnonzero(~problem.fixed)
    found = marginalise(rows_of(problem, state, options), state, free, stays[free])
    assert found is not None
    return found


def gauge_directions(state: State) -> FloatArray:
    """Return the local steps (n_kf, 6, 7) of all keyframes with which the world turns, moves and grows."""
    n = len(state.translation)
    out = np.zeros((n, 6, 7))
    out[:, :3, :3] = np.eye(3)
    out[:, 3:, 3:6] = np.eye(3)
    out[:, 3:, 6] = (np.swapaxes(state.rotation, 1, 2) @ state.translation[:, :, None])[..., 0]
    return out


@pytest.mark.parametrize("stereo", [True, False], ids=["stereo", "one camera"])
def test_the_prior_tells_nothing_of_the_gauge(make_problem: MakeProblem, stereo: bool) -> None:
    problem, _ = make_problem(keyframes=6, points=60, stereo=stereo, fixed=0, noise_px=1.0)
    stays = np.arange(6) >= 2
    prior = prior_of(problem, problem.start, stays, dataclasses.replace(EXACT, loss="huber"))
    directions = gauge_directions(problem.start)[stays]
    directions /= np.linalg.norm(directions, axis=(0, 1))
    moved = np.einsum("kmi,kij->mj", prior.root, directions)
    told = np.abs(moved).max(axis=0)
    assert told[:6].max() < 1e-8, f"turns and moves of the world: {told[:6]}"
    # Two cameras see how large the world is, one does not.
    assert (told[6] < 1e-8) == (not stereo), f"scale: {told[6]}"
    assert np.abs(prior.root).max() > 1.0


def test_the_prior_is_the_schur_complement(make_problem: MakeProblem) -> None:
    problem, _ = make_problem(keyframes=6, points=60, stereo=True, fixed=1, noise_px=1.0)
    stays = np.arange(6) >= 3
    prior = prior_of(problem, problem.start, stays)
    reduced = covariance.Reduced(rows_of(problem, problem.start, EXACT), rows_of(problem, problem.start, EXACT).weight)
    keep = np.repeat(stays[1:], 6)
    s = reduced.s
    expected = s[np.ix_(keep, keep)] - s[np.ix_(keep, ~keep)] @ np.linalg.solve(
        s[np.ix_(~keep, ~keep)], s[np.ix_(~keep, keep)]
    )
    flat = np.swapaxes(prior.root, 0, 1).reshape(len(prior.offset), -1)
    np.testing.assert_allclose(flat.T @ flat, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_a_problem_with_the_prior_ends_where_the_whole_one_does(make_problem: MakeProblem) -> None:
    """Linearised at the solution, the prior holds the keyframes that stay exactly there, from wherever they begin."""
    problem, _ = make_problem(keyframes=6, points=60, stereo=True, fixed=1, noise_px=1.0)
    best = solved(problem)
    stays = np.arange(6) >= 3
    prior = dataclasses.replace(prior_of(problem, best, stays), keyframes=np.array([[3, 4, 5]]))
    step = 0.01 * np.random.default_rng(1).normal(size=(6, 6)) * stays[:, None]
    moved = parameterisation.retract("local", best.rotation, best.translation, step)
    none = dataclasses.replace(problem.observations, **{k: v[:0] for k, v in vars(problem.observations).items()})
    start = State(*moved, np.empty((0, 3)), best.intrinsics)
    alone = Problem(start, ~stays, problem.cameras, none, (prior,))
    found = solver.solve(alone, EXACT).state
    np.testing.assert_allclose(found.translation, best.translation, atol=1e-7)
    np.testing.assert_allclose(found.rotation, best.rotation, atol=1e-7)


def test_derivatives_are_those_of_differences(make_problem: MakeProblem) -> None:
    problem, _ = make_problem(keyframes=5, points=40, stereo=True, fixed=1, noise_px=1.0)
    stays = np.arange(5) >= 2
    prior = dataclasses.replace(prior_of(problem, problem.start, stays), keyframes=np.array([[2, 3, 4]]))
    rng = np.random.default_rng(2)
    away = parameterisation.retract(
        "local", problem.start.rotation, problem.start.translation, 0.05 * rng.normal(size=(5, 6))
    )
    state = dataclasses.replace(problem.start, rotation=away[0], translation=away[1])
    prior = prior.moved(np.array([3.0, -2.0, 0.5]))
    got, h = prior.jacobians(state)[0], 1e-6
    for place, k in enumerate((2, 3, 4)):
        for j in range(6):
            ends = []
            for sign in (1.0, -1.0):
                step = np.zeros((5, 6))
                step[k, j] = sign * h
                pose = parameterisation.retract("local", state.rotation, state.translation, step)
                ends.append(prior.residuals(dataclasses.replace(state, rotation=pose[0], translation=pose[1]))[0])
            expected = (ends[0] - ends[1]) / (2.0 * h)
            assert np.abs(got[place, :, j] - expected).max() < 1e-4 * max(1.0, np.abs(expected).max())


def test_another_origin_and_fewer_keyframes_change_nothing(make_problem: MakeProblem) -> None:
    problem, _ = make_problem(keyframes=6, points=60, stereo=True, fixed=1, noise_px=1.0)
    best = solved(problem)
    stays = np.arange(6) >= 2
    prior = dataclasses.replace(prior_of(problem, best, stays), keyframes=np.array([[2, 3, 4, 5]]))
    origin = np.array([30.0, -20.0, 5.0])
    step = 0.01 * np.random.default_rng(4).normal(size=(6, 6))
    rotation, translation = parameterisation.retract("local", best.rotation, best.translation, step)
    there = State(rotation, translation, best.points, best.intrinsics)
    shifted = dataclasses.replace(there, translation=translation + rotation @ origin)
    np.testing.assert_allclose(prior.moved(origin).residuals(shifted), prior.residuals(there), atol=1e-6)
    # Taken out in two steps, keyframes leave what they leave at once.
    once = prior_of(problem, best, np.arange(6) >= 3)
    twice = prior.kept(np.array([False, True, True, True]), np.arange(3))
    assert twice is not None
    flat = [np.swapaxes(one.root, 0, 1).reshape(len(one.offset), -1) for one in (once, twice)]
    np.testing.assert_allclose(flat[0].T @ flat[0], flat[1].T @ flat[1], rtol=1e-7, atol=1e-5)
