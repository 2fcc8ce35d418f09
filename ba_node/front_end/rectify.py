# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Rectify the images of a rig, as ideal cameras see them: without distortion, side by side, rows on rows.

The ideal cameras turn with the first one, their x axis along the baseline (Fusiello et al., *A compact algorithm for
rectification of stereo pairs*, 2000), and have one focal length f and one centre. A point at depth Z is in both in the
same row, with disparity ``d = x_first - x_second = f b / Z``; b is negative where the second camera is on the left.
Features are looked for there and told in pixels of the raw images, which are what the rig's intrinsics speak of.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray
from ba_node.core import cameras, geometry
from ba_node.estimate import Transform
from ba_node.front_end.opencv import cv2
from ba_node.front_end.records import FrontEndError
from ba_node.measurements import CameraRig

Pixels = TypeVar("Pixels", NDArray[np.uint8], NDArray[np.float32])

# Cameras whose ideal image is as their raw one to this many pixels are taken as they are.
_SAME_PX = 0.02
# A field of view wider than this (tangent of half of it) is cut: a flat image cannot hold it.
_WIDEST = 1.6
_LARGEST = 1.5
# Cameras that look apart by more than this have too little in common, deg.
_APART_DEG = 40.0


@dataclass(frozen=True)
class Camera:
    """A camera of the rig beside its ideal one."""

    model: cameras.Model
    params: FloatArray  # (12,) see ``core/cameras.py``
    raw_from_ideal: FloatArray  # (3, 3) rotation
    # (h, w) each: where the pixels of the ideal image are in the raw one; None where both are the same
    maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None
    inside: BoolArray | None  # (h, w) pixels of the ideal image that the raw one has; None if all


