# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put priors of points into a problem as observations, so that every kernel, method and covariance has them.

With ``C = V diag(s1^2, s2^2, s3^2) V'`` the covariance of a point at p: a camera that is fixed far off, at the distance
D, looks at p along the third axis of V, with focal lengths D / s1 and D / s2 px. A point x at ``y = V'(x - p)`` from p
is seen by it at ``u = (D / s1) y1 / (D + y3)`` px, off by ``y1 / s1`` sigmas, likewise v, and at the depth ``D + y3``,
which is measured as D with the standard deviation s3. So the squares of all three residuals add up to
``(x - p)' C^-1 (x - p)``, but for a share of ``2 y3 / D``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ba_node.arrays import FloatArray, join_rows, take_rows
from ba_node.core import cameras
from ba_node.core.problem import Cameras, Observations, Problem, State

# Metres; the digits that it costs are those beyond 1e-10 m.
_FAR_M = 1e5


def as_observations(problem: Problem) -> Problem:
    """Return a problem with its priors as observations by fixed keyframes, which come after its own."""
    priors, start, obs = problem.point_priors, problem.start, problem.observations
    assert priors is not None
    n, n_kf, n_cam = len(priors.point), problem.n_keyframes, len(problem.cameras.model)
    variance, axes = np.linalg.eigh(priors.covariance)
    sigma = np.sqrt(variance)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    rotation = np.swapaxes(axes, 1, 2)
    translation = np.array([0.0, 0.0, _FAR_M]) - (rotation @ priors.position[:, :, None])[..., 0]
    lens = np.zeros((n, cameras.N_PARAMS))
    lens[:, :2] = _FAR_M / sigma[:, :2]
    model = np.full(n, int(cameras.Model.RATIONAL), problem.cameras.model.dtype)
    theirs = Cameras(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), model, lens)
    known = replace(obs, depth_m=_filled(obs.depth_m, len(obs)), depth_sigma_m=_filled(obs.depth_sigma_m, len(obs)))
    which = n_kf + np.arange(n), n_cam + np.arange(n), priors.point
    seen = join_rows(known, Observations(*which, np.zeros((n, 2)), np.ones(n), np.full(n, _FAR_M), sigma[:, 2]))
    intrinsics = np.tile([1.0, 0.0, 0.0], (n if problem.free_intrinsics else 0, 1))
    return replace(
        problem,
        start=join_rows(start, State(rotation, translation, np.empty((0, 3)), intrinsics)),
        fixed=np.concatenate([problem.fixed, np.ones(n, bool)]),
        cameras=join_rows(problem.cameras, theirs),
        observations=take_rows(seen, np.argsort(seen.point, kind="stable")),
        point_priors=None,
    )


def without(state: State, problem: Problem) -> State:
    """Return a state of :func:`as_observations` without the keyframes that this added."""
    n = problem.n_keyframes
    return State(state.rotation[:n], state.translation[:n], state.points, state.intrinsics[:n])


def _filled(depth: FloatArray, n: int) -> FloatArray:
    return depth if len(depth) else np.full(n, np.nan)
