# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Residuals of a problem and their derivatives (2.17-2.26, 3.26-3.37), for all observations at once.

A residual has two rows (u, v: predicted minus measured over sigma_px) and, when any observation of the problem
carries a depth, a third (Z minus depth over its sigma; zero where there is none). The pixel part and the depth part
are weighed by the loss separately.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import SolverOptions
from ba_node.core import cameras, columns, loss, parameterisation
from ba_node.core.factors import FactorSum, FactorTerms
from ba_node.core.problem import Cameras, Observations, Problem, State

# What a point behind its camera costs under ``constant``: as much as a residual of this norm.
_BEHIND_NORM = 100.0
# Observations of which the errors are summed at a time.
_PIECE = 2**13


@dataclass(frozen=True)
class Linearisation:
    """Residuals and Jacobians, both already multiplied by the square root of the IRLS weight."""

    objective: float  # 1/2 sum Psi
    residual: FloatArray  # (n_obs, d), d = 2 or 3
    d_keyframe: FloatArray  # (n_obs, d, 6 or 9)
    d_point: FloatArray  # (n_obs, d, 3)
    factors: FactorTerms | None = None  # what the factors add; None if there are none
    points: FloatArray | None = None  # (n_obs, 3) the points, m, where poses step locally and nothing else does


@dataclass(frozen=True)
class PointRows:
    """What one observation says about its point alone."""

    cost: FloatArray  # (n_obs,) Psi
    residual: FloatArray  # (n_obs, d), weighted
    d_point: FloatArray  # (n_obs, d, 3), weighted

    def update(self, rows: IntArray, other: PointRows, taken: IntArray) -> None:
        """Write over some rows with some of another's."""
        for mine, its in zip(vars(self).values(), vars(other).values(), strict=True):
            columns.put(mine, rows, columns.take(its, taken))


@dataclass(frozen=True)
class _Observed:
    """What is known of some observations; of what is the same for all in the problem there is one row."""

    image: IntArray  # (n,) index into the pairs (keyframe, camera) that see anything
    point: IntArray  # (n,)
    uv: FloatArray  # (n, 2), px
    weight: FloatArray  # (n,) or (1,) 1 / sigma, 1/px
    model: NDArray[np.uint8]  # (n,) or (1,)
    params: FloatArray  # (n, m) or (1, m), see cameras.project
    depth_m: FloatArray  # (n,) zero where there is none; (0,) if none has one
    depth_weight: FloatArray  # (n,) 1 / sigma, zero where there is no depth, 1/m
    ignored: BoolArray  # (n,) True for those that count for nothing

    def part(self, rows: IntArray | slice) -> _Observed:
        """Return what is known of some of them."""
        n = len(self.point)
        parts: dict[str, Any] = {name: columns.take(a, rows) for name, a in vars(self).items() if len(a) == n}
        return replace(self, **parts)


