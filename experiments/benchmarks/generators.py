# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make problems with fixed seeds: windows of a forward drive, loops of cameras that look outwards, a sphere.

All in BAL's convention: the camera looks down -z, v upwards, ``u = f (1 + k1 s + k2 s^2) p``, ``p = -(X, Y) / Z``.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.core.geometry import so3_exp, so3_log
from ba_node.io.bal import BalProblem
from experiments.benchmarks.problem_file import Case, sorted_by_point
from experiments.thesis.sphere import generate_sphere, project
from experiments.thesis.sphere_file import start_of
from experiments.thesis.sphere_options import preset

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class Noise:
    """Errors of measurements and of the start."""

    pixel: float = 1.0  # standard deviation of u and v, px
    outliers: float = 0.0  # share of observations that are moved by up to 20 px
    rotation: float = 0.01  # of the start, rad
    position: float = 0.05  # of the start, m
    point: float = 0.2  # of the start, m
    intrinsics: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the start, f (relative), k1, k2


def window(n_keyframes: int, seed: int = 1) -> Case:
    """Return a window: 75 points a keyframe, each seen by up to ten keyframes in a row; rectified, 6 parameters."""
    rng = np.random.default_rng(seed)
    n_points = 75 * n_keyframes
    seen = min(10, n_keyframes)
    first = rng.integers(0, n_keyframes - seen + 1, n_points)
    point = np.repeat(np.arange(n_points), seen)
    camera = (first[:, None] + np.arange(seen)).ravel()
    at = np.arange(n_keyframes) * 0.3
    centre = np.stack([0.5 * np.sin(0.2 * at), 0.02 * rng.normal(size=n_keyframes), -at], axis=1)
    rotation = so3_exp(rng.normal(0.0, 0.03, (n_keyframes, 3)))
    depth = rng.uniform(4.0, 20.0, n_points) + 0.3 * seen
    x = np.stack([rng.uniform(-0.6, 0.6, n_points) * depth, rng.uniform(-0.4, 0.4, n_points) * depth, -depth], axis=1)
    x[:, 2] -= 0.3 * first
    intrinsics = np.tile([500.0, 0.0, 0.0], (n_keyframes, 1))
    noise = Noise(pixel=0.7, outliers=0.02, rotation=0.005, position=0.03, point=0.1)
    return _case(_cameras(rotation, centre, intrinsics), x, (camera, point), noise, rng, n_fixed=2)


def loop(n_cameras: int, n_points: int, seed: int = 2) -> Case:
    """Return cameras a metre apart on a circle, looking outwards; each point is seen by 3 to 12 neighbours."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(n_cameras) / n_cameras
    radius = n_cameras / (2.0 * np.pi)
    centre = radius * np.stack([np.cos(angle), np.zeros(n_cameras), np.sin(angle)], axis=1)
    rotation = _looking(np.stack([np.cos(angle), np.zeros(n_cameras), np.sin(angle)], axis=1))
    rotation = so3_exp(rng.normal(0.0, 0.02, (n_cameras, 3))) @ rotation
    seen = np.minimum(rng.integers(3, 13, n_points), n_cameras)
    middle = rng.uniform(0.0, n_cameras, n_points)
    point = np.repeat(np.arange(n_points), seen)
    nth = np.arange(len(point)) - np.repeat(np.cumsum(seen) - seen, seen)
    camera = (np.round(middle[point] - (seen[point] - 1) / 2.0).astype(np.intp) + nth) % n_cameras
    out = radius + rng.uniform(8.0, 25.0, n_points)
    at = 2.0 * np.pi * middle / n_cameras
    x = np.stack([out * np.cos(at), rng.uniform(-0.35, 0.35, n_points) * (out - radius), out * np.sin(at)], axis=1)
    intrinsics = np.array([800.0, -0.05, 0.01]) + rng.normal(size=(n_cameras, 3)) * [5.0, 0.005, 0.001]
    noise = Noise(rotation=0.005, intrinsics=(0.01, 0.01, 0.002))
    return _case(_cameras(rotation, centre, intrinsics), x, (camera, point), noise, rng)


def sphere(size: str) -> Case:
    """Return a sphere of the thesis (section 5.1, sizes of 5.3), without outliers."""
    data = generate_sphere(dataclasses.replace(preset(size), outlier_share=0.0))
    return Case(sorted_by_point(start_of(data)), 0, 9)


def _case(
    cameras: FloatArray,
    points: FloatArray,
    seen: tuple[IntArray, IntArray],
    noise: Noise,
    rng: np.random.Generator,
    n_fixed: int = 0,
) -> Case:
    """Measure and disturb; fixed cameras start at their true pose."""
    camera, point = seen
    uv = project(cameras, points, camera, point)
    uv += noise.pixel * rng.normal(size=uv.shape)
    wrong = rng.random(len(uv)) < noise.outliers
    uv[wrong] += rng.uniform(-20.0, 20.0, (int(wrong.sum()), 2))
    n = len(cameras)
    moves = (np.arange(n) >= n_fixed)[:, None]
    rotation = so3_exp(cameras[:, :3])
    centre = -(np.swapaxes(rotation, 1, 2) @ cameras[:, 3:6, None])[..., 0]
    rotation = so3_exp(noise.rotation * rng.normal(size=(n, 3)) * moves) @ rotation
    centre = centre + noise.position * rng.normal(size=(n, 3)) * moves
    spread = np.array(noise.intrinsics) * [cameras[0, 6], 1.0, 1.0]
    intrinsics = cameras[:, 6:] + spread * rng.normal(size=(n, 3))
    start = points + noise.point * rng.normal(size=points.shape)
    bal = BalProblem(_cameras(rotation, centre, intrinsics), start, camera, point, uv)
    return Case(sorted_by_point(bal), n_fixed, 9 if any(noise.intrinsics) else 6)


def _cameras(rotation: FloatArray, centre: FloatArray, intrinsics: FloatArray) -> FloatArray:
    translation = -(rotation @ centre[:, :, None])[..., 0]
    return np.hstack([so3_log(rotation), translation, intrinsics])


def _looking(direction: FloatArray) -> FloatArray:
    """Return camera-from-world rotations that look along directions (n, 3), not along y: rows right, up, back."""
    back = -direction
    right = _unit(np.cross([0.0, 1.0, 0.0], back))
    return np.stack([right, np.cross(back, right), back], axis=1)


def _unit(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit
