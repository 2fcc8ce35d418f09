# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Problems with factors of every kind."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ba_node import native
from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import covariance, geometry, native_kernels, parameterisation
from ba_node.core.factors import RelativePoses
from ba_node.core.kernels import Kernels
from ba_node.core.priors import CustomFactors, Directions, PosePriors
from ba_node.core.problem import KeyframeFactors, Problem, State

Make = Callable[..., tuple[Problem, State]]


built = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")


BACKENDS = ["numpy", pytest.param("native", marks=built)]


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


def linearised(problem: Problem, options: SolverOptions, backend: str) -> Kernels:
    """Return kernels linearised at the start."""
    kernels = native_kernels.make(problem, dataclasses.replace(options, kernels=backend))
    kernels.linearise(problem.start)
    return kernels


def pose_covariances(problem: Problem, state: State, options: SolverOptions, conditions: FloatArray) -> FloatArray:
    """Return the covariances (n_free, 6, 6) of the free poses; NaN where they are unknown."""
    found = covariance.uncertainty_of(problem, state, options, conditions)
    return np.full((int(np.count_nonzero(~problem.fixed)), 6, 6), np.nan) if found is None else found.poses()
