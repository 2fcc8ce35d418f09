# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Triangulate points from the rays of all their views, for all points at once.

With camera centres ``c_i``, unit rays ``d_i`` and distances ``s_i = |x - c_i|``, the point minimises::

    sum_i (f_i / (sigma_i s_i))^2 |(I - d_i d_i') (x - c_i)|^2  +  sum_i |d_i' (x - c_i) - m_i|^2 / sigma_mi^2

The first sum is the angular error in pixels (to first order the reprojection error), the second ties the point to
measured distances ``m_i`` along the rays. For given ``s_i`` it is a 3x3 linear system a point; ``s_i`` starts at 1
(plain midpoint) and is updated in rounds (iterative least squares: Hartley & Sturm, *Triangulation*, CVIU 1997). The
later rounds weigh each view by Huber's rule, so that a mismatch among several views does not drag the point away. Paid:
one batch of 3x3 solves a round.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import cameras
from ba_node.core.problem import Problem

_PLAIN_ROUNDS = 3
_ROBUST_ROUNDS = 5
# Where the robust weight leaves 1, in sigmas.
_HUBER = 1.5
# Of the angle between a ray and its camera's axis, where a depth tells a distance.
_LEAST_COSINE = 0.01
# Of a symmetric matrix's six entries.
_DIAGONAL = np.array([0, 3, 5])
# Observations that are worked on at once: a large map's would take a multiple of the memory of their rays.
_AT_ONCE = 2**17


@dataclass(frozen=True)
class Rays:
    """Views of points as rays in the world; rows whose pixel no ray projects to are left out."""

    point: IntArray  # (n,) index of the point
    centre: FloatArray  # (n, 3) camera centre, m
    direction: FloatArray  # (n, 3) unit vector
    px_per_rad: FloatArray  # (n,) focal length over sigma
    distance_m: FloatArray  # (n,) measured distance along the ray, NaN where there is none
    distance_sigma_m: FloatArray  # (n,) its standard deviation

    def part(self, which: BoolArray) -> Rays:
        """Return some of them."""
        if which.all():
            return self
        rows = np.flatnonzero(which)
        return Rays(*(getattr(self, item.name).take(rows, axis=0) for item in dataclasses.fields(self)))


@dataclass(frozen=True)
class Triangulation:
    """Points and how well their rays determine them."""

    points: FloatArray  # (n_pt, 3), m; NaN where there is neither a pair of rays nor a ray with a distance
    parallax_rad: FloatArray  # (n_pt,) largest angle between two rays (exact for two, at least half of it for more)
    measured: BoolArray  # (n_pt,) True where a distance was measured


def rays_of(problem: Problem, kernels: str = "auto") -> Rays:
    """Return the rays of all observations of a problem at its start poses.

    The C++ kernels turn them where they are built, unless ``kernels`` is numpy.
    """
    obs, cams = problem.observations, problem.cameras
    if kernels != "numpy" and native.kernels is not None:
        found = native.kernels.rays(problem, np.empty(0)) or native.kernels.rays(problem, rays_in_cameras(problem))
        turned, all_good = found
        rays = Rays(obs.point, *turned)
        return rays if all_good else rays.part(np.isfinite(rays.direction[:, 2]))
    # Camera centre: x with R x + t = -Rc' tc.
    turn = np.swapaxes(cams.rotation, -1, -2)
    body_centre = -(turn @ cams.translation[:, :, None])[..., 0]
    world_from_body = np.swapaxes(problem.start.rotation, -1, -2)
    of_image = body_centre - problem.start.translation[:, None, :]
    centres = (world_from_body[:, None] @ of_image[..., None]).reshape(-1, 3)
    n = len(obs)
    if n <= _AT_ONCE:
        columns = _columns(problem, centres, slice(n))
    else:
        columns = tuple(np.empty((n, 3)) if i < 2 else np.empty(n) for i in range(5))
        for begin in range(0, n, _AT_ONCE):
            rows = slice(begin, begin + _AT_ONCE)
            for whole, part in zip(columns, _columns(problem, centres, rows), strict=True):
                whole[rows] = part
    rays = Rays(obs.point, *columns)
    good = np.isfinite(rays.direction[:, 2])
    return rays if good.all() else rays.part(good)


def rays_in_cameras(problem: Problem, rows: IntArray | slice = slice(None)) -> FloatArray:
    """Return the rays of some observations, all by default, as unit vectors in their cameras, (n, 3).

    The C++ kernels have those of cameras without distortion themselves.
    """
    obs, cams = problem.observations, problem.cameras
    camera = obs.camera[rows]
    return cameras.rays(obs.uv[rows], cams.model.take(camera), cams.params.take(camera, axis=0))


def _columns(problem: Problem, centres: FloatArray, rows: slice) -> tuple[FloatArray, ...]:
    """Return what rays hold of some observations; a direction is NaN where no ray projects to the pixel.

    ``centres`` are those of the cameras, (n_kf n_cam, 3), by keyframe.
    """
    obs, cams = problem.observations, problem.cameras
    camera, keyframe = obs.camera[rows], obs.keyframe[rows]
    centre = centres.take(keyframe * len(cams.model) + camera, axis=0)
    params = cams.params.take(camera, axis=0)
    ray = cameras.rays(obs.uv[rows], cams.model.take(camera), params)
    in_body = np.swapaxes(cams.rotation[camera], -1, -2) @ ray[:, :, None]
    direction = (np.swapaxes(problem.start.rotation[keyframe], -1, -2) @ in_body)[..., 0]
    px_per_rad = np.sqrt(params[:, cameras.FX] * params[:, cameras.FY]) / obs.sigma_px[rows]
    if not len(obs.depth_m):
        unknown = np.full(len(camera), np.nan)
        return centre, direction, px_per_rad, unknown, unknown
    # A depth is along the axis: of a ray that is across it, or points back, it tells no distance.
    length = 1.0 / np.where(ray[:, 2] > _LEAST_COSINE, ray[:, 2], np.nan)
    return centre, direction, px_per_rad, obs.depth_m[rows] * length, obs.depth_sigma_m[rows] * length


def triangulate(rays: Rays, n_points: int, kernels: str = "auto") -> Triangulation:
    """Return the point of each group of rays. No ray is rejected here: look at the parallax before using a point.

    The C++ kernels do it where they are built, unless ``kernels`` is numpy.
    """
    if kernels != "numpy" and native.kernels is not None:
        return Triangulation(*native.kernels.triangulate(rays, n_points))
    measured_row = np.isfinite(rays.distance_m)
    measured = np.bincount(rays.point[measured_row], minlength=n_points) > 0
    count = np.bincount(rays.point, minlength=n_points)
    # Relative to the mean centre of each point's cameras: keeps digits far from the origin.
    origin = _sum_by_point(rays.centre, rays.point, n_points) / np.maximum(count, 1)[:, None]
    centre = np.ascontiguousarray((rays.centre - origin[rays.point]).T)
    distance = _first_distance(rays, measured_row, n_points)
    trust = np.ones(len(distance))
    points = np.zeros((n_points, 3))
    sums = _Sums(rays, n_points)
    for i in range(_PLAIN_ROUNDS + _ROBUST_ROUNDS):
        points = sums.weighted_midpoint(centre, distance, trust)
        away = points.T.take(rays.point, axis=1)
        away -= centre
        distance = _length(away)
        if i >= _PLAIN_ROUNDS - 1:
            across = _length(_cross(sums.direction, away)) / np.maximum(distance, 1e-9)
            trust = _HUBER / np.maximum(rays.px_per_rad * across, _HUBER)
    points = points + origin
    points[(count < 2) & ~measured] = np.nan
    return Triangulation(points, parallax(rays, n_points), measured)


def errors(rays: Rays, points: FloatArray) -> FloatArray:
    """Return the angle between each ray and its point, (n,) sigmas; inf where the point is behind it or NaN."""
    out = np.empty(len(rays.point))
    for begin in range(0, len(out), _AT_ONCE):
        rows = slice(begin, begin + _AT_ONCE)
        direction, away = rays.direction[rows].T, points.T.take(rays.point[rows], axis=1) - rays.centre[rows].T
        across = _length(_cross(direction, away)) / np.maximum(_length(away), 1e-300)
        out[rows] = np.where(_dot(direction, away) > 0.0, rays.px_per_rad[rows] * across, np.inf)
    return out


def parallax(rays: Rays, n_points: int) -> FloatArray:
    """Return the largest angle between two rays of each point, (n_points,) rad; 0 for fewer than two rays.

    Takes the ray farthest from the mean, then the ray farthest from that one: exact for two rays.
    """
    angle = np.zeros(n_points)
    if not len(rays.point):
        return angle
    mean = _sum_by_point(rays.direction, rays.point, n_points)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    chord = np.linalg.norm(rays.direction - mean[rays.point], axis=1)
    # Last write wins: of each point's rays in ascending order of distance, that is the farthest.
    order = np.argsort(chord, kind="stable")
    farthest = np.zeros(n_points, np.intp)
    farthest[rays.point[order]] = order
    chord = np.linalg.norm(rays.direction - rays.direction[farthest[rays.point]], axis=1)
    np.maximum.at(angle, rays.point, 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
    return angle


def _first_distance(rays: Rays, measured_row: BoolArray, n_points: int) -> FloatArray:
    """Return a distance for every ray: the mean of the point's measured ones, or 1."""
    total = np.bincount(rays.point[measured_row], rays.distance_m[measured_row], n_points)
    count = np.bincount(rays.point[measured_row], minlength=n_points)
    mean = np.where(count > 0, total / np.maximum(count, 1), 1.0)
    return mean[rays.point]


class _Sums:
    """The 3x3 systems of the module's equation, with what stays the same from round to round."""

    def __init__(self, rays: Rays, n_points: int) -> None:
        self._rays, self._n = rays, n_points
        self._along = np.nan_to_num(1.0 / rays.distance_sigma_m**2, nan=0.0)
        self._measured = self._along * np.nan_to_num(rays.distance_m, nan=0.0)
        self.direction = np.ascontiguousarray(rays.direction.T)
        # All sums in one go, one after the other.
        self._bins = (rays.point + n_points * np.arange(9)[:, None]).ravel()

    def weighted_midpoint(self, centre: FloatArray, distance: FloatArray, trust: FloatArray) -> FloatArray:
        """Solve for given distances and weights in (0, 1]; centres are (3, n). Return (n_points, 3)."""
        across = trust * (self._rays.px_per_rad / np.maximum(distance, 1e-9)) ** 2
        x, y, z = self.direction
        # W = across (I - d d') + along d d';  sum W x = sum W c + along m d
        less = self._along - across
        values = np.empty((9, len(across)))
        np.multiply(less * x, self.direction, out=values[:3])
        np.multiply(less * y, self.direction[1:], out=values[3:5])
        np.multiply(less * z, z, out=values[5])
        values[:6:3] += across
        values[5] += across
        reach = less * _dot(self.direction, centre) + self._measured
        np.multiply(reach, self.direction, out=values[6:])
        values[6:] += across * centre
        # Without rays numpy counts in integers.
        sums = np.bincount(self._bins, values.ravel(), 9 * self._n).astype(float, copy=False).reshape(9, -1)
        return _solved(sums[:6], sums[6:])


def _solved(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve symmetric 3x3 systems by L D L': (6, n) xx, xy, xz, yy, yz, zz, written over, and (3, n) -> (n, 3)."""
    xx, xy, xz, yy, yz, zz = matrix
    trace = xx + yy + zz
    # A whiff of damping: parallel rays give a far point instead of a singular matrix.
    matrix[_DIAGONAL] += 1e-14 * trace + (trace <= 0.0)
    by_x, bz_x = xy / xx, xz / xx
    yy -= by_x * xy
    yz -= by_x * xz
    bz_y = yz / yy
    zz -= bz_x * xz + bz_y * yz
    a, b, c = rhs
    b = b - by_x * a
    out = np.empty((3, len(a)))
    np.divide(c - bz_x * a - bz_y * b, zz, out=out[2])
    np.subtract(b / yy, bz_y * out[2], out=out[1])
    np.subtract(a / xx, by_x * out[1] + bz_x * out[2], out=out[0])
    return out.T


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products of vectors (3, n) and (3, n), (n,)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _length(vectors: FloatArray) -> FloatArray:
    """Return the lengths of vectors (3, n), (n,): np.linalg.norm without its overhead."""
    return np.asarray(np.sqrt(_dot(vectors, vectors)))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the vector products of (3, n) and (3, n), (3, n): np.cross without its overhead."""
    (ax, ay, az), (bx, by, bz) = a, b
    out = np.empty((3, len(ax)))
    out[0], out[1], out[2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return out


def _sum_by_point(values: FloatArray, point: IntArray, n_points: int) -> FloatArray:
    return np.stack([np.bincount(point, values[:, k], n_points) for k in range(values.shape[1])], axis=1)
