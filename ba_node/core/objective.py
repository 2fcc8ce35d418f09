# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Residuals of a problem and their derivatives (2.17-2.26, 3.26-3.37), for all observations at once.

A residual has two rows (u, v: predicted minus measured over sigma_px) and, when any observation of the problem
carries a depth, a third (Z minus depth over its sigma; zero where there is none). The pixel part and the depth part
are weighed by the loss separately.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.core import cameras, loss, parameterisation
from ba_node.core.problem import Problem, State

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

# A point nearer to the camera plane than this (m) counts as on it.
MIN_DEPTH = 1e-6
# What a point behind its camera costs under ``constant``: as much as a residual of this norm.
_BEHIND_NORM = 100.0


@dataclass(frozen=True)
class Rules:
    """How residuals are judged.

    Attributes:
        parameterisation: how a pose is stepped.
        loss: robust loss.
        loss_scale: where it leaves the square, in sigmas.
        cheirality: what points behind their camera cost.
    """

    parameterisation: str = "local"
    loss: str = "squared"
    loss_scale: float = 1.0
    cheirality: str = "keep"


@dataclass(frozen=True)
class Linearisation:
    """Residuals and Jacobians, both already multiplied by the square root of the IRLS weight.

    Attributes:
        objective: 1/2 sum Psi.
        residual: (n_obs, d), d = 2 or 3.
        d_keyframe: (n_obs, d, 6 or 9).
        d_point: (n_obs, d, 3).
    """

    objective: float
    residual: FloatArray
    d_keyframe: FloatArray
    d_point: FloatArray


@dataclass(frozen=True)
class PointRows:
    """What one observation says about its point alone.

    Attributes:
        cost: (n_obs,) Psi.
        residual: (n_obs, d), weighted.
        d_point: (n_obs, d, 3), weighted.
    """

    cost: FloatArray
    residual: FloatArray
    d_point: FloatArray


