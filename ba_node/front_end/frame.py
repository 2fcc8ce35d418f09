# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold the images of one time as ideal cameras see them, ready to be compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray
from ba_node.front_end.opencv import cv2
from ba_node.front_end.patches import Floats
from ba_node.front_end.records import Grey
from ba_node.kept import kept_property

# Images are smoothed by this before patches are compared, px.
SMOOTHING_PX = 1.0


@dataclass(frozen=True)
class Frame:
    """Images of one time, as ideal cameras see them."""

    grey: Grey
    right: Grey | None
    depth: NDArray[np.float32] | None
    allowed: BoolArray  # (h, w) where features may be
    right_rim: BoolArray | None = None  # (h, w) where patches are clear of the second image's rim; None for everywhere

    @property
    def right_clear(self) -> BoolArray:
        """Return where patches are clear of the second image's rim: (h, w)."""
        return np.ones(self.grey.shape, bool) if self.right_rim is None else self.right_rim

    @kept_property
    def soft(self) -> Floats:
        """Return the first image smoothed, in which patches are compared: (h, w) float32."""
        return soften(self.grey)

    @kept_property
    def right_soft(self) -> Floats:
        """Return the second image smoothed."""
        assert self.right is not None
        return soften(self.right)


def inside(allowed: BoolArray, uv: FloatArray) -> BoolArray:
    """Return which of uv (n, 2), px, round to a pixel that is allowed; none outside the image is."""
    height, width = allowed.shape
    at = np.round(np.nan_to_num(uv, nan=-1.0)).astype(np.intp)
    good: BoolArray = np.asarray(((at >= 0) & (at < [width, height])).all(axis=1))
    good[good] = allowed[at[good, 1], at[good, 0]]
    return good


def soften(image: Grey) -> Floats:
    """Return a smoothed image as float32."""
    soft: Floats = cv2().sepFilter2D(image, cv2().CV_32F, *[cv2().getGaussianKernel(9, SMOOTHING_PX)] * 2)
    return soft
