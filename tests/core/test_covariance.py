# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg

from ba_node.config import SolverOptions
from ba_node.core import covariance, geometry, methods, solver
from ba_node.core.objective import Objective
from ba_node.core.problem import Observations, Problem, State
from experiments.thesis import matrix_forms
from tests.core.factors import pose_covariances

MakeProblem = Callable[..., tuple[Problem, State]]

SQUARED = dataclasses.replace(methods.options("auto"), gradient_tolerance=1e-9, function_tolerance=1e-14)


def options(loss: str = "squared", backend: str = "auto") -> SolverOptions:
    return dataclasses.replace(SQUARED, loss=loss, cheirality="constant", kernels=backend)


def solved(problem: Problem, chosen: SolverOptions) -> State:
    result = solver.solve(problem, chosen)
    assert result.status.usable, result.reason
    return result.state


def none(problem: Problem) -> np.ndarray:
    return np.empty((int(np.count_nonzero(~problem.fixed)), 6, 0))


def by_dense_jacobian(problem: Problem, state: State, chosen: SolverOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances of poses and points from one dense Jacobian, its whole inverse and formulas by hand."""
    lin = Objective(problem, dataclasses.replace(chosen, loss="squared")).linearise(state)
    n_obs, d = lin.residual.shape
    n = int(np.count_nonzero(~problem.fixed))
    jacobian = np.zeros((n_obs, d, 6 * n + 3 * problem.n_points))
    for i, (k, p) in enumerate(zip(problem.observations.keyframe, problem.observations.point, strict=True)):
        column = int(np.count_nonzero(~problem.fixed[:k]))
        if not problem.fixed[k]:
            jacobian[i, :, 6 * column : 6 * column + 6] = lin.d_keyframe[i]
        jacobian[i, :, 6 * n + 3 * p : 6 * n + 3 * p + 3] = lin.d_point[i]
    norm = np.linalg.norm(lin.residual[:, :2], axis=1)
    weight, slope = np.ones((n_obs, d)), np.ones((n_obs, d))
    if chosen.loss == "huber":
        # The score is r inside, c r/|r| outside: its radial slope is 0 there, that across c/|r|.
        weight[:, :2] = np.minimum(1.0, chosen.loss_scale_px / norm)[:, None]
        slope[:, :2] = np.where(norm <= chosen.loss_scale_px, 1.0, 0.5 * chosen.loss_scale_px / norm)[:, None]
        if d == 3:
            size = np.abs(lin.residual[:, 2])
            weight[:, 2] = np.minimum(1.0, chosen.loss_scale_px / np.maximum(size, 1e-300))
            slope[:, 2] = weight[:, 2] * np.sum(size <= chosen.loss_scale_px) / np.sum(weight[:, 2])
    flat, score = jacobian.reshape(n_obs * d, -1), (weight * lin.residual).ravel()
    steep = slope.ravel()
    inverse = np.linalg.inv(flat.T @ (steep[:, None] * flat))
    leverage = np.einsum("mi,ij,mj->m", flat, inverse, flat) * steep
    counts = np.any(flat != 0.0, axis=1)
    variance = np.zeros(n_obs * d)
    for rows in (np.arange(n_obs * d) % d < 2, np.arange(n_obs * d) % d == 2):
        of = rows & counts
        if of.any() and (chosen.loss == "squared" or not rows[0]):
            variance[of] = steep[of] / steep[of].mean() * np.sum(score[of] ** 2) / np.sum(1.0 - leverage[of])
        elif of.any():
            left = 1.0 - np.minimum(leverage[of], 0.9)
            kappa = np.sum((score[of] / left) ** 2) / np.sum(steep[of] / left)
            variance[of] = np.maximum((score[of] / left) ** 2 - kappa * steep[of] * (1.0 - left), 0.0)
    whole = inverse @ (flat.T @ (variance[:, None] * flat)) @ inverse
    blocks = [whole[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n)]
    # Points take the mean variance of a group.
    for rows in (np.arange(n_obs * d) % d < 2, np.arange(n_obs * d) % d == 2):
        of = rows & counts
        variance[of] = steep[of] * variance[of].sum() / max(steep[of].sum(), 1e-300)
    whole = inverse @ (flat.T @ (variance[:, None] * flat)) @ inverse
    at = 6 * n + 3 * np.arange(problem.n_points)
    return np.array(blocks), np.array([whole[i : i + 3, i : i + 3] for i in at])


def worst_difference(got: np.ndarray, expected: np.ndarray) -> float:
    scale = np.sqrt(np.einsum("kii,kjj->kij", expected, expected))
    return float(np.max(np.abs(got - expected) / scale))


@pytest.mark.parametrize("full", [0.0, 2.0], ids=["full", "sparse"])
@pytest.mark.parametrize("loss", ["squared", "huber"])
@pytest.mark.parametrize(
    "fields", [{"stereo": True}, {"stereo": True, "depth": True}, {"fixed": 2}], ids=["stereo", "depth", "mono"]
)
def test_it_is_the_sandwich_of_the_whole_jacobian(
    make_problem: MakeProblem, monkeypatch: pytest.MonkeyPatch, loss: str, fields: dict[str, object], full: float
) -> None:
    monkeypatch.setattr(covariance, "_FULL", full)
    monkeypatch.setattr(covariance, "_CHUNK", 100)
    problem, _ = make_problem(noise_px=1.0, **fields)
    chosen = options(loss)
    state = solved(problem, chosen)
    uncertainty = covariance.uncertainty_of(problem, state, chosen, none(problem))
    assert uncertainty is not None
    poses, points = by_dense_jacobian(problem, state, chosen)
    assert worst_difference(uncertainty.poses(), poses) < 1e-6
    assert worst_difference(uncertainty.points(np.arange(problem.n_points)), points) < 1e-6
    assert worst_difference(uncertainty.points(np.array([7, 3])), points[[7, 3]]) < 1e-6


def with_noise(problem: Problem, exact: Observations, rng: np.random.Generator) -> Problem:
    uv = exact.uv + rng.normal(size=exact.uv.shape) * exact.sigma_px[:, None]
    return dataclasses.replace(problem, observations=dataclasses.replace(exact, uv=uv))


def local_errors(truth: State, found: State, free: np.ndarray) -> np.ndarray:
    """Return the steps (n_free, 6) that lead from the true to the found poses."""
    back = np.swapaxes(truth.rotation, 1, 2)
    turn = geometry.so3_log(back @ found.rotation)
    moved = (back @ (found.translation - truth.translation)[:, :, None])[..., 0]
    return np.asarray(np.concatenate([turn, moved], axis=1)[free])


@pytest.mark.slow
def test_it_is_what_repeated_measurements_scatter_by(make_problem: MakeProblem) -> None:
    problem, truth = make_problem(noise_px=0.0, start_error=0.0, stereo=True, keyframes=4, points=30)
    rng = np.random.default_rng(1)
    chosen, free, n = options(), ~problem.fixed, 400
    errors, told = [], []
    for _ in range(n):
        noisy = with_noise(problem, problem.observations, rng)
        state = solved(noisy, chosen)
        errors.append(local_errors(truth, state, free))
        told.append(pose_covariances(noisy, state, chosen, none(problem)))
    # The standard error of a standard deviation from n samples is 1 / sqrt(2 n): 3.5 %.
    measured = np.std(np.array(errors), axis=0)
    ratio = measured / np.sqrt(np.diagonal(np.mean(told, axis=0), axis1=1, axis2=2))
    assert np.all(np.abs(ratio - 1.0) < 0.15), f"scatter over told deviation: {ratio.min():.3f} to {ratio.max():.3f}"
    correlation = np.corrcoef(np.array(errors)[:, 0].T)
    mean = np.mean(told, axis=0)[0]
    deviation = np.sqrt(np.diagonal(mean))
    assert np.max(np.abs(correlation - mean / np.outer(deviation, deviation))) < 0.2


def test_sigma_follows_the_residuals_not_what_was_claimed(make_problem: MakeProblem) -> None:
    problem, _ = make_problem(stereo=True, noise_px=1.0)
    obs = problem.observations
    claimed = dataclasses.replace(problem, observations=dataclasses.replace(obs, sigma_px=10.0 * obs.sigma_px))
    chosen = options()
    state = solved(problem, chosen)
    a = pose_covariances(problem, state, chosen, none(problem))
    b = pose_covariances(claimed, state, chosen, none(problem))
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-18)


def test_a_condition_holds_a_scale_that_floats(make_problem: MakeProblem) -> None:
    """With one fixed pose and one camera S is singular; a condition makes it the inverse of the bordered matrix."""
    problem, _ = make_problem(fixed=1, noise_px=1.0)
    chosen = options()
    state = solved(problem, chosen)
    n = int(np.count_nonzero(~problem.fixed))
    assert np.isnan(pose_covariances(problem, state, chosen, none(problem))).any(), "nothing holds the scale"
    g = np.random.default_rng(0).normal(size=(n, 6, 1))
    got = pose_covariances(problem, state, chosen, g)
    lin = Objective(problem, chosen).linearise(state)
    h, _ = matrix_forms.explicit_dense(problem, lin)
    border = np.zeros((len(h), 1))
    border[: 6 * n, 0] = g.ravel()
    bordered = np.block([[np.asarray(h), border], [border.T, np.zeros((1, 1))]])
    variance = np.sum(lin.residual**2) / (2 * len(problem.observations) - len(h) + 1)
    inverse = variance * scipy.linalg.inv(bordered)
    expected = np.array([inverse[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n)])
    scale = np.sqrt(np.einsum("kii,kjj->kij", expected, expected))
    assert np.max(np.abs(got - expected) / scale) < 1e-5


def _without(problem: Problem, kept: np.ndarray) -> Problem:
    obs = problem.observations
    columns = {f.name: getattr(obs, f.name) for f in dataclasses.fields(obs)}
    return dataclasses.replace(
        problem, observations=Observations(**{k: v[kept] if len(v) else v for k, v in columns.items()})
    )


@pytest.mark.parametrize(
    "spoil",
    [
        lambda p: _without(p, np.arange(len(p.observations)) < 8),
        lambda p: _without(p, np.zeros(len(p.observations), bool)),
    ],
    ids=["fewer rows than unknowns", "no observations"],
)
def test_unknown_is_nan(make_problem: MakeProblem, spoil: Callable[[Problem], Problem]) -> None:
    problem = spoil(make_problem(stereo=True)[0])
    got = pose_covariances(problem, problem.start, options(), none(problem))
    assert got.shape == (4, 6, 6) and np.isnan(got).all()


def test_only_the_keyframe_that_hangs_loose_is_unknown(make_problem: MakeProblem) -> None:
    problem, _ = make_problem(stereo=True, noise_px=1.0)
    obs = problem.observations
    last = obs.keyframe == problem.n_keyframes - 1
    few = last & (np.cumsum(last) > 2)
    loose = _without(problem, ~few)
    state = solved(loose, options())
    got = pose_covariances(loose, state, options(), none(loose))
    assert np.isnan(got[-1]).all()
    assert np.isfinite(got[:-1]).all()


def alone(problem: Problem, state: State, chosen: SolverOptions) -> tuple[float, float]:
    """Return the largest standard deviations of one pose and all points, the other poses held, out of the whole H."""
    h, _ = matrix_forms.explicit_dense(problem, Objective(problem, chosen).linearise(state))
    h = np.asarray(h)
    n = int(np.count_nonzero(~problem.fixed))
    found = []
    for k, row in enumerate(np.flatnonzero(~problem.fixed)):
        kept = np.concatenate([np.arange(6 * k, 6 * k + 6), np.arange(6 * n, len(h))])
        own = np.linalg.inv(h[np.ix_(kept, kept)])[:6, :6]
        # Move the body by each unit step, and see where it goes.
        steps = 1e-6 * np.eye(6)
        turned = np.array([state.rotation[row] @ geometry.so3_exp(step[:3]) for step in steps])
        moved = state.translation[row] + (state.rotation[row] @ steps[:, 3:].T).T
        before = -state.rotation[row].T @ state.translation[row]
        to_body = (-(np.swapaxes(turned, 1, 2) @ moved[:, :, None])[..., 0] - before).T / 1e-6
        variances = to_body @ own @ to_body.T, own[:3, :3]
        found.append([np.sqrt(np.linalg.eigvalsh(variance).max()) for variance in variances])
    sigma_m, sigma_rad = np.max(found, axis=0)
    return float(sigma_m), float(sigma_rad)


@pytest.mark.parametrize("fields", [{"stereo": True}, {"fixed": 2}], ids=["stereo", "mono"])
def test_the_weakest_pose_is_that_of_the_whole_of_h(make_problem: MakeProblem, fields: dict[str, object]) -> None:
    problem, _ = make_problem(noise_px=1.0, **fields)
    told = []
    for kernels in ("native", "numpy"):
        result = solver.solve(problem, options(backend=kernels), weakest=True)
        told.append(result.weakest)
        assert result.weakest == pytest.approx(alone(problem, result.state, options()), rel=1e-3)
    assert told[0] == pytest.approx(told[1], rel=1e-6)


def test_the_weakest_pose_is_a_lower_bound(make_problem: MakeProblem) -> None:
    problem, _ = make_problem(stereo=True, noise_px=1.0)
    result = solver.solve(problem, options(), weakest=True)
    every = pose_covariances(problem, result.state, options(), none(problem))
    rotation = np.sqrt(np.linalg.eigvalsh(every[:, :3, :3]).max())
    assert 0.0 < result.weakest[1] < rotation


def test_the_weakest_pose_is_unknown_where_one_hangs_loose(make_problem: MakeProblem) -> None:
    problem, _ = make_problem(stereo=True, noise_px=1.0)
    last = problem.observations.keyframe == problem.n_keyframes - 1
    loose = _without(problem, ~(last & (np.cumsum(last) > 2)))
    for kernels in ("native", "numpy"):
        assert solver.solve(loose, options(backend=kernels), weakest=True).weakest == (0.0, 0.0)
