# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read a ``sensor_msgs/CameraInfo``: what its camera is to pixels of the image that was sent.

``k`` is that of the whole sensor at full resolution. An image may be a part of it (``roi``, in pixels of the sensor),
and pixels may have been binned after that. So, as in ROS's own ``image_geometry``::

    cx' = (cx - x_offset) / binning_x        fx' = fx / binning_x

The distortion belongs to the rays and stays. ``r`` and ``p`` speak of rectified images, and so does
``roi.do_rectify``; tracks are in raw images, so these are not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray
from ba_node.measurements import CameraRig
from ba_node.messages.factory import ConversionError

# What no camera has: of a matrix in other units, or of another thing.
FOCAL_RANGE_PX = (1.0, 1e6)
MAX_FOCAL_RATIO = 3.0
# Shortest and longest focal length by the longer side of the sensor: a field of view far beyond any fisheye's, and one
# of 0.06 degrees.
FOCAL_BY_SIZE = (0.02, 1000.0)
# How far outside the sensor the principal point may lie, by its width and height.
MAX_OUTSIDE = 1.0
MAX_BINNING = 64
# A skew smaller than this, by fx, moves no pixel by a hundredth.
_SKEW = 1e-6


@dataclass(frozen=True)
class Lens:
    """A camera to the pixels of its images."""

    intrinsics: FloatArray  # (4,) fx fy cx cy, px
    distortion: FloatArray  # coefficients d
    image_size: NDArray[np.int64]  # (2,) int64, width and height, px, 0 if unknown
    note: str = ""  # how k was adjusted to the image, empty if it was not


def lens_of(info: Any) -> Lens:
    """Return the camera of a message.

    Raises:
        ConversionError: k is none of a calibrated camera, or region and binning do not fit the sensor; names the value.
    """
    size = np.array([info.width, info.height], dtype=np.int64)
    intrinsics = _intrinsics(np.array(info.k, dtype=np.float64).reshape(-1))
    _check_against_size(intrinsics, size)
    begin, image_size, binning = _region(info, size)
    note = ""
    if begin.any() or (binning != 1).any() or (image_size != size).any():
        region = f"region {image_size[0]} x {image_size[1]} px at ({begin[0]}, {begin[1]})"
        note = (
            f"k is of the sensor, {size[0]} x {size[1]} px, and was taken to the image:"
            f" {region}, binning {binning[0]} x {binning[1]}"
        )
    intrinsics[2:] -= begin
    intrinsics /= np.tile(binning, 2)
    return Lens(intrinsics, np.array(info.d, dtype=np.float64).reshape(-1), image_size // binning, note)


def unplaced(frame_id: str, names: Sequence[str], models: Sequence[str], lenses: Sequence[Lens]) -> CameraRig:
    """Return a rig with all its cameras at the origin of the body."""
    n = len(names)
    return CameraRig(
        frame_id=frame_id,
        names=tuple(names),
        models=tuple(models),
        intrinsics=np.array([lens.intrinsics for lens in lenses]).reshape(-1, 4),
        distortion=tuple(lens.distortion for lens in lenses),
        image_size=np.array([lens.image_size for lens in lenses], np.int64).reshape(-1, 2),
        position=np.zeros((n, 3)),
        orientation=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        notes=tuple(f"camera {i} ({names[i]!r}): {lens.note}" for i, lens in enumerate(lenses) if lens.note),
    )


def _intrinsics(k: FloatArray) -> FloatArray:
    """Return fx fy cx cy of a matrix, row by row."""
    if len(k) != 9:
        raise ConversionError(f"k has {len(k)} entries, expected 9: 3 x 3, row by row")
    shown = f"k = [{', '.join(f'{value:g}' for value in k)}]"
    if not np.isfinite(k).all():
        raise ConversionError(f"{shown} is not finite: calibrate the camera")
    if not k.any():
        raise ConversionError("k is all zero, which says that the camera is not calibrated: calibrate it")
    if k[8] == 1.0 and not k[[2, 5]].any() and k[6:8].any():
        raise ConversionError(f"{shown} is transposed: expected row by row, fx 0 cx 0 fy cy 0 0 1")
    if not np.array_equal(k[6:], [0.0, 0.0, 1.0]):
        raise ConversionError(f"{shown} has the bottom row {k[6]:g} {k[7]:g} {k[8]:g}: expected 0 0 1")
    for index, name in ((1, "skew k[1]"), (3, "k[3]")):
        if abs(k[index]) > _SKEW * abs(k[0]):
            raise ConversionError(f"{name} = {k[index]:g}: expected 0, pixels in rows and columns")
    low, high = FOCAL_RANGE_PX
    for name, focal in (("fx", k[0]), ("fy", k[4])):
        if not low <= focal <= high:
            raise ConversionError(f"focal length {name} = {focal:g}: expected {low:g} to {high:g} px")
    if max(k[0], k[4]) > MAX_FOCAL_RATIO * min(k[0], k[4]):
        raise ConversionError(
            f"focal lengths fx = {k[0]:g}, fy = {k[4]:g} px: one is more than {MAX_FOCAL_RATIO:g} times the other"
        )
    return k[[0, 4, 2, 5]]


def _check_against_size(intrinsics: FloatArray, size: NDArray[np.int64]) -> None:
    """Raise ConversionError if the size of the sensor is known and k cannot be that of such a sensor."""
    if not size.all():
        return
    sensor = f"the sensor has {size[0]} x {size[1]} px"
    low, high = (share * size.max() for share in FOCAL_BY_SIZE)
    for name, focal in zip(("fx", "fy"), intrinsics, strict=False):
        if not low <= focal <= high:
            raise ConversionError(f"focal length {name} = {focal:g} px where {sensor}: expected px, not another unit")
    for name, centre, side in zip(("cx", "cy"), intrinsics[2:], size, strict=True):
        if not -MAX_OUTSIDE * side <= centre <= (1.0 + MAX_OUTSIDE) * side:
            raise ConversionError(f"principal point {name} = {centre:g} px is far outside: {sensor}")


def _region(info: Any, size: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Return where the image begins on the sensor, its size there, and the binning; all (2,) in x and y."""
    roi = getattr(info, "roi", None)
    begin, extent = np.zeros(2, np.int64), np.zeros(2, np.int64)
    if roi is not None:
        begin, extent = np.array([roi.x_offset, roi.y_offset], np.int64), np.array([roi.width, roi.height], np.int64)
    # Zeros say: to the end of the sensor.
    extent = np.where((extent == 0) & (size > 0), size - begin, extent)
    if size.all() and ((begin >= size) | (extent < 1) | (begin + extent > size)).any():
        raise ConversionError(
            f"region of interest {extent[0]} x {extent[1]} px at ({begin[0]}, {begin[1]}) is not on the sensor of"
            f" {size[0]} x {size[1]} px: width and height are those of the whole sensor"
        )
    binning = np.array([getattr(info, "binning_x", 0), getattr(info, "binning_y", 0)], np.int64)
    binning = np.maximum(binning, 1)
    if (binning > MAX_BINNING).any():
        raise ConversionError(f"binning {binning[0]} x {binning[1]}: expected 1 (or 0) to {MAX_BINNING}")
    return begin, extent, binning