class Objective:
    """The objective of one problem; knows which image each observation belongs to."""

    def __init__(self, problem: Problem, options: SolverOptions) -> None:
        self.problem = problem
        self.options = options  # of which the cost model counts here: parameterisation, loss, its scale, cheirality
        # the sum of the problem's factors; None if it has none
        self.factors = FactorSum(problem.factors, problem.fixed, options.parameterisation) if problem.factors else None
        # mu of the surrogate that stands in for a truncated quadratic; infinite for the loss itself.
        self.graduation = np.inf
        obs, cams = problem.observations, problem.cameras
        n_cam = max(len(cams.model), 1)
        key = obs.keyframe * n_cam + obs.camera
        used = np.zeros(problem.n_keyframes * n_cam, dtype=bool)
        used[key] = True
        images, image = np.flatnonzero(used), (np.cumsum(used) - 1).take(key)
        self._image_keyframe, self._image_camera = images // n_cam, images % n_cam
        self._has_depth = len(obs.depth_m) > 0
        depth_m = depth_weight = obs.depth_m
        if self._has_depth:
            depth_weight = np.nan_to_num(1.0 / obs.depth_sigma_m) * np.isfinite(depth_m)
            depth_m = np.nan_to_num(depth_m)
        self._all = _Observed(
            image,
            obs.point,
            np.asfortranarray(obs.uv),
            1.0 / _once(obs.sigma_px),
            *_lenses(problem, self._image_camera),
            depth_m,
            depth_weight,
            np.zeros(0, dtype=bool),
        )
        if options.cheirality == "drop":
            self._all = replace(self._all, ignored=cameras.behind(self.in_camera(problem.start), self._all.model))

    def through(self, cams: Cameras, uv: FloatArray) -> Objective:
        """Return the same with other cameras and pixels (n_obs, 2); what counts for nothing is what did before."""
        other = copy.copy(self)
        other.problem = replace(self.problem, cameras=cams)
        model, params = _lenses(other.problem, self._image_camera)
        other._all = replace(self._all, model=model, params=params, uv=np.asfortranarray(uv))
        return other

    def camera_rows(self, state: State) -> tuple[FloatArray, IntArray, FloatArray]:
        """Return points in their camera's optical frame, the masked rows, and sqrt(weight) / sigma of each row.

        (n_obs, 3) m; rows of masked observations count for nothing; (n_obs, d).
        """
        x_cam, masked, _, root_weight = self._evaluate(state)
        scale = self._row_scale(root_weight, self._all)
        return x_cam, masked, np.broadcast_to(scale, (len(x_cam), 3 if self._has_depth else 2))

    def in_camera(self, state: State) -> FloatArray:
        """Return the observed points in their camera's optical frame, (n_obs, 3), m."""
        return self._in_camera(state, self._all)[0]

    def errors(self, state: State) -> FloatArray:
        """Return predicted minus measured, (n_obs, 2) px, NaN for points that their camera cannot see."""
        of = self._all
        x_cam = self.in_camera(state)
        behind = np.flatnonzero(cameras.behind(x_cam, of.model))
        x_cam[behind] = (0.0, 0.0, 1.0)
        errors = cameras.project(x_cam, of.model, self._params(state, of)) - of.uv
        errors[behind] = np.nan
        return errors

    def value(self, state: State) -> float:
        """Return the objective 1/2 sum Psi."""
        return _total(self._evaluate(state)[2]) + self.factors_value(state)

    def factors_value(self, state: State) -> float:
        """Return what the factors have of the objective."""
        return 0.0 if self.factors is None else self.factors.value(state)

    def linearise(self, state: State, rows: PointRows | None = None) -> Linearisation:
        """Return residuals and Jacobians at a state; what is known of all rows there is not worked out again."""
        obs, intrinsics = self.problem.observations, self.problem.free_intrinsics
        if rows is None or intrinsics:
            rows, d_intrinsics = self._rows(state, self._all, intrinsics=intrinsics)
        points = columns.take(state.points, obs.point)
        d_keyframe = parameterisation.pose_jacobian(
            self.options.parameterisation, rows.d_point, points, state.rotation, obs.keyframe
        )
        if intrinsics:
            d_keyframe = np.concatenate([d_keyframe.T, d_intrinsics.T]).T
        terms = None if self.factors is None else self.factors.linearise(state)
        value = _total(rows.cost) + (0.0 if terms is None else terms.value)
        local = self.options.parameterisation == "local" and not intrinsics
        return Linearisation(value, rows.residual, d_keyframe, rows.d_point, terms, points if local else None)

    def point_rows(self, state: State, rows: IntArray | slice = slice(None)) -> PointRows:
        """Return costs, residuals and derivatives by the points of some observations."""
        return self._rows(state, self._all.part(rows), intrinsics=False)[0]

    def _rows(self, state: State, of: _Observed, *, intrinsics: bool) -> tuple[PointRows, FloatArray]:
        """Return the points' rows, and the derivatives by f, k1, k2 (n, d, 3 or 0), all weighted."""
        x_cam, rotation = self._in_camera(state, of)
        masked = self._mask(x_cam, of)
        uv, d_uv, d_intrinsics = cameras.project_jacobian(
            x_cam, of.model, self._params(state, of), intrinsics=intrinsics
        )
        residual = self._residual(uv, x_cam, masked, of)
        costs, root_weight = self._costs(residual, masked, of)
        d_cam = d_uv
        if self._has_depth:
            d_cam = columns.empty(len(uv), 3, 3)
            d_cam[:, :2], d_cam[:, 2] = d_uv, (0.0, 0.0, 1.0)
            none = columns.empty(len(uv), 1, d_intrinsics.shape[2])
            none[:] = 0.0
            d_intrinsics = np.concatenate([d_intrinsics, none], axis=1)
        # Rows of masked observations may hold infinities: written over, not multiplied by zero.
        d_cam[masked], d_intrinsics[masked] = 0.0, 0.0
        scale = self._row_scale(root_weight, of)[:, :, None]
        d_cam *= scale
        d_intrinsics *= scale
        residual *= root_weight
        return PointRows(costs, residual, columns.product(d_cam, rotation)), d_intrinsics

    def retract(
        self, state: State, step_keyframes: FloatArray, step_points: FloatArray, of: IntArray | slice = slice(None)
    ) -> State:
        """Return the state after a step, (n, 6 or 9) of the keyframes ``of`` (default: all), (n_pt, 3) of points."""
        rotation, translation, intrinsics = state.rotation.copy(), state.translation.copy(), state.intrinsics
        rotation[of], translation[of] = parameterisation.retract(
            self.options.parameterisation, rotation[of], translation[of], step_keyframes[:, :6]
        )
        if len(intrinsics):
            intrinsics = intrinsics.copy()
            intrinsics[of] += step_keyframes[:, 6:]
        return State(rotation, translation, state.points + step_points, intrinsics)

    def _in_camera(self, state: State, of: _Observed) -> tuple[FloatArray, FloatArray]:
        """Return points in their camera's optical frame, (n, 3), m, and (n, 3, 3) camera from world."""
        cams = self.problem.cameras
        rotation_cb = cams.rotation[self._image_camera]
        moved = (rotation_cb @ state.translation[self._image_keyframe][:, :, None])[..., 0]
        rotation = columns.take(rotation_cb @ state.rotation[self._image_keyframe], of.image)
        x_cam = columns.times(rotation, columns.take(state.points, of.point))
        x_cam += columns.take(moved + cams.translation[self._image_camera], of.image)
        return x_cam, rotation

    def _params(self, state: State, of: _Observed) -> FloatArray:
        """Return the camera parameters of observations, with the keyframe's own f, k1, k2 put in if free."""
        if not self.problem.free_intrinsics:
            return of.params
        params = columns.empty(len(of.point), of.params.shape[1])
        params[:] = of.params
        own = columns.take(state.intrinsics[self._image_keyframe], of.image)
        params[:, cameras.FX] *= own[:, 0]
        params[:, cameras.FY] *= own[:, 0]
        params[:, 4:6] += own[:, 1:]
        return params

    def _mask(self, x_cam: FloatArray, of: _Observed) -> IntArray:
        """Return which observations push nothing, and move their points off the plane so that nothing is infinite."""
        hidden = cameras.behind(x_cam, of.model)
        if self.options.cheirality == "keep":
            on_plane = np.abs(x_cam[:, 2]) < cameras.MIN_DEPTH * 1e-6
            hidden = np.where(of.model == cameras.Model.EQUIDISTANT, hidden, on_plane)
        masked = np.flatnonzero(hidden | of.ignored if len(of.ignored) else hidden)
        x_cam[masked] = (0.0, 0.0, 1.0)
        return masked

    def _evaluate(self, state: State) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
        """Return points in their cameras, which observations are masked, costs and root weights as of _costs."""
        of = self._all
        x_cam, _ = self._in_camera(state, of)
        masked = self._mask(x_cam, of)
        uv = cameras.project(x_cam, of.model, self._params(state, of))
        return x_cam, masked, *self._costs(self._residual(uv, x_cam, masked, of), masked, of)

    def _residual(self, uv: FloatArray, x_cam: FloatArray, masked: IntArray, of: _Observed) -> FloatArray:
        residual = columns.empty(len(uv), 3 if self._has_depth else 2)
        np.multiply(uv - of.uv, of.weight[:, None], out=residual[:, :2])
        if self._has_depth:
            residual[:, 2] = (x_cam[:, 2] - of.depth_m) * of.depth_weight
        residual[masked] = 0.0
        return residual

    def _costs(self, residual: FloatArray, masked: IntArray, of: _Observed) -> tuple[FloatArray, FloatArray]:
        """Return Psi of each observation and the square root of the weight of each row, (n, 1), (n, 2) or (n, 3)."""
        by_component = self.options.loss_per == "component"
        norm = np.abs(residual[:, :2]) if by_component else np.sqrt(residual[:, 0] ** 2 + residual[:, 1] ** 2)[:, None]
        costs, weight = self._loss(norm)
        cost = costs.sum(axis=1) if by_component else costs[:, 0]
        if self.options.cheirality != "keep" and len(masked):
            behind, _ = self._loss(np.array([_BEHIND_NORM]))
            cost[masked] = behind[0]
        if len(of.ignored):
            cost[of.ignored] = 0.0
        root = np.sqrt(weight)
        if self._has_depth:
            depth_cost, depth_weight = self._loss(np.abs(residual[:, 2]))
            cost += depth_cost
            root = np.concatenate([root.T[:1], root.T[-1:], np.sqrt(depth_weight)[None]]).T
        return cost, root

    def _loss(self, norm: FloatArray) -> tuple[FloatArray, FloatArray]:
        return loss.evaluate(self.options.loss, norm, self.options.loss_scale_px, self.graduation)

    def _row_scale(self, root_weight: FloatArray, of: _Observed) -> FloatArray:
        """Return sqrt(weight) / sigma of each row, (n, 1, 2 or 3)."""
        scale = root_weight * of.weight[:, None]
        if self._has_depth:
            scale[:, 2] = root_weight[:, 2] * of.depth_weight
        return scale


