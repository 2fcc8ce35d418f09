# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make small problems with known answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from ba_node.core import cameras, geometry
from ba_node.core.problem import Cameras, Observations, Problem, State


@dataclass(frozen=True)
class Spec:
    """What a problem of the tests looks like."""

    keyframes: int = 5
    points: int = 40
    stereo: bool = False
    depth: bool = False
    free_intrinsics: bool = False
    distorted: bool = True
    fixed: int = 1
    noise_px: float = 0.5
    start_error: float = 0.01
    seen_share: float = 0.7
    track: int = 0  # points are seen by so many keyframes in a row, and by no others; 0: by any
    spacing_m: float = 0.4
    seed: int = 0


MakeProblem = Callable[..., tuple[Problem, State]]


def make(spec: Spec) -> tuple[Problem, State]:
    """Return a problem and its true state."""
    rng = np.random.default_rng(spec.seed)
    truth = _truth(spec, rng)
    cams = _cameras(spec)
    n_cam = len(cams.model)
    seen = rng.random((spec.points, spec.keyframes, n_cam)) < spec.seen_share
    seen[:, :2] = True
    if spec.track:
        first = np.arange(spec.points) * (spec.keyframes - spec.track + 1) // spec.points
        ahead = np.arange(spec.keyframes) - first[:, None]
        seen[...] = ((ahead >= 0) & (ahead < spec.track))[:, :, None]
    point, keyframe, camera = np.nonzero(seen)
    n = len(point)
    unmeasured = Observations(keyframe, camera, point, np.zeros((n, 2)), np.ones(n), np.empty(0), np.empty(0))
    x_cam, uv = _project(Problem(truth, np.zeros(spec.keyframes, bool), cams, unmeasured), truth)
    depth = np.where(rng.random(n) < 0.5, x_cam[:, 2], np.nan) if spec.depth else np.empty(0)
    observations = Observations(
        keyframe=keyframe,
        camera=camera,
        point=point,
        uv=uv + rng.normal(0.0, 1.0, (n, 2)) * spec.noise_px,
        sigma_px=rng.uniform(0.5, 2.0, n),
        depth_m=depth * (1.0 + 0.01 * rng.normal(size=len(depth))),
        depth_sigma_m=0.02 * np.abs(depth),
    )
    return Problem(_disturb(truth, spec, rng), np.arange(spec.keyframes) < spec.fixed, cams, observations), truth


def _truth(spec: Spec, rng: np.random.Generator) -> State:
    k = spec.keyframes
    rotation = geometry.so3_exp(rng.normal(0.0, 0.1, (k, 3)))
    centre = np.stack([spec.spacing_m * np.arange(k), 0.1 * rng.normal(size=k), 0.1 * rng.normal(size=k)], axis=1)
    points = rng.uniform([-2.0, -2.0, 4.0], [4.0, 2.0, 9.0], (spec.points, 3))
    own = np.tile([400.0, -0.1, 0.02], (k, 1)) + rng.normal(size=(k, 3)) * [5.0, 0.01, 0.002]
    intrinsics = own if spec.free_intrinsics else np.empty((0, 3))
    return State(rotation, -(rotation @ centre[:, :, None])[..., 0], points, intrinsics)


def _cameras(spec: Spec) -> Cameras:
    n = 2 if spec.stereo else 1
    params = np.zeros((n, cameras.N_PARAMS))
    params[:, :4] = (1.0, 1.0, 0.0, 0.0) if spec.free_intrinsics else (400.0, 410.0, 320.0, 240.0)
    if spec.distorted and not spec.free_intrinsics:
        params[:, 4:9] = (-0.2, 0.05, 1e-3, -2e-3, 0.01)
    rotation = geometry.so3_exp(np.array([[0.0, 0.0, 0.0], [0.01, -0.02, 0.03]])[:n])
    translation = np.array([[0.0, 0.0, 0.0], [-0.2, 0.0, 0.01]])[:n]
    return Cameras(rotation, translation, np.zeros(n, np.uint8), params)


def _project(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Project by the definition, observation by observation: the slow and obvious route."""
    obs, cams = problem.observations, problem.cameras
    x_cam, uv = np.empty((len(obs), 3)), np.empty((len(obs), 2))
    for i in range(len(obs)):
        k, c = obs.keyframe[i], obs.camera[i]
        body = state.rotation[k] @ state.points[obs.point[i]] + state.translation[k]
        x_cam[i] = cams.rotation[c] @ body + cams.translation[c]
        params = cams.params[c].copy()
        if problem.free_intrinsics:
            params[:2] *= state.intrinsics[k, 0]
            params[4:6] = state.intrinsics[k, 1:]
        a, b = x_cam[i, 0] / x_cam[i, 2], x_cam[i, 1] / x_cam[i, 2]
        s = a * a + b * b
        k1, k2, p1, p2, k3 = params[4:9]
        g = 1 + k1 * s + k2 * s**2 + k3 * s**3
        uv[i, 0] = params[0] * (a * g + 2 * p1 * a * b + p2 * (s + 2 * a * a)) + params[2]
        uv[i, 1] = params[1] * (b * g + p1 * (s + 2 * b * b) + 2 * p2 * a * b) + params[3]
    return x_cam, uv


def _disturb(truth: State, spec: Spec, rng: np.random.Generator) -> State:
    e, k = spec.start_error, spec.keyframes
    moves = np.arange(k)[:, None] >= spec.fixed
    intrinsics = truth.intrinsics * (1.0 + e * rng.normal(size=truth.intrinsics.shape))
    if len(intrinsics):
        intrinsics[: spec.fixed] = truth.intrinsics[: spec.fixed]
    return State(
        rotation=truth.rotation @ geometry.so3_exp(e * rng.normal(size=(k, 3)) * moves),
        translation=truth.translation + e * rng.normal(size=(k, 3)) * moves,
        points=truth.points + 10 * e * rng.normal(size=truth.points.shape),
        intrinsics=intrinsics,
    )


@pytest.fixture
def make_problem() -> MakeProblem:
    """Return a function from the fields of Spec to a problem and its true state."""

    def _make(**fields: object) -> tuple[Problem, State]:
        return make(Spec(**fields))  # type: ignore[arg-type]

    return _make
