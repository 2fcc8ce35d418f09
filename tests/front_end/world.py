# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Render what cameras see of a corridor: floor, walls, ceiling and an end wall, all textured; z is along it."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import cameras, geometry
from ba_node.estimate import Transform
from ba_node.front_end import Images
from ba_node.measurements import CameraRig

SIZE = (320, 240)
FOCAL, BASELINE = 200.0, 0.2
STEP_NS = 100_000_000
# Axis, place (m) and how many pixels of the texture are a metre.
_PLANES = ((1, 1.2, 90.0), (1, -2.0, 90.0), (0, -2.2, 80.0), (0, 2.2, 80.0), (2, 22.0, 50.0))


@functools.cache
def _texture(seed: int) -> Any:
    """Return noise of several sizes: (1024, 1024) float32, grey values; it repeats."""
    rng, total = np.random.default_rng(seed), np.zeros((1024, 1024), np.float32)
    for sigma, weight in ((1.0, 20.0), (3.0, 25.0), (9.0, 25.0)):
        noise = cv2.GaussianBlur(rng.normal(size=total.shape).astype(np.float32), (0, 0), sigma)
        total += weight * noise / noise.std()
    return np.clip(total + 120.0, 5.0, 250.0)


def rig(cameras_count: int = 2, distortion: tuple[float, ...] = (), turn: FloatArray | None = None) -> CameraRig:
    """Return one camera, or two side by side, the second one turned."""
    centre = [0.5 * (SIZE[0] - 1), 0.5 * (SIZE[1] - 1)]
    orientation = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    if turn is not None:
        orientation[1] = geometry.quaternion_from_matrix(geometry.so3_exp(turn))
    n = cameras_count
    return CameraRig(
        "body", ("left", "right")[:n], ("plumb_bob",) * n, np.tile([FOCAL, FOCAL, *centre], (n, 1)),
        (np.array(distortion),) * n, np.tile(np.array(SIZE, dtype=np.int64), (n, 1)),
        np.array([[0.0, 0.0, 0.0], [BASELINE, 0.0, 0.0]])[:n], orientation[:n],
    )  # fmt: skip


@functools.cache
def _rays(model: int, params: tuple[float, ...]) -> FloatArray:
    """Return where each pixel of a camera looks, (n, 3) with z = 1."""
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    uv = np.column_stack([x.ravel(), y.ravel()])
    flat = cameras.normalise(uv, np.full(len(uv), model), np.tile(params, (len(uv), 1)))
    return np.column_stack([flat, np.ones(len(uv))])


@dataclass(frozen=True)
class View:
    """A grey image and its depths."""

    grey: Any
    depth_m: Any


def render(of: CameraRig, index: int, body: Transform, noise: float = 1.0) -> View:
    """Return what a camera of a rig on a body sees."""
    model, params = cameras.parameters(of.models[index], of.intrinsics[index], of.distortion[index])
    ray = _rays(int(model), tuple(params.tolist()))
    eye = body.rotation @ of.position[index] + body.translation
    direction = ray @ (body.rotation @ geometry.matrix_from_quaternion(of.orientation[index])).T
    nearest, grey = np.full(len(ray), np.inf), np.zeros(len(ray), np.float32)
    for seed, (axis, place, scale) in enumerate(_PLANES):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (place - eye[axis]) / direction[:, axis]
        seen = (depth > 0.05) & (depth < nearest)
        along = np.where(seen, depth, 0.0)[:, None]
        at = (eye + direction * along)[:, [i for i in range(3) if i != axis]] * scale
        at = np.mod(at, 1023.0).astype(np.float32).reshape(*SIZE[::-1], 2)
        grey[seen] = cv2.remap(_texture(seed), at[..., 0], at[..., 1], cv2.INTER_LINEAR).ravel()[seen]
        nearest[seen] = depth[seen]
    rng = np.random.default_rng(round(1e6 * float(np.abs(body.translation).sum())) + index)
    noisy = cv2.GaussianBlur(grey.reshape(SIZE[::-1]), (0, 0), 0.7) + noise * rng.normal(size=SIZE[::-1])
    return View(np.clip(np.round(noisy), 0, 255).astype(np.uint8), nearest.reshape(SIZE[::-1]).astype(np.float32))


def drive(count: int, step_m: float = 0.25, turn_rad: float = 0.01) -> list[Transform]:
    """Return poses of a body that drives along the corridor in a bend."""
    poses, pose = [], Transform(np.eye(3), np.zeros(3))
    step = Transform(geometry.so3_exp(np.array([0.0, turn_rad, 0.0])), np.array([0.0, 0.0, step_m]))
    for i in range(count):
        poses.append(pose)
        turned = step if i % 8 < 4 else Transform(step.rotation.T, step.translation)
        pose = pose.after(turned)
    return poses


def images(of: CameraRig, body: Transform, number: int, depth: bool = False) -> Images:
    """Return the images of a rig."""
    views = [render(of, i, body) for i in range(len(of))]
    grey = tuple(view.grey for view in views)
    return Images(1_000_000_000 + number * STEP_NS, grey, views[0].depth_m if depth else None)


def without(one: Images, **changes: Any) -> Images:
    """Return images with some fields changed."""
    return dataclasses.replace(one, **changes)
