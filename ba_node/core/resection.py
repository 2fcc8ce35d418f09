# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Place one keyframe by the points that others see too, which stay where they are.

Gauss-Newton on the robust reprojection errors of that keyframe alone, reweighted in each step, with a whiff of
Marquardt's damping. Its pose, body from world, steps by ``R <- Exp(w) R``, ``t <- Exp(w) t + v``. With ``b = R x + t``
and ``G = d residual / d b`` the derivative is ``b x G`` by w and ``G`` by v. A window is farthest off with its newest
keyframe: to begin there costs a tenth of an iteration of the window, and saves one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray, changed
from ba_node.config import SolverOptions
from ba_node.core import cameras, columns, geometry, loss, parameterisation
from ba_node.core.native_kernels import missing
from ba_node.core.problem import Problem, State

# Views of known points that are needed; steps at most; the share of the cost below which a gain ends it; damping.
_LEAST, _STEPS, _LEAST_GAIN, _DAMPING = 50, 10, 1e-3, 1e-6
_BEHIND_NORM = 100.0  # what the view of a point counts as that lies behind its camera, sigmas


def resected(problem: Problem, options: SolverOptions, keyframe: int) -> State:
    """Return the start with a keyframe where its views of points that others see want it, by the loss of the options.

    Points that it alone sees go along, so that they stay where they are in its images. All is as it was if it sees too
    few others, or agrees with them as well as it can. The views' depths and the problem's factors are not looked at.
    """
    start = problem.start
    found = _pose(problem, options, keyframe)
    if found is None:
        return start
    rotation, translation, points = start.rotation.copy(), start.translation.copy(), start.points.copy()
    rotation[keyframe], translation[keyframe], alone = found
    in_body = points[alone] @ start.rotation[keyframe].T + start.translation[keyframe]
    points[alone] = (in_body - translation[keyframe]) @ rotation[keyframe]
    return changed(start, rotation=rotation, translation=translation, points=points)


def _views(problem: Problem, keyframe: int) -> tuple[IntArray, BoolArray]:
    """Return the observations of a keyframe, (n,), and which points it alone sees, (n_pt,)."""
    point, n = problem.observations.point, problem.n_points
    rows = (problem.observations.keyframe == keyframe).nonzero()[0]
    own = np.bincount(point.take(rows), minlength=n)
    return rows, (own > 0) & (own == np.bincount(point, minlength=n))


def _pose(problem: Problem, options: SolverOptions, keyframe: int) -> tuple[FloatArray, FloatArray, BoolArray] | None:
    """Return the keyframe's pose, (3, 3) and (3,) m, body from world; None if it stays.

    And which points it alone sees, (n_pt,).
    """
    if options.kernels != "numpy" and not missing(options):
        limits = _LEAST, _STEPS, _LEAST_GAIN, _DAMPING
        model = options.loss, options.loss_scale_px
        return native.kernels.resect(problem, keyframe, model, limits)  # type: ignore[no-any-return]
    rows, alone = _views(problem, keyframe)
    rows = rows[~alone.take(problem.observations.point.take(rows))]
    if len(rows) < _LEAST:
        return None
    start = at = best = problem.start.rotation[keyframe], problem.start.translation[keyframe]
    lowest, views = np.inf, _Views.of(problem, rows)
    for i in range(_STEPS + 1):
        cost, matrix, vector = _equations(views, options, at)
        if i and not cost < lowest:
            break
        arrived, lowest, best = bool(i) and lowest - cost <= _LEAST_GAIN * lowest, cost, at
        if arrived or i == _STEPS:
            break
        matrix[np.diag_indices(6)] *= 1.0 + _DAMPING
        try:
            step = np.asarray(np.linalg.solve(matrix, -vector))
        except np.linalg.LinAlgError:
            break
        turn = geometry.so3_exp(step[:3])
        at = turn @ at[0], turn @ at[1] + step[3:]
    return None if best is start else (*best, alone)


class _Views(NamedTuple):
    """Observations of one keyframe, all but the model stored by components."""

    points: FloatArray  # (n, 3) m
    turn: FloatArray  # (n, 3, 3) camera from body
    shift: FloatArray  # (n, 3) m
    model: NDArray[np.uint8]  # (n,)
    params: FloatArray  # (n, 12)
    uv: FloatArray  # (n, 2) px
    weight: FloatArray  # (n,) 1 / sigma, 1/px

    @classmethod
    def of(cls, problem: Problem, rows: IntArray) -> _Views:
        obs, cams = problem.observations, problem.cameras
        camera, points = obs.camera.take(rows), columns.take(problem.start.points, obs.point.take(rows))
        turn, shift, params = (columns.take(a, camera) for a in (cams.rotation, cams.translation, cams.params))
        return cls(points, turn, shift, cams.model[camera], params, columns.take(obs.uv, rows), 1 / obs.sigma_px[rows])


def _equations(
    views: _Views, options: SolverOptions, pose: tuple[FloatArray, FloatArray]
) -> tuple[float, FloatArray, FloatArray]:
    """Return the cost of some observations of one keyframe at a pose, J'J (6, 6) and J'r (6,)."""
    body = (pose[0] @ views.points.T + pose[1][:, None]).T
    x_cam = columns.times(views.turn, body)
    x_cam += views.shift
    behind = cameras.behind(x_cam, views.model)
    x_cam[behind] = (0.0, 0.0, 1.0)
    uv, d_uv, _ = cameras.project_jacobian(x_cam, views.model, views.params, intrinsics=False)
    scale = np.where(behind, 0.0, views.weight)[:, None]
    residual = (uv - views.uv) * scale
    norm = np.where(behind, _BEHIND_NORM, np.sqrt(residual[:, 0] ** 2 + residual[:, 1] ** 2))
    cost, weight = loss.evaluate(options.loss, norm, options.loss_scale_px)
    d_uv *= scale[:, :, None]
    by_body = columns.product(d_uv, views.turn)
    jacobian = parameterisation.local_jacobian(by_body, body).T
    rows = jacobian.reshape(6, -1)
    weighted = (jacobian * weight).reshape(6, -1)
    return float(np.sum(cost)), weighted @ rows.T, weighted @ residual.T.ravel()
