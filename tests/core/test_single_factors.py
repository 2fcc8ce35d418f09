# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core import geometry, solver
from ba_node.core.factors import FactorSum
from ba_node.core.native_kernels import NativeFactorSum
from ba_node.core.priors import PosePriors
from ba_node.core.problem import Observations, PointPriors, ProblemError
from ba_node.core.result import Status
from tests.core.factors import (
    BACKENDS,
    Make,
    near,
    pose_covariances,
    relative_poses,
    single_keyframe_factors,
    stepped,
)


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


@pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
def test_native_has_priors_of_poses(make_problem: Make) -> None:
    """With lever arms and full matrices, on free keyframes and on fixed ones, and where no orientation was measured."""
    problem, truth = make_problem()
    (priors, *_) = single_keyframe_factors(truth, problem.n_keyframes)
    assert isinstance(priors, PosePriors) and priors.lever_arm.all()
    root = priors.root_information.copy()
    root[1, :, :3] = 0.0
    for loss in ("squared", "huber", "cauchy"):
        given = [dataclasses.replace(priors, root_information=root, loss=loss)]
        compiled = NativeFactorSum(given, problem.fixed)
        assert compiled._kernels[0] is not None
        oracle, found = (one.linearise(problem.start) for one in (FactorSum(given, problem.fixed), compiled))
        assert compiled.value(problem.start) == pytest.approx(oracle.value, rel=1e-13)
        assert found.value == pytest.approx(oracle.value, rel=1e-13)
        near(found.gradient, oracle.gradient)
        near(found.diagonal, oracle.diagonal)


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
        found.append(pose_covariances(posed, state, options, np.empty((4, 6, 0))))
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
