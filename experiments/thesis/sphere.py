# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make the synthetic problem of section 5.1 of the thesis: points on a sphere, seen from cameras near it.

Points are uniform on a sphere around the origin. A camera lies outside and not far away, its optical axis within
``tilt_deg`` of the ray to the origin; it sees the spherical cap that faces it, as far as that falls into the image.
Images with too few observations or too small an area are dropped; points seen in fewer than two images are removed.
Images are sorted so that neighbours look from similar places, points by the first image that sees them: E is then
dominated by its block diagonal. All in BAL's convention (2.17-2.21): the camera looks down -z, v upwards,
``u = f (1 + k1 |p|^2 + k2 |p|^4) p``, ``p = -(X, Y) / Z``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.config import ConfigError
from ba_node.core.geometry import so3_exp, so3_log
from experiments.thesis.sphere_options import SphereOptions

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

HALF_IMAGE_PX = np.array([400.0, 300.0])
_OUTLIER_PX = (10.0, 60.0)
_K1, _K2 = (1e-2, 1e-3), (1e-4, 1e-5)
# A choice of options that needs more cameras drawn than this for each image asks for the impossible.
_TRIES = 200


@dataclass(frozen=True)
class SphereData:
    """A problem and the truth about it."""

    cameras: FloatArray  # (n, 9) true rotation vector, translation, f (px), k1, k2
    points: FloatArray  # (m, 3) true
    start_cameras: FloatArray  # (n, 9) where a solver begins
    start_points: FloatArray  # (m, 3) where a solver begins
    camera_index: IntArray  # (l,) image of each observation
    point_index: IntArray  # (l,) point of each observation, ascending
    uv: FloatArray  # (l, 2) measured, px from the centre of the image, u to the right, v upwards
    outlier: BoolArray  # (l,) True where an observation was displaced


def project(cameras: FloatArray, points: FloatArray, camera: IntArray, point: IntArray) -> FloatArray:
    """Return where points fall in images, (l, 2) px; cameras (n, 9), points (m, 3), and the index of each (l,)."""
    x = (so3_exp(cameras[:, :3])[camera] @ points[point][:, :, None])[..., 0] + cameras[camera, 3:6]
    p = -x[:, :2] / x[:, 2:]
    s = np.sum(p * p, axis=1)
    f, k1, k2 = cameras[camera, 6:].T
    uv: FloatArray = (f * (1.0 + s * (k1 + s * k2)))[:, None] * p
    return uv


def centres(cameras: FloatArray) -> FloatArray:
    """Return where cameras (n, 9) are, (n, 3): ``-R' t``."""
    turned = np.swapaxes(so3_exp(cameras[:, :3]), 1, 2) @ cameras[:, 3:6, None]
    return np.asarray(-turned[..., 0])


def generate_sphere(options: SphereOptions) -> SphereData:
    """Make a problem. The same options give the same numbers.

    Raises:
        ConfigError: the options leave too little to see.
    """
    # One stream a purpose: a change of the noise must not move the points.
    scene_rng, thin_rng, noise_rng, start_rng = np.random.default_rng(options.seed).spawn(4)
    cameras, points, seen = _Scene(options, scene_rng, thin_rng).build()
    order = _neighbours(centres(cameras))
    cameras, seen = cameras[order], seen[order]
    first = np.argsort(np.argmax(seen, axis=0), kind="stable")
    points, seen = points[first], seen[:, first]
    point, camera = np.nonzero(seen.T)
    uv, outlier = _measure(options, project(cameras, points, camera, point), noise_rng)
    start_cameras, start_points = _start(options, cameras, points, start_rng)
    return SphereData(cameras, points, start_cameras, start_points, camera, point, uv, outlier)


