# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make problems of any size part by part, the same for any number of parts: streets, cities and loops.

Every rank makes all cameras and its own points alone. Points are made by chunks, each with a seed of its own.

Cameras stand a metre apart and look to one side of their street: a street is straight, the streets of a city are rows
ten metres behind each other, of which those behind see over those before, so that S couples cameras as a grid does; a
loop is a circle that looks outwards. A point is seen by cameras around the place of its track, 2 + g of them with g
geometric, in a city shared by up to three rows. In BAL's convention, as generators.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.core.geometry import so3_exp, so3_log
from ba_node.core.problem import Problem
from ba_node.io.bal import BalProblem, to_problem
from experiments.thesis.sphere import project

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_CHUNK = 4096  # points
_ROW_M = 10.0  # between the streets of a city


@dataclass(frozen=True)
class Stream:
    """A problem that is not made yet."""

    kind: str  # street, city or loop
    n_cameras: int
    n_points: int
    track: float  # mean number of cameras that see a point
    seed: int = 3

    @property
    def rows(self) -> int:
        """Return the number of streets."""
        return max(1, round(np.sqrt(self.n_cameras / 4.0))) if self.kind == "city" else 1

    def part(self, rank: int, size: int) -> Problem:
        """Return the part of a rank: all cameras, and points of its own with their observations."""
        chunks = -(-self.n_points // _CHUNK)
        true, start = self._cameras()
        made = [self._chunk(chunk, true) for chunk in range(chunks * rank // size, chunks * (rank + 1) // size)]
        counts = np.cumsum([0] + [len(points) for points, *_ in made])
        camera, uv = (np.concatenate([chunk[i] for chunk in made]) for i in (1, 3))
        point = np.concatenate([chunk[2] + first for chunk, first in zip(made, counts, strict=False)])
        points = np.concatenate([chunk[0] for chunk in made])
        del made
        return to_problem(BalProblem(start, points, camera, point, uv))

    def _cameras(self) -> tuple[FloatArray, FloatArray]:
        """Return true cameras and those of the start, (n_cameras, 9) each."""
        rng = np.random.default_rng(self.seed)
        n = self.n_cameras
        centre, forward = self._place(np.arange(n, dtype=np.float64), np.zeros(n))
        right = np.cross([0.0, 1.0, 0.0], -forward)
        rotation = so3_exp(rng.normal(0.0, 0.02, (n, 3))) @ np.stack([right, np.cross(-forward, right), -forward], 1)
        intrinsics = np.array([800.0, -0.05, 0.01]) + rng.normal(size=(n, 3)) * [5.0, 0.005, 0.001]
        true = _bal(rotation, centre, intrinsics)
        turned = so3_exp(0.005 * rng.normal(size=(n, 3))) @ rotation
        moved = centre + 0.05 * rng.normal(size=(n, 3))
        return true, _bal(turned, moved, intrinsics + rng.normal(size=(n, 3)) * [8.0, 0.01, 0.002])

    def _place(self, at: FloatArray, ahead: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (n, 3) places ``ahead`` metres before the cameras number ``at``, and where these look."""
        zero = np.zeros_like(at)
        if self.kind == "loop":
            angle, radius = 2.0 * np.pi * at / self.n_cameras, self.n_cameras / (2.0 * np.pi)
            forward = np.stack([np.cos(angle), zero, np.sin(angle)], axis=1)
            return (radius + ahead)[:, None] * forward, forward
        per_row = -(-self.n_cameras // self.rows)
        row = np.minimum(np.floor(at / per_row), self.rows - 1)
        forward = np.tile([0.0, 0.0, -1.0], (len(at), 1))
        return np.stack([at - row * per_row, zero, -(_ROW_M * row + ahead)], axis=1), forward

    def _chunk(self, chunk: int, cameras: FloatArray) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
        """Return points of the start, and camera, point and pixels of each observation."""
        rng = np.random.default_rng((self.seed, chunk))
        n = min(_CHUNK, self.n_points - _CHUNK * chunk)
        per_row = -(-self.n_cameras // self.rows)
        middle = (_CHUNK * chunk + rng.uniform(0.0, n, n)) * (self.n_cameras / self.n_points)
        middle.sort()
        ahead = rng.uniform(8.0, 25.0, n)
        x, _ = self._place(middle, ahead)
        x[:, 1] = rng.uniform(-0.35, 0.35, n) * ahead
        length = np.minimum(1 + rng.geometric(1.0 / (self.track - 1.0), n), 30)
        point = np.repeat(np.arange(n), length)
        nth = np.arange(len(point)) - np.repeat(np.cumsum(length) - length, length)
        behind = nth % np.minimum(rng.integers(1, 4, n), self.rows)[point]
        row = np.minimum(np.floor(middle[point] / per_row), self.rows - 1).astype(np.intp)
        # Nobody is behind the first street.
        behind = np.minimum(behind, row)
        spread = np.where(behind > 0, nth // 2, nth - (length[point] - 1) // 2)
        camera = np.round(middle[point]).astype(np.intp) + spread - behind * per_row
        if self.kind == "loop":
            camera %= self.n_cameras
        else:
            first = (row - behind) * per_row
            camera = np.clip(camera, first, np.minimum(first + per_row, self.n_cameras) - 1)
        _, kept = np.unique(point * self.n_cameras + camera, return_index=True)
        camera, point = camera[kept], point[kept]
        uv = project(cameras, x, camera, point)
        uv += rng.normal(size=uv.shape)
        return x + 0.2 * rng.normal(size=x.shape), camera, point, uv


# Cameras, points and mean track of published problems.
PUBLISHED = {
    "ladybug-1723": Stream("street", 1723, 156_502, 4.34),
    "venice-1778": Stream("city", 1778, 993_923, 5.03),
    "final-13682": Stream("city", 13_682, 4_456_117, 6.51),
}


def named(name: str) -> Stream:
    """Return a problem by the name of a published one, or KIND:CAMERAS for one with 100 points a camera.

    Raises:
        ValueError: there is none of this name.
    """
    if name in PUBLISHED:
        return PUBLISHED[name]
    kind, _, count = name.partition(":")
    if kind not in ("street", "city", "loop") or not count.isdecimal() or int(count) < 16:
        raise ValueError(f"{name!r}: take one of {', '.join(PUBLISHED)}, or street:N, city:N, loop:N with N from 16 on")
    return Stream(kind, int(count), 100 * int(count), 7.5)


def _bal(rotation: FloatArray, centre: FloatArray, intrinsics: FloatArray) -> FloatArray:
    translation = -(rotation @ centre[:, :, None])[..., 0]
    return np.hstack([so3_log(rotation), translation, intrinsics])
