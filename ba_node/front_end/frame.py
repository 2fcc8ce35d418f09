# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold the images of one time as ideal cameras see them, ready to be compared."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray
from ba_node.front_end.opencv import cv2
from ba_node.front_end.patches import Floats
from ba_node.front_end.records import Grey

# Images are smoothed by this before patches are compared, px.
SMOOTHING_PX = 1.0


@dataclass(frozen=True)
class Frame:
    """Images of one time, as ideal cameras see them."""

    grey: Grey
    right: Grey | None
    depth: NDArray[np.float32] | None
    allowed: BoolArray  # (h, w) where features may be

    @cached_property
    def soft(self) -> Floats:
        """Return the first image smoothed, in which patches are compared: (h, w) float32."""
        return soften(self.grey)

    @cached_property
    def right_soft(self) -> Floats:
        """Return the second image smoothed."""
        assert self.right is not None
        return soften(self.right)


def soften(image: Grey) -> Floats:
    """Return a smoothed image as float32."""
    soft: Floats = cv2().GaussianBlur(image.astype(np.float32), (0, 0), SMOOTHING_PX)
    return soft
