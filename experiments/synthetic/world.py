# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Build the world: blocks and walls that carry points, and the path of the body among them.

The fixed frame has z up (REP-103); the ground is z = 0. All lengths in m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ba_node.arrays import BoolArray, FloatArray
from ba_node.core.geometry import so3_exp
from experiments.synthetic.options import SyntheticOptions

_WALL_HEIGHT = 3.0
_BODY_HEIGHT = 1.2


@dataclass(frozen=True)
class World:
    """Structure with points on it."""

    points: FloatArray  # (n, 3)
    normals: FloatArray  # (n, 3) unit, out of the surface a point lies on
    boxes: FloatArray  # (k, 2, 3) lowest and highest corner of the solid blocks that hide what is behind them

    def visible(self, eye: FloatArray, max_range_m: float) -> BoolArray:
        """Return which points can be seen from ``eye``: (3,) -> (n,).

        A point is seen if it is between 0.5 m and ``max_range_m`` away, its surface faces the eye at less than
        75 degrees, and no block is in between (slab test of the segment against each box).
        """
        ray = self.points - eye
        distance = np.linalg.norm(ray, axis=1)
        facing = -np.sum(ray * self.normals, axis=1) > math.cos(math.radians(75.0)) * distance
        seen: BoolArray = facing & (distance > 0.5) & (distance < max_range_m)
        rows = np.flatnonzero(seen)
        # Stop short of the point, which lies on the face of its own block.
        segment = 0.999 * ray[rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            hits = (self.boxes - eye) / segment[:, None, None, :]
        # A segment that runs inside the plane of a face has 0/0 there; it grazes and is not hidden by it.
        enter = np.nanmax(np.minimum(hits[:, :, 0], hits[:, :, 1]), axis=2)
        leave = np.nanmin(np.maximum(hits[:, :, 0], hits[:, :, 1]), axis=2)
        hidden = ((enter < leave) & (leave > 0.0) & (enter < 1.0)).any(axis=1)
        seen[rows[hidden]] = False
        return seen


@dataclass(frozen=True)
class Path:
    """True poses of the body, x forward, y left, z up."""

    position: FloatArray  # (n, 3) in the fixed frame
    rotation: FloatArray  # (n, 3, 3) fixed frame from body
    distance: FloatArray  # (n,) travelled since the first


def build(options: SyntheticOptions, rng: np.random.Generator) -> tuple[World, Path]:
    """Return the world and the path through it that the options ask for."""
    if options.path == "loop":
        # Length of the path in units of the turning radius: two lobes of two straights (0.6) and two half circles.
        radius = options.length_m / (2.0 * (2.0 * 0.6 + 2.0 * math.pi))
        boxes, room = _site(radius)
        headings = _loop_headings(radius)
    else:
        boxes, room = _street(options.length_m)
        headings = _line_headings(options.length_m)
    return _with_points(boxes, room, options.landmarks, rng), _drive(options, headings)


def _site(radius: float) -> tuple[FloatArray, FloatArray]:
    """Return two blocks, a pillar at each corner of the site, and the walled room around it all."""
    straight = 0.6 * radius
    half = np.array([0.5 * radius, 0.5 * straight + 0.35 * radius])
    centres = np.array([[-radius, 0.0], [radius, 0.0]])
    blocks = [_box(c - half, c + half) for c in centres]
    reach = np.array([2.75 * radius, 0.5 * straight + 1.75 * radius])
    pillars = [
        _box((x - 0.3, y - 0.3), (x + 0.3, y + 0.3))
        for x in (-0.88 * reach[0], 0.0, 0.88 * reach[0])
        for y in (-0.84 * reach[1], 0.84 * reach[1])
    ]
    return np.array(blocks + pillars), _box(-reach, reach)


def _street(length: float) -> tuple[FloatArray, FloatArray]:
    """Return parked cars and posts along a street, and the walled room of its facades."""
    places = np.arange(0.0, length + 8.0, 8.0)
    side = np.where(np.arange(len(places)) % 2, -1.0, 1.0)
    cars = [_box((x, y - 0.9), (x + 4.0, y + 0.9), 1.5) for x, y in zip(places, 3.6 * side, strict=True)]
    posts = [_box((x + 5.0, y - 0.15), (x + 5.3, y + 0.15)) for x, y in zip(places, -3.2 * side, strict=True)]
    return np.array(cars + posts), _box((-8.0, -6.0), (length + 12.0, 6.0), 2.0 * _WALL_HEIGHT)


def _box(low: ArrayLike, high: ArrayLike, height: float = _WALL_HEIGHT) -> FloatArray:
    """Return (2, 3) the corners of a box that stands on the ground between two corners (2,) in the plane."""
    return np.array([[*np.asarray(low), 0.0], [*np.asarray(high), height]])


def _with_points(boxes: FloatArray, room: FloatArray, count: int, rng: np.random.Generator) -> World:
    """Spread points evenly over the sides of the boxes, the walls of the room and its ground."""
    faces = np.concatenate([*(_faces(box, 1.0) for box in boxes), _faces(room, -1.0)])
    # The ground carries a quarter of the density: less of what a detector likes.
    area = np.linalg.norm(faces[:, 1], axis=1) * np.linalg.norm(faces[:, 2], axis=1)
    area[-1] *= 0.25
    face = np.sort(rng.choice(len(faces), count, p=area / area.sum()))
    along = rng.random((count, 2))
    points = faces[face, 0] + along[:, :1] * faces[face, 1] + along[:, 1:] * faces[face, 2]
    return World(points, faces[face, 3], boxes)


def _faces(box: FloatArray, outward: float) -> FloatArray:
    """Return (5, 4, 3) corner, two edges and normal: four sides, and the top of a block or the ground of a room."""
    low, high = box
    x, y, z = np.diag(high - low)
    ex, ey = outward * np.eye(3)[:2]
    level = high[2] if outward > 0.0 else low[2]
    return np.array(
        [
            [low, y, z, -ex],
            [low + x, y, z, ex],
            [low, x, z, -ey],
            [low + y, x, z, ey],
            [[low[0], low[1], level], x, y, [0.0, 0.0, 1.0]],
        ]
    )


def _loop_headings(radius: float) -> FloatArray:
    """Return (k, 2) distance and heading: up the passage, around the left block, up again, around the right one."""
    straight, turn = 0.6 * radius, math.pi * radius
    lengths = np.array([straight / 2, turn, straight, turn, straight, turn, straight, turn, straight / 2])
    turns = math.pi * np.array([0, 1, 0, 1, 0, -1, 0, -1, 0])
    distance = np.concatenate([[0.0], np.cumsum(lengths)])
    heading = math.pi / 2 + np.concatenate([[0.0], np.cumsum(turns)])
    return np.stack([distance, heading], axis=1)


def _line_headings(length: float) -> FloatArray:
    """Return (k, 2) distance and heading of a drive that sways about the middle of the street."""
    distance = np.linspace(0.0, length, 1 + 8 * math.ceil(length))
    return np.stack([distance, 0.12 * np.cos(2.0 * math.pi * distance / 24.0)], axis=1)


def _drive(options: SyntheticOptions, headings: FloatArray) -> Path:
    """Follow the headings (linear between the knots) and take a pose every length / (keyframes - 1)."""
    fine = np.linspace(0.0, options.length_m, 1 + 200 * math.ceil(options.length_m))
    heading = np.interp(fine, headings[:, 0], headings[:, 1])
    speed = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    steps = 0.5 * (speed[1:] + speed[:-1]) * fine[1]
    track = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    s = np.linspace(0.0, options.length_m, options.keyframes)
    # A body that is carried nods, rolls and bobs a little.
    height = _BODY_HEIGHT + 0.05 * np.sin(2.0 * math.pi * s / 1.7)
    position = np.stack([np.interp(s, fine, track[:, 0]), np.interp(s, fine, track[:, 1]), height], axis=1)
    zero = np.zeros_like(s)
    yaw = so3_exp(np.stack([zero, zero, np.interp(s, headings[:, 0], headings[:, 1])], axis=1))
    sway = so3_exp(0.03 * np.stack([np.sin(1.9 * s), np.cos(1.3 * s), zero], axis=1))
    return Path(position, yaw @ sway, s)