class Objective:
    """The objective of one problem under given rules; knows which image each observation belongs to."""

    def __init__(self, problem: Problem, rules: Rules) -> None:
        """Prepare the indices that stay the same over all iterations."""
        self.problem = problem
        self.rules = rules
        # mu of the surrogate that stands in for a truncated quadratic; infinite for the loss itself.
        self.graduation = np.inf
        obs, cams = problem.observations, problem.cameras
        n_cam = max(len(cams.model), 1)
        key = obs.keyframe * n_cam + obs.camera
        used = np.zeros(problem.n_keyframes * n_cam, dtype=bool)
        used[key] = True
        images, self._image = np.flatnonzero(used), (np.cumsum(used) - 1).take(key)
        self._image_keyframe, self._image_camera = images // n_cam, images % n_cam
        self._model = cams.model[obs.camera]
        self._params = cams.params.take(obs.camera, axis=0)
        self._has_depth = len(obs.depth_m) > 0
        self._ignored: BoolArray | None = None
        if rules.cheirality == "drop":
            self._ignored = self.in_camera(problem.start)[:, 2] <= MIN_DEPTH

    def in_camera(self, state: State) -> FloatArray:
        """Return the observed points in their camera's optical frame, (n_obs, 3), m."""
        rotation, translation = self._image_poses(state)
        # By columns: three times as fast as a product of small matrices for each row.
        x, y, z = (state.points[:, j].take(self.problem.observations.point) for j in range(3))
        out = np.empty((len(self._image), 3))
        for i in range(3):
            a, b, c = (rotation[:, i, j].take(self._image) for j in range(3))
            out[:, i] = a * x + b * y + c * z + translation[:, i].take(self._image)
        return out

    def errors(self, state: State) -> FloatArray:
        """Return predicted minus measured, (n_obs, 2) px, NaN for points on or behind the camera plane."""
        x_cam = self.in_camera(state)
        behind = x_cam[:, 2] <= MIN_DEPTH
        x_cam[behind] = (0.0, 0.0, 1.0)
        errors = cameras.project(x_cam, self._model, self._row_params(state)) - self.problem.observations.uv
        errors[behind] = np.nan
        return errors

    def value(self, state: State) -> float:
        """Return the objective 1/2 sum Psi."""
        x_cam = self.in_camera(state)
        masked = self._mask(x_cam)
        uv = cameras.project(x_cam, self._model, self._row_params(state))
        residual = self._residual(uv, x_cam, masked)
        return self._total(self._costs(residual, masked)[0])

    def weighted_squares(self, state: State) -> tuple[float, int]:
        """Return ``r' W r`` with the IRLS weights W, and the number of rows that count (not those behind a camera)."""
        x_cam = self.in_camera(state)
        masked = self._mask(x_cam)
        uv = cameras.project(x_cam, self._model, self._row_params(state))
        residual = self._residual(uv, x_cam, masked)
        weighted = residual * self._costs(residual, masked)[1]
        rows = 2 * np.count_nonzero(~masked)
        if self._has_depth:
            rows += np.count_nonzero(np.isfinite(self.problem.observations.depth_m[~masked]))
        return float(np.sum(weighted * weighted)), int(rows)

    def linearise(self, state: State) -> Linearisation:
        """Return residuals and Jacobians at a state."""
        rows, d_intrinsics = self._rows(state)
        obs = self.problem.observations
        d_keyframe = parameterisation.pose_jacobian(
            self.rules.parameterisation, rows.d_point, state.points[obs.point], state.rotation, obs.keyframe
        )
        if self.problem.free_intrinsics:
            d_keyframe = np.concatenate([d_keyframe, d_intrinsics], axis=2)
        return Linearisation(self._total(rows.cost), rows.residual, d_keyframe, rows.d_point)

    def point_rows(self, state: State) -> PointRows:
        """Return costs, residuals and derivatives by the points."""
        return self._rows(state)[0]

    def _rows(self, state: State) -> tuple[PointRows, FloatArray]:
        """Return the points' rows, and the derivatives by f, k1, k2 (n_obs, d, 3), all weighted."""
        x_cam = self.in_camera(state)
        masked = self._mask(x_cam)
        rotation, _ = self._image_poses(state)
        uv, d_cam, d_intrinsics = cameras.project_jacobian(x_cam, self._model, self._row_params(state))
        residual = self._residual(uv, x_cam, masked)
        costs, root_weight = self._costs(residual, masked)
        scale = self._row_scale(root_weight)
        if self._has_depth:
            n = len(d_cam)
            d_cam = np.concatenate([d_cam, np.broadcast_to([[0.0, 0.0, 1.0]], (n, 1, 3))], axis=1)
            d_intrinsics = np.concatenate([d_intrinsics, np.zeros((n, 1, 3))], axis=1)
        # Rows of masked observations may hold infinities: written over, not multiplied by zero.
        d_cam[masked], d_intrinsics[masked] = 0.0, 0.0
        d_point = (d_cam * scale[:, :, None]) @ rotation[self._image]
        return PointRows(costs, residual * root_weight, d_point), d_intrinsics * scale[:, :, None]

    def retract(self, state: State, step_keyframes: FloatArray, step_points: FloatArray) -> State:
        """Return the state after a step: (n_kf, 6 or 9) and (n_pt, 3)."""
        rotation, translation = parameterisation.retract(
            self.rules.parameterisation, state.rotation, state.translation, step_keyframes[:, :6]
        )
        intrinsics = state.intrinsics + step_keyframes[:, 6:] if len(state.intrinsics) else state.intrinsics
        return State(rotation, translation, state.points + step_points, intrinsics)

    def _image_poses(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Return camera from world of every image (keyframe, camera)."""
        cams = self.problem.cameras
        rotation_cb = cams.rotation[self._image_camera]
        rotation = rotation_cb @ state.rotation[self._image_keyframe]
        moved = (rotation_cb @ state.translation[self._image_keyframe][:, :, None])[..., 0]
        return rotation, moved + cams.translation[self._image_camera]

    def _row_params(self, state: State) -> FloatArray:
        """Return the camera parameters of every observation, with the keyframe's own f, k1, k2 put in if free."""
        if not self.problem.free_intrinsics:
            return self._params
        params = self._params.copy()
        own = state.intrinsics[self.problem.observations.keyframe]
        params[:, cameras.FX] *= own[:, 0]
        params[:, cameras.FY] *= own[:, 0]
        params[:, 4:6] += own[:, 1:]
        return params

    def _mask(self, x_cam: FloatArray) -> BoolArray:
        """Return which observations push nothing, and move their points off the plane so that nothing is infinite."""
        if self.rules.cheirality == "keep":
            masked = np.abs(x_cam[:, 2]) < MIN_DEPTH * 1e-6
        else:
            masked = x_cam[:, 2] <= MIN_DEPTH
        if self._ignored is not None:
            masked = masked | self._ignored
        x_cam[masked] = (0.0, 0.0, 1.0)
        return masked

    def _residual(self, uv: FloatArray, x_cam: FloatArray, masked: BoolArray) -> FloatArray:
        obs = self.problem.observations
        residual = (uv - obs.uv) / obs.sigma_px[:, None]
        if self._has_depth:
            depth = np.nan_to_num((x_cam[:, 2] - obs.depth_m) / obs.depth_sigma_m, nan=0.0)
            residual = np.concatenate([residual, depth[:, None]], axis=1)
        residual[masked] = 0.0
        return residual

    def _costs(self, residual: FloatArray, masked: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return Psi of each observation and the square root of the weight of each row, (n, 1) or (n, 3)."""
        rules = self.rules
        norm = np.sqrt(residual[:, 0] ** 2 + residual[:, 1] ** 2)
        cost, weight = self._loss(norm)
        if rules.cheirality != "keep" and masked.any():
            behind, _ = self._loss(np.array([_BEHIND_NORM]))
            cost[masked] = behind[0]
        if self._ignored is not None:
            cost[self._ignored] = 0.0
        root = np.sqrt(weight)[:, None]
        if self._has_depth:
            depth_cost, depth_weight = self._loss(np.abs(residual[:, 2]))
            cost = cost + depth_cost
            root = np.concatenate([root, root, np.sqrt(depth_weight)[:, None]], axis=1)
        return cost, root

    def _loss(self, norm: FloatArray) -> tuple[FloatArray, FloatArray]:
        return loss.evaluate(self.rules.loss, norm, self.rules.loss_scale, self.graduation)

    def _row_scale(self, root_weight: FloatArray) -> FloatArray:
        """Return sqrt(weight) / sigma of each row, (n, 1 or 3)."""
        obs = self.problem.observations
        scale = root_weight / obs.sigma_px[:, None]
        if self._has_depth:
            depth = np.nan_to_num(root_weight[:, 2] / obs.depth_sigma_m, nan=0.0)
            scale[:, 2] = np.where(np.isnan(obs.depth_m), 0.0, depth)
        return scale

    @staticmethod
    def _total(costs: FloatArray) -> float:
        return 0.5 * float(np.sum(costs))


def reprojection_errors(problem: Problem, state: State) -> FloatArray:
    """Return predicted minus measured, (n_obs, 2) px, NaN for points on or behind the camera plane."""
    return Objective(problem, Rules()).errors(state)
