# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Worlds and motions that determine little: standing still, turning on the spot, points far away."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.core.geometry import so3_exp
from experiments.synthetic.world import Path, World

# What dead reckoning errs by while the body stands: that of so many metres a keyframe.
_STILL_M = 1e-3


def stands_still(world: World, path: Path, amount: float) -> tuple[World, Path]:
    """Stand at the first pose for some keyframes, then go on."""
    return world, _taken(path, np.maximum(0, np.arange(len(path.position)) - int(amount)))


def stops_midway(world: World, path: Path, amount: float) -> tuple[World, Path]:
    """Stop in the middle for some keyframes, then go on."""
    n = len(path.position)
    k, at = np.arange(n), (n - int(amount)) // 2
    return world, _taken(path, np.where(k < at, k, np.maximum(at, k - int(amount))))


def pure_rotation(world: World, path: Path, amount: float) -> tuple[World, Path]:
    """Turn on the spot at the first pose, by some degrees a keyframe."""
    n = len(path.position)
    angle = np.zeros((n, 3))
    angle[:, 2] = np.radians(amount) * np.arange(n)
    rotation = path.rotation[0] @ so3_exp(angle)
    distance = 20.0 * _STILL_M * np.arange(n, dtype=np.float64)
    return world, Path(np.tile(path.position[0], (n, 1)), rotation, distance)


def hardly_moves(world: World, path: Path, amount: float) -> tuple[World, Path]:
    """Move some millimetres a keyframe for the first ten, then go on as asked."""
    k = np.arange(len(path.position))
    first = path.position[0] + np.outer(np.minimum(k, 10), path.rotation[0][:, 1]) * 1e-3 * amount
    later = _taken(path, np.maximum(0, k - 10))
    position = np.where(k[:, None] <= 10, first, later.position - path.position[0] + first[-1])
    return world, dataclasses.replace(later, position=position)


def far_points(world: World, path: Path, amount: float) -> tuple[World, Path]:
    """Put all points some kilometres away, in the directions in which the first pose sees the structure."""
    ray = world.points - path.position[0]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    # Ahead of the whole path, so that tracks last.
    ray = ray[ray @ path.rotation[0][:, 0] > 0.3]
    points = path.position[0] + 1e3 * amount * ray
    return World(points, -ray, np.empty((0, 2, 3))), path


def _taken(path: Path, rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> Path:
    """Return the path by rows that may repeat."""
    still = _STILL_M * np.concatenate([[0.0], np.cumsum(np.diff(rows) == 0)])
    return Path(path.position[rows], path.rotation[rows], path.distance[rows] + still)
