# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Align many small patches with an image at once, to a few hundredths of a pixel.

A template T(p), p in a square around 0, was cut from one image; in another image the same plane appears at
``W(p) = x + A p / (1 + g p)``, a homography. Inverse-compositional Lucas-Kanade (Baker and Matthews, *Lucas-Kanade 20
Years On*, IJCV 2004) with gain and offset: with S(p) = I(W(p)),

    S = g (T + J e) + o,   J = dT/dp B,     e = H^-1 J' w S / g,    H = J' w J,     W <- W o (p - B e)

where w is the window and B what may move: the place alone, or along a row with a slant (``stereo.py``). J is made
orthogonal to 1 and T beforehand, so that g and o never enter.

Why it has no bias towards whole pixels: noise of T enters J only by central differences, to which noise of T itself is
uncorrelated; noise of I, which interpolation damps by how far between pixels it is, enters linearly. A symmetric
or forward scheme multiplies it by its own gradient, the mean of which is not zero between pixels (pixel locking).
Interpolation is linear, on images smoothed by :data:`SMOOTHING_PX`: what is left is below 0.015 px (a bicubic kernel as
OpenCV has it is off by 0.04 px, as it does not keep a ramp).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.arrays import FloatArray
from ba_node.front_end.opencv import cv2

Floats = NDArray[np.float32]
# Steps shorter than the first end an alignment, and none is longer than the second, px.
_STEP_PX, _FARTHEST_PX = 0.03, 3.0
_LEAST_STD = 0.5
_LEAST_HESSIAN = 1e-6
_STRIDE = 2
_MANY = 0.6


@cache
def grid(side: int) -> Floats:
    """Return which pixels of a patch are compared, around its centre: (P, 2) x, y; every second in row and column.

    Images are smoothed, so those between tell little more.
    """
    half = side // 2
    along = np.arange(-half, half + 1, _STRIDE, dtype=np.float32)
    x, y = np.meshgrid(along, along)
    return np.stack([x.ravel(), y.ravel()], axis=1)


@cache
def window(side: int) -> Floats:
    """Return the weight of each pixel of a patch, (side^2,), sum 1: Gaussian, with a third of the side as its sigma."""
    p = grid(side)
    weight = np.exp(-0.5 * (p * p).sum(axis=1) / (side / 3.0) ** 2)
    return np.asarray(weight / weight.sum(), dtype=np.float32)


def sample(image: Floats, x: Floats, y: Floats) -> Floats:
    """Return an image at places (n, m) each, px; beyond its border as at the border."""
    if not x.size:
        return np.empty(x.shape, np.float32)
    out: Floats = cv2().remap(image, x, y, cv2().INTER_LINEAR, borderMode=cv2().BORDER_REPLICATE)
    return out


def cut(image: Floats, uv: FloatArray, side: int, rows: bool = False) -> Floats:
    """Return patches around uv (n, 2), with a border of one pixel: (n, side + 2, side + 2).

    ``rows`` leaves out those rows that are not compared, for what moves along rows alone: (n, rows, side + 2).
    """
    x, y = _offsets(side, rows)
    if native.kernels is not None:
        values: Floats = native.kernels.cut_patches(image, uv, np.stack([x.ravel(), y.ravel()], axis=1))
    else:
        at = uv.astype(np.float32)
        values = sample(image, at[:, :1] + x.ravel(), at[:, 1:] + y.ravel())
    return values.reshape(-1, *x.shape)


def _offsets(side: int, rows: bool) -> tuple[Floats, Floats]:
    half = side // 2 + 1
    along = np.arange(-half, half + 1, dtype=np.float32)
    x, y = np.meshgrid(along, along[1:-1:_STRIDE] if rows else along)
    return x, y


@dataclass(frozen=True)
class Aligned:
    """Where patches were found."""

    uv: FloatArray  # (n, 2) px
    slant: FloatArray  # (n, 2) of rows: change of x' - x by p_x and by p_y; 0 of whole patches
    correlation: FloatArray  # (n,) of patch and image, -1 to 1
    covariance: FloatArray  # (n, k, k) of the movements, px^2, by what is left unexplained


def align(
    patches: Floats,
    image: Floats,
    uv: FloatArray,
    affine: FloatArray,
    bend: FloatArray | None = None,
    prior: FloatArray | None = None,
    iterations: int = 8,
) -> Aligned:
    """Find patches in an image, from a first place each.

    Args:
        patches: n of them as :func:`cut` gives them: whole ones have k = 2 movements, x and y, those of rows 3: x, x by
            p_x, x by p_y.
        image: (h, w) float32.
        uv: (n, 2) first places, px.
        affine: (n, 2, 2) A; its first row changes for patches of rows.
        bend: (n, 2) g, 1/px; None for 0.
        prior: (k,) added to the diagonal of the Hessian, grey values squared; None for 0.
        iterations: most steps.
    """
    side = patches.shape[2] - 2
    p, w = grid(side), window(side)
    if prior is None:
        prior = np.zeros(2 if patches.shape[1] == patches.shape[2] else 3)
    if native.kernels is not None:
        of, bends = (patches, prior, p, w), np.empty(0) if bend is None else bend
        limits = iterations, _STEP_PX, _FARTHEST_PX, _LEAST_STD**2, _LEAST_HESSIAN
        place, a, correlation, left, inverse = native.kernels.align_patches(image, of, uv, affine, bends, limits)
    else:
        templates = _Templates.of(patches, prior)
        place, a, correlation, left = _align(templates, image, (uv, affine, bend), iterations)
        inverse = templates.inverse
    # As many independent values as pixels under the window.
    independent = 1.0 / float((w * w).sum())
    covariance = inverse * (left / independent)[:, None, None]
    return Aligned(place, a[:, 0] - [1.0, 0.0], correlation, covariance)


