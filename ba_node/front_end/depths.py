# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measure how far points are in one keyframe, with whatever the rig has for it: a second camera or a depth image."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray
from ba_node.front_end import patches, stereo
from ba_node.front_end.alignment import StereoAlignment
from ba_node.front_end.frame import Frame, inside
from ba_node.front_end.rectify import IdealRig

# Standard deviation of a depth camera, as a share of the depth.
_DEPTH_SHARE = 0.02
_LARGEST_SHARE = 0.1
# Points at an image that rows are learned from, and which of them count.
_FOR_ROWS, _SAME, _SURE_PX, _MOST_OFF_PX = 120, 0.9, 0.15, 2.5


@dataclass(frozen=True)
class Depths:
    """Inverse depths of points in one image; rows as asked for."""

    measures: bool  # False if the rig has nothing to measure with
    inverse_depth: FloatArray  # (n,) 1/m, NaN where none was found
    sigma: FloatArray  # (n,) 1/m
    slant: FloatArray  # (n, 2) 1/m a px
    disparity: FloatArray  # (n,) px, NaN where none was found
    disparity_sigma: FloatArray  # (n,) px

    @property
    def found(self) -> BoolArray:
        """Return where something was found: (n,)."""
        return np.isfinite(self.inverse_depth)


def measure_depths(
    frame: Frame, rig: IdealRig, uv: FloatArray, first: FloatArray, side: int, alignment: StereoAlignment
) -> Depths:
    """Measure inverse depths at uv (n, 2), px; ``first`` are inverse depths (n,) that are known, NaN where none is."""
    if frame.right is not None and rig.baseline:
        return _stereo(frame, rig, uv, first, side, alignment)
    w, none = np.full(len(uv), np.nan), np.full(len(uv), np.nan)
    if frame.depth is not None:
        at = np.round(uv).astype(int)
        z = frame.depth[at[:, 1], at[:, 0]].astype(np.float64)
        w[z > 0.0] = 1.0 / z[z > 0.0]
    return Depths(frame.depth is not None, w, w * _DEPTH_SHARE, np.zeros((len(uv), 2)), none, none)


def _stereo(
    frame: Frame, rig: IdealRig, uv: FloatArray, first: FloatArray, side: int, alignment: StereoAlignment
) -> Depths:
    assert frame.right is not None
    fb = rig.focal * rig.baseline
    dense = stereo.dense(frame.grey, frame.right, int(_LARGEST_SHARE * frame.grey.shape[1]), rig.baseline < 0.0)
    start, slant = stereo.look_up(dense, uv, stereo.smaller(frame.grey.shape[1]))
    added = alignment.disparity(uv)
    start = np.where(np.isfinite(first), first * fb - added, start)
    off = alignment.rows_off(uv)
    found = stereo.measure(frame.soft, frame.right_soft, uv, (start, slant), side, off)
    if frame.right_rim is not None:
        there = np.column_stack([uv[:, 0] - found.value, uv[:, 1] + off])
        found = dataclasses.replace(found, value=np.where(inside(frame.right_rim, there), found.value, np.nan))
    if alignment.wants_rows:
        _learn_rows(frame, uv, found, side, alignment)
    value = found.value + added
    return Depths(True, value / fb, found.sigma / abs(fb), found.slant / fb, value, found.sigma)


def _learn_rows(frame: Frame, uv: FloatArray, found: stereo.Disparities, side: int, alignment: StereoAlignment) -> None:
    """Tell the alignment how far from their rows points are in the second image."""
    rows = np.flatnonzero(found.found)[:: max(1, int(found.found.sum()) // _FOR_ROWS)]
    if not len(rows):
        return
    affine = np.tile(np.eye(2), (len(rows), 1, 1))
    affine[:, 0] -= found.slant[rows]
    first = np.column_stack([uv[rows, 0] - found.value[rows], uv[rows, 1] + alignment.rows_off(uv[rows])])
    there = patches.align(patches.cut(frame.soft, uv[rows], side), frame.right_soft, first, affine)
    sigma = np.sqrt(np.maximum(there.covariance[:, 1, 1], 0.0))
    good = (there.correlation > _SAME) & (sigma < _SURE_PX) & (np.abs(there.uv - first).max(axis=1) < _MOST_OFF_PX)
    alignment.learn_rows(uv[rows][good], (there.uv[:, 1] - uv[rows, 1])[good], sigma[good])