class _Scene:
    """Cameras and points that see enough of each other."""

    def __init__(self, options: SphereOptions, rng: np.random.Generator, thin_rng: np.random.Generator) -> None:
        self._options, self._rng, self._thin_rng = options, rng, thin_rng
        self._tries = 0
        self._points = self._more_points()
        self._cameras: list[FloatArray] = []
        self._seen: list[BoolArray] = []

    def build(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return cameras (n, 9), points (m, 3) and who sees whom (n, m)."""
        while True:
            while len(self._cameras) < self._options.images:
                self._add_camera()
            seen = np.array(self._seen)
            twice = np.flatnonzero(seen.sum(axis=0) >= 2)
            if len(twice) < self._options.points:
                self._grow()
                continue
            chosen = twice[: self._options.points]
            thinned = self._thin(seen[:, chosen])
            good = [self._good(k, np.flatnonzero(row)) for k, row in enumerate(self._rows(thinned, chosen))]
            if all(good):
                return np.array(self._cameras), self._points[chosen], thinned
            self._cameras = [camera for camera, kept in zip(self._cameras, good, strict=True) if kept]
            self._seen = [row for row, kept in zip(self._seen, good, strict=True) if kept]

    def _more_points(self) -> FloatArray:
        direction = self._rng.normal(size=(4 * self._options.points, 3))
        on_sphere: FloatArray = self._options.radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return on_sphere

    def _grow(self) -> None:
        self._count_try(self._options.images)
        more = self._more_points()
        self._points = np.concatenate([self._points, more])
        self._seen = [
            np.concatenate([row, _visible(camera, more)]) for row, camera in zip(self._seen, self._cameras, strict=True)
        ]

    def _add_camera(self) -> None:
        self._count_try(1)
        camera = _draw_camera(self._options, self._rng)
        seen = _visible(camera, self._points)
        self._cameras.append(camera)
        self._seen.append(seen)
        if not self._good(len(self._cameras) - 1, np.flatnonzero(seen)):
            self._cameras.pop()
            self._seen.pop()

    def _count_try(self, count: int) -> None:
        self._tries += count
        if self._tries > _TRIES * self._options.images:
            o = self._options
            raise ConfigError(
                f"{self._tries} cameras were drawn and no {o.images} images see {o.min_image_points} of {o.points}"
                f" points over {o.min_image_area:g} of their area, each point twice: lower min_image_points,"
                " min_image_area or cone_deg, or raise far or points"
            )

    def _good(self, k: int, rows: IntArray) -> bool:
        """Return True if an image has enough observations over a large enough area."""
        if len(rows) < self._options.min_image_points:
            return False
        uv = project(self._cameras[k][None], self._points[rows], np.zeros(len(rows), np.intp), np.arange(len(rows)))
        return bool(np.prod(np.ptp(uv, axis=0) / (2.0 * HALF_IMAGE_PX)) >= self._options.min_image_area)

    def _rows(self, thinned: BoolArray, chosen: IntArray) -> BoolArray:
        """Return who sees whom of all points drawn, where only the chosen ones are seen."""
        rows = np.zeros((len(thinned), len(self._points)), dtype=bool)
        rows[:, chosen] = thinned
        return rows

    def _thin(self, seen: BoolArray) -> BoolArray:
        """Keep a random choice of the observations, two of each point among them."""
        wanted, available = self._options.observations, int(seen.sum())
        if wanted == 0:
            return seen
        if wanted > available:
            raise ConfigError(
                f"observations = {wanted}, but {available} are visible: lower it or cone_deg, or 0 for all of them"
            )
        rank = np.where(seen, self._thin_rng.random(seen.shape), np.inf)
        # The two of each point with the lowest rank come before all others.
        np.put_along_axis(rank, np.argpartition(rank, 1, axis=0)[:2], -1.0, axis=0)
        kept = np.argpartition(rank.ravel(), wanted - 1)[:wanted]
        out = np.zeros(seen.size, dtype=bool)
        out[kept] = True
        return out.reshape(seen.shape)


def _draw_camera(options: SphereOptions, rng: np.random.Generator) -> FloatArray:
    """Return a camera (9,) near the sphere that looks at it."""
    along = rng.uniform(np.cos(np.radians(options.cone_deg)), 1.0)
    around = rng.uniform(0.0, 2.0 * np.pi)
    across = np.sqrt(1.0 - along * along)
    outwards = np.array([across * np.cos(around), across * np.sin(around), along])
    centre = outwards * options.radius * rng.uniform(options.near, options.far)
    side = np.cross(outwards, rng.normal(size=3))
    tilt = np.radians(rng.uniform(0.0, options.tilt_deg))
    # The camera looks down -z: z points away from the sphere.
    back = np.cos(tilt) * outwards + np.sin(tilt) * side / np.linalg.norm(side)
    right = np.cross(rng.normal(size=3), back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(back, right), back])
    spread = options.camera_spread
    focal = options.focal_px * (1.0 + 0.02 * spread * rng.normal())
    intrinsics = [focal, _K1[0] + _K1[1] * spread * rng.normal(), _K2[0] + _K2[1] * spread * rng.normal()]
    return np.concatenate([so3_log(rotation[None])[0], -rotation @ centre, intrinsics])


def _visible(camera: FloatArray, points: FloatArray) -> BoolArray:
    """Return which points (m, 3) lie on the cap that faces a camera (9,), before it, and in its image."""
    rotation = so3_exp(camera[None, :3])[0]
    facing = np.sum((centres(camera[None])[0] - points) * points, axis=1) > 0.0
    ahead = points @ rotation[2] + camera[5] < 0.0
    index = np.flatnonzero(facing & ahead)
    uv = project(camera[None], points[index], np.zeros(len(index), np.intp), np.arange(len(index)))
    seen = np.zeros(len(points), dtype=bool)
    seen[index] = (np.abs(uv) <= HALF_IMAGE_PX).all(axis=1)
    return seen


def _neighbours(places: FloatArray) -> IntArray:
    """Return an order (n,) in which each place follows the nearest one before it that is left; begins at the rim."""
    left = np.ones(len(places), dtype=bool)
    order = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    left[order[0]] = False
    while left.any():
        distance = np.linalg.norm(places - places[order[-1]], axis=1)
        order.append(int(np.argmin(np.where(left, distance, np.inf))))
        left[order[-1]] = False
    return np.array(order, dtype=np.intp)


def _measure(options: SphereOptions, uv: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    """Return measured coordinates (l, 2) and which of them are outliers (l,)."""
    noisy = uv + options.noise_px * rng.normal(size=uv.shape)
    outlier = np.zeros(len(uv), dtype=bool)
    outlier[rng.permutation(len(uv))[: round(options.outlier_share * len(uv))]] = True
    angle, length = rng.uniform(0.0, 2.0 * np.pi, len(uv)), rng.uniform(*_OUTLIER_PX, len(uv))
    jump = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # A matcher finds its mismatch inside the image too.
    jump = np.where(np.abs(noisy + jump) > HALF_IMAGE_PX, -jump, jump)
    return np.where(outlier[:, None], noisy + jump, noisy), outlier


def _start(
    options: SphereOptions, cameras: FloatArray, points: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return cameras (n, 9) and points (m, 3) with Gaussian errors, and k1 = k2 = 0."""
    n = len(cameras)
    start = cameras.copy()
    start[:, :3] += np.radians(options.start_rotation_deg) * rng.normal(size=(n, 3))
    start[:, 3:6] += options.start_translation * options.radius * rng.normal(size=(n, 3))
    start[:, 6] *= 1.0 + options.start_focal * rng.normal(size=n)
    start[:, 7:] = 0.0
    return start, points + options.start_point * options.radius * rng.normal(size=points.shape)