def _total(costs: FloatArray) -> float:
    return 0.5 * float(np.sum(costs))


def _once(values: FloatArray) -> FloatArray:
    """Return the first of values (n,) that are all the same, else all."""
    return values[:1] if (values == values[:1]).all() else values


def _lenses(problem: Problem, used: IntArray) -> tuple[NDArray[np.uint8], FloatArray]:
    """Return model and parameters of every observation, or of all if the cameras in use are alike."""
    cams, camera = problem.cameras, problem.observations.camera
    plain = not (cams.params[used, 6:].any() or (cams.model[used] == cameras.Model.EQUIDISTANT).any())
    model, params = cams.model, cams.params[:, : 6 if plain else None]
    if (params[used] == params[used[:1]]).all() and (model[used] == model[used[:1]]).all():
        return model[used[:1]], params[used[:1]]
    return model.take(camera), columns.take(params, camera)


def reprojection_errors(problem: Problem, state: State) -> FloatArray:
    """Return predicted minus measured, (n_obs, 2) px, NaN for points that their camera cannot see."""
    return Objective(replace(problem, factors=()), SolverOptions()).errors(state)


def squared_errors(problem: Problem, state: State) -> FloatArray:
    """Return (2,) the sum of the squares of u and v over the observations whose point is in front, px^2, and how many.

    Sums of parts of a problem are those of the whole.
    """
    total = np.zeros(2)
    for begin in range(0, len(problem.observations), _PIECE):
        seen = (getattr(problem.observations, one.name)[begin : begin + _PIECE] for one in fields(Observations))
        error = reprojection_errors(replace(problem, observations=Observations(*seen), factors=()), state)
        error = error[~np.isnan(error[:, 0])]
        total += np.sum(error * error), error.size
    return total


def rms_px(squares: FloatArray) -> float:
    """Return the rms of what :func:`squared_errors` has summed, px; 0 without any."""
    return float(np.sqrt(squares[0] / squares[1])) if squares[1] else 0.0