@dataclass(frozen=True)
class _Templates:
    """Patches ready to be found."""

    side: int
    weighted: Floats  # (n, P) values, of weighted mean 0, times window
    std: Floats  # (n,) weighted standard deviation
    jacobian: Floats  # (n, k, P) change by each of k movements, orthogonal to 1 and T, times window
    inverse: FloatArray  # (n, k, k) of the Hessian

    @classmethod
    def of(cls, patches: Floats, prior: FloatArray) -> _Templates:
        side, k, w = patches.shape[2] - 2, _STRIDE, window(patches.shape[2] - 2)
        rows = patches if len(prior) == 3 else patches[:, 1:-1:k]
        values = rows[:, :, 1:-1:k].reshape(len(patches), len(w))
        dx = (0.5 * (rows[:, :, 2::k] - rows[:, :, :-2:k])).reshape(values.shape)
        values = values - (values @ w)[:, None]
        weighted = values * w
        variance = np.einsum("np,np->n", values, weighted)
        if len(prior) == 3:
            p = grid(side)
            jacobian = np.stack([dx, dx * p[:, 0], dx * p[:, 1]], axis=1)
        else:
            dy = (0.5 * (patches[:, 2::k, 1:-1:k] - patches[:, :-2:k, 1:-1:k])).reshape(values.shape)
            jacobian = np.stack([dx, dy], axis=1)
        jacobian -= (jacobian @ w)[..., None]
        along = np.einsum("nkp,np->nk", jacobian, weighted) / np.maximum(variance, _LEAST_STD**2)[:, None]
        jacobian -= along[..., None] * values[:, None]
        moved = jacobian * w
        hessian = np.matmul(moved, jacobian.transpose(0, 2, 1)).astype(np.float64)
        # A patch without texture has no Hessian to speak of; what it is given moves it by nothing.
        return cls(side, weighted, np.sqrt(variance), moved, inverses(hessian + np.diag(prior + _LEAST_HESSIAN)))


def _align(
    templates: _Templates, image: Floats, start: tuple[FloatArray, FloatArray, FloatArray | None], iterations: int
) -> tuple[FloatArray, ...]:
    """Return places (n, 2), A, correlations and variances that are left: what the kernels do, from uv, A and g."""
    uv, affine, bend = start
    n, k = templates.jacobian.shape[:2]
    p, w = grid(templates.side), window(templates.side)
    place, a = uv.astype(np.float64).copy(), affine.astype(np.float64).copy()
    correlation, left = np.zeros(n), np.full(n, np.inf)
    depth = None if bend is None else 1.0 / (1.0 + bend.astype(np.float32) @ p.T)
    rows = np.arange(n)
    std, back = templates.std, templates.inverse
    compared = np.concatenate([templates.weighted[:, None], templates.jacobian], axis=1)
    for _ in range(iterations if n else 0):
        s = _at(image, place[rows], a[rows], p, depth)
        s -= (s @ w)[:, None]
        spread = np.sqrt(np.maximum((s * s) @ w, 1e-6))
        alike = np.matmul(compared, s[:, :, None])[:, :, 0]
        agree = alike[:, 0] / spread / np.maximum(std, 1e-6)
        right = alike[:, 1:].astype(np.float64) * (std / spread)[:, None]
        e = np.matmul(back, right[:, :, None])[:, :, 0]
        correlation[rows] = agree
        left[rows] = 2.0 * std**2 * np.maximum(1.0 - agree, 0.0)
        _move(place, a, rows, e)
        length = np.linalg.norm(e[:, :2] if k == 2 else e[:, :1], axis=1)
        going = (length > _STEP_PX) & np.isfinite(length)
        if not going.any():
            break
        # Those that have arrived are left out once they are many: to copy the others takes time too.
        if going.mean() < _MANY:
            rows, compared, std, back = (one[going] for one in (rows, compared, std, back))
            depth = None if depth is None else depth[going]
    return place, a, correlation, left


def inverses(matrices: FloatArray) -> FloatArray:
    """Invert symmetric matrices (n, 2, 2) or (n, 3, 3) by hand, as LAPACK takes ten times as long."""
    if matrices.shape[1] == 2:
        a, b, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
        cofactors = np.stack([d, -b, -b, a])
        return np.asarray((cofactors / (a * d - b * b)).T.reshape(-1, 2, 2))
    (a, b, c), (_, d, e), (_, _, f) = matrices.transpose(1, 2, 0)
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    cofactors = np.stack([A, B, C, B, D, E, C, E, F])
    return np.asarray((cofactors / (a * A + b * B + c * C)).T.reshape(-1, 3, 3))


def _at(image: Floats, place: FloatArray, a: FloatArray, p: Floats, depth: Floats | None) -> Floats:
    x, y = (a[:, row].astype(np.float32) @ p.T * (1.0 if depth is None else depth) for row in (0, 1))
    at = place.astype(np.float32)
    return sample(image, x + at[:, :1], y + at[:, 1:])


def _move(place: FloatArray, a: FloatArray, rows: NDArray[np.intp], e: FloatArray) -> None:
    """Compose warps with p - B e."""
    if e.shape[1] == 2:
        e = e * np.minimum(1.0, _FARTHEST_PX / np.maximum(np.linalg.norm(e, axis=1), 1e-9))[:, None]
        place[rows] -= np.matmul(a[rows], e[:, :, None])[:, :, 0]
        return
    along = a[rows, 0, 0]
    e = e * np.minimum(1.0, _FARTHEST_PX / np.maximum(np.abs(e[:, 0]), 1e-9))[:, None]
    place[rows, 0] -= along * e[:, 0]
    a[rows, 0, 0] -= along * e[:, 1]
    a[rows, 0, 1] -= along * e[:, 2]
