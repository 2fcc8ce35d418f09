# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measure disparities along rows, to hundredths of a pixel and without bias.

A first disparity comes from semi-global matching (Hirschmueller, 2008) in smaller images, or from what the map
knows. Then a patch of the first image is aligned along the row of the second, as it appears on a slanted surface:

    x' = x - (d + a p_x + b p_y),   y' = y

(``patches.py``). Slant matters: seen from a height h a road has b = B / h, a third of a pixel a row for a car with a
baseline of half a metre, and a patch that is compared without it is torn apart by some pixels from top to bottom. What
is found is tried the other way round, from the second image to the first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray
from ba_node.front_end import patches
from ba_node.front_end.opencv import cv2
from ba_node.front_end.patches import Floats
from ba_node.front_end.records import Grey

# Least correlation of a patch with what was found.
_LEAST_CORRELATION = 0.8
# Largest distance between a patch and what is found for it on the way back, px.
_BACK_PX = 0.5
# How far a disparity may be from its first value, px.
_REACH_PX = 3.0
# Standard deviation of the slant before it is measured: that of a wall seen along it.
_SLANT = 0.35
_NOISE = 2.0
# Least standard deviation of a disparity: what calibrations of real cameras leave here and there in the image, px.
_FLOOR_PX = 0.2
# Rows and columns on either side that a first slant is taken from, px of the smaller image.
_APART = 4
# Images are made smaller before first disparities are looked for: to a half, wide ones to a quarter.
_WIDE = 1000


@dataclass(frozen=True)
class Disparities:
    """What was measured; rows as asked for."""

    value: FloatArray  # (n,) px, NaN where nothing was found
    sigma: FloatArray  # (n,) px
    slant: FloatArray  # (n, 2) a, b

    @property
    def found(self) -> BoolArray:
        """Return where a disparity was found: (n,)."""
        return np.isfinite(self.value)


def dense(left: Grey, right: Grey, largest_px: int, negative: bool) -> Floats:
    """Return first disparities in a smaller image, px of the whole one; NaN for none."""
    if negative:
        return -dense(left[:, ::-1], right[:, ::-1], largest_px, False)[:, ::-1]
    size = smaller(left.shape[1])
    small = [
        cv2().resize(np.ascontiguousarray(i), None, fx=size, fy=size, interpolation=cv2().INTER_AREA)
        for i in (left, right)
    ]
    steps = 16 * max(1, -(-int(largest_px * size) // 16))
    matcher = cv2().StereoSGBM_create(
        0,
        steps,
        5,
        P1=100,
        P2=800,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=5,
        mode=cv2().STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(*small)
    result: Floats = np.where(found >= 0, found.astype(np.float32) / np.float32(16.0 * size), np.float32(np.nan))
    return result


def smaller(width: int) -> float:
    """Return the size, as a share, at which first disparities are looked for in images of a width, px."""
    return 0.25 if width >= _WIDE else 0.5


def look_up(disparity: Floats, uv: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Return first disparities (n,) and slants (n, 2) at uv (n, 2) from a dense image of a size."""
    height, width = disparity.shape
    x = np.clip(np.round((uv[:, 0] + 0.5) * size - 0.5).astype(int), _APART, width - 1 - _APART)
    y = np.clip(np.round((uv[:, 1] + 0.5) * size - 0.5).astype(int), _APART, height - 1 - _APART)
    span = 2.0 * _APART / size
    with np.errstate(invalid="ignore"):
        slant = (
            np.stack(
                [
                    disparity[y, x + _APART] - disparity[y, x - _APART],
                    disparity[y + _APART, x] - disparity[y - _APART, x],
                ],
                axis=1,
            )
            / span
        )
    slant = np.where(np.abs(slant) < 0.6, slant, 0.0).astype(np.float64)
    around = np.sort(np.stack([disparity[y + j, x + i] for i in (-1, 0, 1) for j in (-1, 0, 1)]), axis=0)
    # NaN come last: the median of the others, the lower one of two.
    middle = (np.maximum(np.isfinite(around).sum(axis=0), 1) - 1) // 2
    value = around[middle, np.arange(len(uv))].astype(np.float64)
    return value, slant


def measure(
    left: Floats,
    right: Floats,
    uv: FloatArray,
    first: tuple[FloatArray, FloatArray],
    side: int,
    rows_off: FloatArray,
) -> Disparities:
    """Measure disparities.

    Args:
        left: (h, w) float32, smoothed.
        right: likewise, the other image.
        uv: (n, 2) where in the left image, px.
        first: disparities (n,), NaN for those that are not to be measured, and slants (n, 2).
        side: of the patches, px.
        rows_off: (n,) how far below its own row a point is in the right image, px.
    """
    n = len(uv)
    result = Disparities(np.full(n, np.nan), np.full(n, np.nan), np.zeros((n, 2)))
    rows = np.flatnonzero(np.isfinite(first[0]))
    if not len(rows):
        return result
    start, slant = first[0][rows], first[1][rows]
    prior = np.array([0.0, 1.0, 1.0]) * (_NOISE / _SLANT) ** 2 / (2.0 * side)
    down = rows_off[rows]
    forth = _along(left, right, uv[rows], np.column_stack([-start, down]), slant, side, prior)
    at = np.column_stack([uv[rows, 0] - forth[0], uv[rows, 1] + down])
    good = (np.abs(forth[0] - start) < _REACH_PX) & (forth[3] > _LEAST_CORRELATION)
    width = left.shape[1]
    good &= (at[:, 0] > side // 3) & (at[:, 0] < width - side // 3)
    rows, at, down, forth = rows[good], at[good], down[good], tuple(one[good] for one in forth)
    back = _along(right, left, at, np.column_stack([forth[0], -down]), -forth[2], side, prior)
    off = forth[0] + back[0]
    good = (np.abs(off) < _BACK_PX) & (back[3] > _LEAST_CORRELATION)
    rows = rows[good]
    # Both ways err alike in size, and by interpolation in opposite ways: their mean is better than either.
    result.value[rows] = 0.5 * (forth[0] - back[0])[good]
    result.sigma[rows] = np.sqrt(forth[1] ** 2 + (0.5 * off) ** 2 + _FLOOR_PX**2)[good]
    result.slant[rows] = forth[2][good]
    return result


def _along(
    left: Floats, right: Floats, uv: FloatArray, shift: FloatArray, slant: FloatArray, side: int, prior: FloatArray
) -> tuple[FloatArray, ...]:
    """Return disparity, its sigma, slant and correlation of patches of one image in the rows of another."""
    affine = np.tile(np.eye(2), (len(uv), 1, 1))
    affine[:, 0] -= slant
    found = patches.align(patches.cut(left, uv, side, rows=True), right, uv + shift, affine, prior=prior)
    sigma = np.sqrt(np.maximum(found.covariance[:, 0, 0], 0.0))
    return uv[:, 0] - found.uv[:, 0], sigma, -found.slant, found.correlation
