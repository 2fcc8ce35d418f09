# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the rim of a camera's images that shows nothing: black from the border inwards, and so in every image.

Rectified images have one where the raw image had no pixel, a fisheye lens outside its circle. Its edge looks like
corners of things that never move, and pulls at every patch that lies across it.
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import BoolArray
from ba_node.front_end.opencv import cv2
from ba_node.front_end.records import Grey

# What is no brighter than this in all images is black: noise of the sensor, and what JPEG leaves beside an edge.
_BLACK = 12
# A rim has more of the image than this; less are shadows.
_LEAST_SHARE = 0.002
# It is looked for again once so much less is black than before.
_LESS = 0.97


class Rim:
    """The black rim of one camera, by all images so far; it can only become smaller."""

    def __init__(self, side: int) -> None:
        """Take the side of the patches that must not lie across its edge, px."""
        self._side = side
        self._brightest: Grey | None = None
        self._black = -1  # pixels that were black in all images, -1 for no image
        self._clear: BoolArray | None = None

    def clear_of(self, image: Grey) -> BoolArray | None:
        """Take an image; return where patches have no part in the rim, (h, w), None for everywhere."""
        if self._brightest is None or self._brightest.shape != image.shape:
            self._brightest, self._black = image.copy(), -1
        if self._black == 0:
            return None
        np.maximum(self._brightest, image, out=self._brightest)
        dark = (self._brightest <= _BLACK).astype(np.uint8)
        black = int(np.count_nonzero(dark))
        if self._black < 0 or black < _LESS * self._black:
            self._clear = self._without(dark)
            self._black = 0 if self._clear is None else black
        return self._clear

    def _without(self, dark: Grey) -> BoolArray | None:
        """Return where patches are clear of what is dark and touches the border in one piece."""
        _, piece, figures, _ = cv2().connectedComponentsWithStats(dark, connectivity=4)
        height, width = dark.shape
        left, top, wide, high, area = figures.T
        at_border = (left == 0) | (top == 0) | (left + wide == width) | (top + high == height)
        is_rim = at_border & (area >= _LEAST_SHARE * dark.size)
        is_rim[0] = False  # what is not dark
        if not is_rim.any():
            return None
        kernel = np.ones((self._side, self._side), np.uint8)
        return np.asarray(cv2().dilate(is_rim[piece].astype(np.uint8), kernel) == 0)
