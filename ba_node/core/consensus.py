# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the views of each point that agree on a place, however many do not.

Where two rays meet is a candidate, so is the end of a ray with a measured distance, and so is each ray's direction, for
a point far away. A candidate costs ``sum min(r^2, gate^2)`` over all rays of the point (MSAC: Torr & Zisserman,
*MLESAC*, CVIU 2000), r being the angle between ray and candidate in sigmas; behind the camera it costs the gate. The
cheapest wins, directions before places and earlier before later. All pairs of rays are tried up to 45, that is of 10
rays; of more rays 45 pairs that are spread over them, the same at every call. Two rays place a point less well than all
that agree with them, so these triangulate it, and then all rays are classified once more.
"""

from __future__ import annotations

import functools

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import triangulation
from ba_node.core.triangulation import Rays, Triangulation

_MAX_PAIRS = 45
_MAX_SINGLES = 8
# So many rays and candidates are compared at once.
_AT_ONCE = 200_000
# Squared sine below which two rays do not meet.
_LEAST_SINE2 = 1e-12


def triangulate(rays: Rays, n_points: int, gate: float, kernels: str = "auto") -> tuple[Triangulation, BoolArray]:
    """Return the points as those of their rays see them that agree, and which these are, (n,).

    Args: as of :func:`agreeing`.
    """
    if kernels != "numpy" and native.kernels is not None:
        *columns, agrees = native.kernels.consensus(rays, n_points, gate)
        return Triangulation(*columns), agrees
    agrees = agreeing(rays, n_points, gate, kernels)
    found = triangulation.triangulate(rays.part(agrees), n_points, kernels)
    near = triangulation.errors(rays, found.points) <= gate
    # A point that lost views by it keeps those it had.
    fewer = np.bincount(rays.point, near, n_points) < np.bincount(rays.point, agrees, n_points)
    near = np.where(fewer.take(rays.point), agrees, near)
    if np.array_equal(near, agrees):
        return found, agrees
    # Few points have other rays than before.
    changed = np.bincount(rays.point, near != agrees, n_points) > 0
    again = triangulation.triangulate(rays.part(near & changed.take(rays.point)), n_points, kernels)
    columns = zip(vars(again).values(), vars(found).values(), strict=True)
    return Triangulation(*(np.where(changed.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in columns)), near


def agreeing(rays: Rays, n_points: int, gate: float, kernels: str = "auto") -> BoolArray:
    """Return which rays agree with the place that most rays of their point agree on, (n,).

    ``gate`` is the largest angle between a ray and the place, sigmas. The C++ kernels do it where they are built,
    unless ``kernels`` is numpy.
    """
    if kernels != "numpy" and native.kernels is not None:
        found: BoolArray = native.kernels.agreeing(rays, n_points, gate)
        return found
    agrees = np.zeros(len(rays.point), bool)
    order = np.argsort(rays.point, kind="stable")
    begin = np.searchsorted(rays.point[order], np.arange(n_points + 1))
    views = np.diff(begin)
    for n in np.unique(views[views > 0]).tolist():
        first = begin[:-1][views == n]
        some = max(1, _AT_ONCE // (n * (_MAX_PAIRS + 2 * _MAX_SINGLES)))
        for k in range(0, len(first), some):
            rows = order[first[k : k + some, None] + np.arange(n)]
            agrees[rows] = _best(rays, rows, gate * gate) < gate * gate
    return agrees


def _best(rays: Rays, rows: IntArray, gate2: float) -> FloatArray:
    """Return the squared errors (g, n) of the rays of some points, of equally many each, against their best candidate.

    ``rows`` are (g, n); a candidate that is none is NaN.
    """
    # Coordinates are apart, (3, g, n): numpy takes several times as long for a last axis of three.
    centre, direction = (np.moveaxis(values[rows], 2, 0).copy() for values in (rays.centre, rays.direction))
    n = rows.shape[1]
    single = np.arange(min(n, _MAX_SINGLES)) * n // min(n, _MAX_SINGLES)
    ends = centre[:, :, single] + rays.distance_m[rows[:, single]] * direction[:, :, single]
    places = np.concatenate([ends, _meetings(centre, direction)], axis=2)
    far = np.broadcast_to(direction[:, :, single, None], (3, len(rows), len(single), n))
    away = np.concatenate([far, places[..., None] - centre[:, :, None]], axis=2)
    direction = direction[:, :, None]
    ahead = _dot(away, direction) > 0.0
    across2 = _across2(direction, away)
    with np.errstate(divide="ignore", invalid="ignore"):
        across2 /= _dot(away, away)
        across2 *= rays.px_per_rad[rows][:, None] ** 2
        np.minimum(across2, gate2, out=across2)
    across2[~ahead] = gate2
    best = np.argmin(across2.sum(axis=2), axis=1)
    return np.asarray(across2[np.arange(len(rows)), best])


def _across2(direction: FloatArray, away: FloatArray) -> FloatArray:
    """Return the squared length of the vector product, coordinates in the first axis."""
    (dx, dy, dz), (ax, ay, az) = direction, away
    total: FloatArray = dy * az
    term = dz * ay
    total -= term
    total *= total
    for a, b, c, d in ((dz, ax, dx, az), (dx, ay, dy, ax)):
        side = a * b
        side -= np.multiply(c, d, out=term)
        side *= side
        total += side
    return total


def _meetings(centre: FloatArray, direction: FloatArray) -> FloatArray:
    """Return where pairs of rays are nearest to each other, by their angles, (3, g, m); NaN unless in front of both."""
    i, j = _pairs(centre.shape[2])
    a, b, between = direction[:, :, i], direction[:, :, j], centre[:, :, j] - centre[:, :, i]
    cosine, along_a, along_b = _dot(a, b), _dot(between, a), _dot(between, b)
    sine2 = 1.0 - cosine * cosine
    apart = sine2 > _LEAST_SINE2
    safe = np.where(apart, sine2, 1.0)
    s, t = (along_a - cosine * along_b) / safe, (cosine * along_a - along_b) / safe
    good = apart & (s > 0.0) & (t > 0.0)
    share = s * s / np.where(good, s * s + t * t, 1.0)
    places = (1.0 - share) * (centre[:, :, i] + s * a) + share * (centre[:, :, j] + t * b)
    return np.where(good, places, np.nan)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products of vectors whose coordinates stand in the first axis."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@functools.lru_cache(maxsize=256)
def _pairs(n: int) -> tuple[IntArray, IntArray]:
    if n * (n - 1) // 2 <= _MAX_PAIRS:
        i, j = np.triu_indices(n, k=1)
        return i, j
    k = np.arange(_MAX_PAIRS)
    i = k * n // _MAX_PAIRS
    # Multiples of the golden ratio are spread evenly, however many there are.
    return i, (i + 1 + (k * 2654435761 % 2**32) * (n - 1) // 2**32) % n
