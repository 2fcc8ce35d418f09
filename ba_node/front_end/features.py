# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Detect corners, spread over the image, and track them to the next image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.front_end.opencv import cv2
from ba_node.front_end.records import Grey

# Side of the square from which the smaller eigenvalue of the gradients' covariance is taken, px.
_BLOCK = 5
# How far from a pixel its eigenvalue reaches, px; rows of cells that are looked at at once.
_REACH, _ROWS = _BLOCK // 2 + 1, 4
# Least such eigenvalue, in units of OpenCV's (grey values in 0 to 1): a weak corner on a road, above noise.
_WEAKEST = 4e-6
# Windows of Lucas-Kanade, and levels of its pyramid where a first place is known, and where none is.
_WINDOW, _LEVELS, _LEVELS_BLIND = 17, 2, 4
# There and back again a feature must end where it began.
_BACK_PX = 0.7


def corners(image: Grey, allowed: BoolArray, taken: FloatArray, count: int, border: int) -> FloatArray:
    """Return new corners, the best of each cell, be it weak (Shi and Tomasi, *Good Features to Track*, 1994).

    Args:
        image: (h, w).
        allowed: (h, w), False where none is wanted.
        taken: (n, 2) features that there are already, px; cells that hold one have room for no other.
        count: most features in all, with those taken.
        border: distance kept to the border of the image, px.

    Returns:
        (m, 2) float64, px, whole numbers.
    """
    room = count - len(taken)
    height, width = image.shape
    if room <= 0 or min(height, width) <= 2 * border + _BLOCK:
        return np.empty((0, 2))
    # Cells so that twice as many as wanted would fit where they may be: not each has a corner.
    cell = max(8, int(np.sqrt(np.count_nonzero(allowed) / (1.6 * count))))
    rows, columns = (height - 2 * border) // cell, (width - 2 * border) // cell
    bands = [
        _best(image, allowed, border, (top, min(top + _ROWS, rows)), (cell, columns)) for top in range(0, rows, _ROWS)
    ]
    best, value = (np.concatenate(one) for one in zip(*bands, strict=True))
    at = ((taken - border) // cell).astype(np.intp)
    at = at[((at >= 0) & (at < [columns, rows])).all(axis=1)]
    value[at[:, 1], at[:, 0]] = 0.0
    row, column = np.nonzero(value > _WEAKEST)
    order = np.argsort(-value[row, column], kind="stable")[:room]
    row, column = row[order], column[order]
    inside = best[row, column]
    found = np.column_stack([border + column * cell + inside % cell, border + row * cell + inside // cell])
    return _apart(found.astype(np.float64), taken, 0.5 * cell)


def _best(
    image: Grey, allowed: BoolArray, border: int, rows: tuple[int, int], size: tuple[int, int]
) -> tuple[IntArray, NDArray[np.float32]]:
    """Return the best pixel of each cell in some rows of them, and its strength.

    The whole image at once takes four times as long: what OpenCV has between is 15 MB then, and fetched anew each time.
    """
    cell, columns = size
    top, bottom = (border + row * cell for row in rows)
    above, below = min(_REACH, top), min(_REACH, len(image) - bottom)
    strength = cv2().cornerMinEigenVal(image[top - above : bottom + below], _BLOCK, ksize=3)
    across = slice(border, border + columns * cell)
    across = slice(border, border + columns * cell)
    inner = strength[above : above + bottom - top, across]
    inner[~allowed[top:bottom, across]] = 0.0
    # The best column of each cell first: rows of pixels lie side by side, and squares of them would have to be copied.
    inner = inner.reshape(-1, cell, columns * cell)
    x = inner.max(axis=1).reshape(-1, columns, cell).argmax(axis=2)
    column = inner[np.arange(len(inner))[:, None], :, x + cell * np.arange(columns)]
    y = column.argmax(axis=2)
    return cell * y + x, np.take_along_axis(column, y[..., None], axis=2)[..., 0]


def _apart(found: FloatArray, taken: FloatArray, distance: float) -> FloatArray:
    """Leave out corners that are too near to one that was there, or to a stronger one (those come first)."""
    if not len(found):
        return found
    if len(taken):
        found = found[cKDTree(taken).query(found)[0] > distance]
    if not len(found):
        return found
    pairs = cKDTree(found).query_pairs(np.nextafter(distance, 0.0), output_type="ndarray")
    return np.asarray(np.delete(found, pairs[:, 1], axis=0))


def follow(before: Grey, now: Grey, uv: FloatArray, expected: FloatArray | None) -> tuple[FloatArray, BoolArray]:
    """Follow features from one image to the next by pyramidal Lucas-Kanade, there and back (Bouguet, 2000).

    ``expected`` are first places; without them the search reaches farther. Returns uv (n, 2), px, and which were found.
    """
    if not len(uv):
        return uv.copy(), np.zeros(0, bool)
    one = uv.astype(np.float32).reshape(-1, 1, 2)
    flags, levels = 0, _LEVELS_BLIND
    first = None
    if expected is not None:
        first = np.where(np.isfinite(expected), expected, uv).astype(np.float32).reshape(-1, 1, 2)
        flags, levels = cv2().OPTFLOW_USE_INITIAL_FLOW, _LEVELS
    criteria = (3, 10, 0.03)
    size = (_WINDOW, _WINDOW)
    there, ok, _ = cv2().calcOpticalFlowPyrLK(
        before, now, one, first, winSize=size, maxLevel=levels, criteria=criteria, flags=flags
    )
    shift = there - one
    back, ok_back, _ = cv2().calcOpticalFlowPyrLK(
        now,
        before,
        there,
        (there - shift).copy(),
        winSize=size,
        maxLevel=0,
        criteria=criteria,
        flags=cv2().OPTFLOW_USE_INITIAL_FLOW,
    )
    found = there.reshape(-1, 2).astype(np.float64)
    error = np.linalg.norm((back - one).reshape(-1, 2), axis=1)
    height, width = now.shape
    inside = (found >= 0.0).all(axis=1) & (found <= [width - 1.0, height - 1.0]).all(axis=1)
    return found, (ok.ravel() == 1) & (ok_back.ravel() == 1) & (error < _BACK_PX) & inside
