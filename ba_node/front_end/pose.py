# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the pose of a camera from points that it sees: by consensus (PoseLib's P3P in RANSAC), then weighted.

The weighted step minimises ``sum rho(|C^-1/2 (u - pi(R X + t))|^2)`` by Gauss-Newton with Cauchy's rho, where C is the
covariance of a pixel and of the point's own depth as it appears in the image: a point that is far has an uncertain
depth, which matters for a camera that has come nearer and not for its turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end.opencv import poselib
from ba_node.front_end.rectify import IdealRig

_STEPS = 8
# A step that ends it, rad and m.
_SMALL = 3e-5
_CAUCHY = 2.0


@dataclass(frozen=True)
class Seen:
    """Points and where they are seen."""

    points: FloatArray  # (n, 3) in the map, m
    uv: FloatArray  # (n, 2) px
    sigma: FloatArray  # (n,) of u and of v, px
    along: FloatArray  # (n, 3) one standard deviation of the point by its depth, a vector in the map, m


def consensus(rig: IdealRig, seen: Seen, error_px: float) -> tuple[Transform, BoolArray] | None:
    """Return camera from map, and which points agree with it to so many pixels; None where RANSAC finds nothing."""
    if len(seen.points) < 4:
        return None
    options = {"max_reproj_error": error_px, "min_iterations": 25, "max_iterations": 1000, "seed": 1}
    pose, info = poselib().estimate_absolute_pose(seen.uv, seen.points, _camera(rig), options, {})
    agree = np.array(info.get("inliers", []), dtype=bool)
    if agree.shape != (len(seen.points),) or agree.sum() < 4:
        return None
    return Transform(np.array(pose.R), np.array(pose.t)), agree


def relative(rig: IdealRig, before: FloatArray, now: FloatArray, error_px: float) -> tuple[Transform, BoolArray] | None:
    """Return camera now from camera before, 1 apart, by what both see (n, 2), px, and which agree."""
    if len(before) < 8:
        return None
    options = {"max_epipolar_error": error_px, "min_iterations": 100, "max_iterations": 2000, "seed": 1}
    pose, info = poselib().estimate_relative_pose(before, now, _camera(rig), _camera(rig), options, {})
    agree = np.array(info.get("inliers", []), dtype=bool)
    length = float(np.linalg.norm(pose.t))
    if agree.shape != (len(before),) or agree.sum() < 8 or length < 1e-9:
        return None
    return Transform(np.array(pose.R), np.array(pose.t) / length), agree


def _camera(rig: IdealRig) -> dict[str, Any]:
    width, height = rig.size
    return {"model": "PINHOLE", "width": width, "height": height, "params": [rig.focal, rig.focal, *rig.centre]}


def refine(rig: IdealRig, seen: Seen, camera_from_map: Transform) -> tuple[Transform, FloatArray, FloatArray]:
    """Return the weighted pose, its (6, 6) covariance (turn, place; of the camera) and each point's error in sigmas."""
    pose = camera_from_map
    for _ in range(_STEPS):
        H, b, _ = _equations(rig, seen, pose)
        step = np.linalg.solve(H + (1e-9 * np.trace(H) + 1e-300) * np.eye(6), b)
        if not np.isfinite(step).all():
            return camera_from_map, np.full((6, 6), np.nan), errors(rig, seen, camera_from_map)
        pose = Transform(geometry.so3_exp(step[:3]), step[3:]).after(pose)
        if np.linalg.norm(step) < _SMALL:
            break
    H, _, size = _equations(rig, seen, pose)
    if not (np.isfinite(H).all() and np.isfinite(size).all()):
        return camera_from_map, np.full((6, 6), np.nan), errors(rig, seen, camera_from_map)
    return pose, np.linalg.inv(H + (1e-12 * np.trace(H) + 1e-300) * np.eye(6)), size


def _equations(rig: IdealRig, seen: Seen, pose: Transform) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return J' W J, J' W e, and each point's error in sigmas."""
    if native.kernels is not None:
        camera = np.array([rig.focal, *rig.centre])
        of = seen.points, seen.along, seen.uv, seen.sigma, camera
        found: tuple[FloatArray, FloatArray, FloatArray] = native.kernels.pose_equations(
            of, pose.rotation, pose.translation, _CAUCHY
        )
        return found
    error, jacobian = _linear(rig, seen, pose)
    size = np.linalg.norm(error, axis=1)
    J = jacobian.reshape(-1, 6)
    weighted = J.T * np.repeat(1.0 / (1.0 + (size / _CAUCHY) ** 2), 2)
    return weighted @ J, weighted @ error.reshape(-1), size


def _linear(rig: IdealRig, seen: Seen, pose: Transform) -> tuple[FloatArray, FloatArray]:
    """Return whitened errors (n, 2) and Jacobians (n, 2, 6) by turn and place."""
    # Columns, as numpy's products of many small matrices take ten times as long.
    x, y, depth = pose.rotation @ seen.points.T + pose.translation[:, None]
    mx, my, mz = pose.rotation @ seen.along.T
    f, z = rig.focal, np.maximum(depth, 1e-3)
    a, u, v = f / z, x / z, y / z
    smear_u, smear_v = a * (mx - u * mz), a * (my - v * mz)
    # C = s^2 I + m m':  C^-1/2 = (I - m m' k) / s with k as below.
    m2 = smear_u * smear_u + smear_v * smear_v
    s = seen.sigma
    k = np.where(m2 > 0.0, (1.0 - 1.0 / np.sqrt(1.0 + m2 / (s * s))) / np.maximum(m2, 1e-300), 0.0) / s
    uu, uv, vv = 1.0 / s - k * smear_u * smear_u, -k * smear_u * smear_v, 1.0 / s - k * smear_v * smear_v
    error_u, error_v = seen.uv.T - (f * np.stack([u, v]) + rig.centre[:, None])
    d = depth / z  # 1, but for points that are too near
    zero = np.zeros(len(x))
    by_u = (-f * u * v, f * (d + u * u), -f * v, a, zero, -a * u)
    by_v = (-f * (d + v * v), f * u * v, f * u, zero, a, -a * v)
    jacobian = np.empty((len(x), 2, 6))
    for column, (du, dv) in enumerate(zip(by_u, by_v, strict=True)):
        jacobian[:, 0, column] = uu * du + uv * dv
        jacobian[:, 1, column] = uv * du + vv * dv
    return np.stack([uu * error_u + uv * error_v, uv * error_u + vv * error_v], axis=1), jacobian


def errors(rig: IdealRig, seen: Seen, camera_from_map: Transform) -> FloatArray:
    """Return how far each point is from where a pose has it, in standard deviations: (n,)."""
    if not len(seen.points):
        return np.empty(0)
    error, _ = _linear(rig, seen, camera_from_map)
    return np.asarray(np.linalg.norm(error, axis=1))