@dataclass(frozen=True)
class IdealRig:
    """Ideal cameras in the place of those of a rig."""

    focal: float  # px
    centre: FloatArray  # (2,) px
    size: tuple[int, int]  # width and height of ideal images, px
    baseline: float  # m, 0 of one camera; see above
    body_from_camera: Transform  # body from the first ideal camera
    cameras: tuple[Camera, ...]

    def image(self, index: int, raw: Pixels, linear: bool = True) -> Pixels:
        """Return the ideal image of a raw one; of depths and masks without blending (``linear=False``)."""
        camera = self.cameras[index]
        if camera.maps is None:
            return raw
        way = cv2().INTER_LINEAR if linear else cv2().INTER_NEAREST
        ideal: Pixels = cv2().remap(raw, *camera.maps, way)
        return ideal

    def raw(self, index: int, uv: FloatArray) -> FloatArray:
        """Return where pixels (n, 2) of an ideal image are in the raw one, px."""
        camera = self.cameras[index]
        return uv if camera.maps is None else _project(camera, self.rays(uv))

    def rays(self, uv: FloatArray) -> FloatArray:
        """Return X/Z, Y/Z, 1 of pixels of ideal images: (n, 3)."""
        return np.column_stack([(uv - self.centre) / self.focal, np.ones(len(uv))])

    def pixels(self, points: FloatArray) -> FloatArray:
        """Return where points (n, 3) in the frame of the first ideal camera are seen, (n, 2) px; NaN behind it."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ray = np.where(points[:, 2:] > 0.0, points[:, :2] / points[:, 2:], np.nan)
        return np.asarray(self.focal * ray + self.centre)


def ideal_rig(rig: CameraRig, first_size: tuple[int, int]) -> IdealRig:
    """Return the ideal cameras of a rig of one or two.

    Args:
        rig: the cameras.
        first_size: width and height of the first image, px, for a rig that does not say it.

    Raises:
        FrontEndError: a camera cannot be used, or two look apart or sit in one place.
    """
    if rig.malformed:
        raise FrontEndError(f"camera rig: {rig.malformed}")
    try:
        lenses = [cameras.parameters(*of) for of in zip(rig.models, rig.intrinsics, rig.distortion, strict=True)]
    except cameras.CameraError as error:
        raise FrontEndError(f"camera rig: {error}") from None
    sizes = [(int(w), int(h)) if w and h else first_size for w, h in rig.image_size]
    body_from_raw = geometry.matrix_from_quaternion(rig.orientation)
    axes, baseline = _axes(rig, body_from_raw)
    turns = [rotation.T @ axes for rotation in body_from_raw]
    focal, centre, size = _common(lenses, turns, sizes)
    ideal = IdealRig(focal, centre, size, baseline, Transform(axes, rig.position[0]), ())
    plain = _is_ideal(lenses, turns) and len(set(sizes)) == 1
    made = [Camera(*lens, turn, None, None) for lens, turn in zip(lenses, turns, strict=True)]
    if not plain:
        made = [_mapped(ideal, camera, size) for camera, size in zip(made, sizes, strict=True)]
    return dataclasses.replace(ideal, cameras=tuple(made))


def _axes(rig: CameraRig, body_from_raw: FloatArray) -> tuple[FloatArray, float]:
    """Return the axes of the ideal cameras in the body, (3, 3) by column, and the baseline, m, with its sign."""
    if len(rig) == 1:
        return body_from_raw[0], 0.0
    between = rig.position[1] - rig.position[0]
    length = float(np.linalg.norm(between))
    if length < 1e-4:
        raise FrontEndError(
            f"the two cameras sit in one place ({length:g} m apart): their baseline is missing in camera_info's p, in"
            " tf_static or in the rig's file"
        )
    ahead = body_from_raw[:, :, 2].sum(axis=0)
    sign = 1.0 if between @ body_from_raw[0, :, 0] >= 0.0 else -1.0
    x = sign * between / length
    y = np.cross(ahead, x)
    y /= max(float(np.linalg.norm(y)), 1e-9)
    axes = np.stack([x, y, np.cross(x, y)], axis=1)
    apart = np.degrees(np.arccos(np.clip(body_from_raw[:, :, 2] @ axes[:, 2], -1.0, 1.0))).max()
    if apart > _APART_DEG:
        raise FrontEndError(
            f"the cameras look {apart:.0f} degrees away from a right angle to their baseline: expected two side by side"
        )
    return axes, sign * length


def _common(
    lenses: list[tuple[cameras.Model, FloatArray]], turns: list[FloatArray], sizes: list[tuple[int, int]]
) -> tuple[float, FloatArray, tuple[int, int]]:
    """Return focal length, centre and size of ideal images that hold what all raw ones do, up to a limit."""
    focal = float(np.mean([params[[cameras.FX, cameras.FY]].mean() for _, params in lenses]))
    if _is_ideal(lenses, turns):
        return float(lenses[0][1][cameras.FX]), lenses[0][1][cameras.CX : cameras.CY + 1].copy(), sizes[0]
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for (model, params), turn, size in zip(lenses, turns, sizes, strict=True):
        ray = cameras.rays(_border(size), np.full(4 * _STEPS, model), np.tile(params, (4 * _STEPS, 1))) @ turn
        seen = ray[np.isfinite(ray).all(axis=1) & (ray[:, 2] > 1e-3)]
        flat = seen[:, :2] / seen[:, 2:]
        low = np.minimum(low, flat.min(axis=0, initial=np.inf))
        high = np.maximum(high, flat.max(axis=0, initial=-np.inf))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise FrontEndError("camera rig: the border of the image has no rays: check distortion and image size")
    reach = _LARGEST * np.array(sizes[0]) / 2.0 / focal
    limit = np.minimum(reach, _WIDEST) if any(m == cameras.Model.EQUIDISTANT for m, _ in lenses) else reach
    low, high = np.maximum(low, -limit), np.minimum(high, limit)
    width, height = np.ceil(focal * (high - low)).astype(int)
    return focal, -focal * low, (int(width), int(height))


_STEPS = 50


def _border(size: tuple[int, int]) -> FloatArray:
    """Return pixels along the border of an image, (4 * _STEPS, 2)."""
    x, y = np.linspace(0.0, size[0] - 1.0, _STEPS), np.linspace(0.0, size[1] - 1.0, _STEPS)
    sides = [(x, 0.0 * x), (x, 0.0 * x + y[-1]), (0.0 * y, y), (0.0 * y + x[-1], y)]
    return np.concatenate([np.column_stack(side) for side in sides])


def _is_ideal(lenses: list[tuple[cameras.Model, FloatArray]], turns: list[FloatArray]) -> bool:
    """Return True if raw images are ideal ones already."""
    first = lenses[0][1]
    flat = all(model == cameras.Model.RATIONAL and not params[cameras.DISTORTION].any() for model, params in lenses)
    alike = all(np.abs(params[:4] - first[:4]).max() < _SAME_PX for _, params in lenses)
    square = abs(first[cameras.FX] - first[cameras.FY]) < _SAME_PX
    tilt = max(float(np.abs(turn - np.eye(3)).max()) for turn in turns)
    return bool(flat and alike and square and tilt * first[cameras.FX] < _SAME_PX)


def _mapped(ideal: IdealRig, bare: Camera, size: tuple[int, int]) -> Camera:
    """Return a camera with the maps from its ideal image to the raw one."""
    x, y = np.meshgrid(np.arange(ideal.size[0], dtype=float), np.arange(ideal.size[1], dtype=float))
    uv = _project(bare, ideal.rays(np.column_stack([x.ravel(), y.ravel()]))).reshape(*x.shape, 2)
    inside: BoolArray = np.logical_and((uv >= 0.0).all(axis=2), (uv <= np.array(size) - 1.0).all(axis=2))
    flat = np.nan_to_num(uv, nan=-1e4).astype(np.float32)
    maps = (np.ascontiguousarray(flat[..., 0]), np.ascontiguousarray(flat[..., 1]))
    return dataclasses.replace(bare, maps=maps, inside=None if inside.all() else inside)


def _project(camera: Camera, rays: FloatArray) -> FloatArray:
    """Return pixels of the raw image of rays (n, 3) of the ideal camera; NaN where the lens folds over."""
    turned = rays @ camera.raw_from_ideal.T
    model = np.full(1, camera.model)
    with np.errstate(all="ignore"):
        uv = cameras.project(turned, model, camera.params[None])
        angle = np.arctan2(np.hypot(turned[:, 0], turned[:, 1]), turned[:, 2])
        bad = cameras.behind(turned, model) | ~np.isfinite(uv).all(axis=1)
    uv[bad | (angle > cameras.fold(camera.model, camera.params)[0])] = np.nan
    return uv
