# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Reconstructions of other tools in one form: cameras, frames, points and observations.

Pixels are counted as in OpenCV and ROS: (0, 0) is the middle of the first pixel. Cameras look along +z, with y down.
A camera has one of the models of COLMAP, all of which are special cases of ours::

    SIMPLE_PINHOLE f cx cy                PINHOLE fx fy cx cy
    SIMPLE_RADIAL  f cx cy k1             RADIAL  f cx cy k1 k2
    OPENCV fx fy cx cy k1 k2 p1 p2        FULL_OPENCV ... k3 k4 k5 k6
    OPENCV_FISHEYE fx fy cx cy k1 k2 k3 k4, SIMPLE_RADIAL_FISHEYE f cx cy k1, RADIAL_FISHEYE f cx cy k1 k2
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core.cameras import CX, CY, FX, FY, N_PARAMS, Model
from ba_node.core.geometry import compose, so3_exp, so3_log
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.io.bal import BalProblem

_F, _PINHOLE = ((FX, FY), (CX,), (CY,)), ((FX,), (FY,), (CX,), (CY,))
_K = tuple((column,) for column in range(4, N_PARAMS))
# By name: family, and for each parameter in COLMAP's order the columns of ours that it stands for.
LENSES: dict[str, tuple[Model, tuple[tuple[int, ...], ...]]] = {
    "SIMPLE_PINHOLE": (Model.RATIONAL, _F),
    "PINHOLE": (Model.RATIONAL, _PINHOLE),
    "SIMPLE_RADIAL": (Model.RATIONAL, (*_F, *_K[:1])),
    "RADIAL": (Model.RATIONAL, (*_F, *_K[:2])),
    "OPENCV": (Model.RATIONAL, (*_PINHOLE, *_K[:4])),
    "FULL_OPENCV": (Model.RATIONAL, (*_PINHOLE, *_K)),
    "OPENCV_FISHEYE": (Model.EQUIDISTANT, (*_PINHOLE, *_K[:4])),
    "SIMPLE_RADIAL_FISHEYE": (Model.EQUIDISTANT, (*_F, *_K[:1])),
    "RADIAL_FISHEYE": (Model.EQUIDISTANT, (*_F, *_K[:2])),
}
# A BAL camera looks along -z with y up: diag(1, -1, -1) makes an optical frame of it.
_OPTICAL = np.diag([1.0, -1.0, -1.0])


class ModelError(ValueError):
    """A reconstruction that cannot be read, written, or said in another format."""


@dataclass(frozen=True)
class Reconstruction:
    """What any of the formats holds."""

    lens: tuple[str, ...]  # (n_cam,) name of each camera's model, one of LENSES
    size: IntArray  # (n_cam, 2) width and height, px; zeros where unknown
    cameras: Cameras  # (n_cam,) parameters and places on the body
    rotation: FloatArray  # (n, 3, 3) body from world of each frame
    translation: FloatArray  # (n, 3) the same
    points: FloatArray  # (m, 3) in the world
    colour: IntArray  # (m, 3) red, green, blue, 0 to 255
    frame: IntArray  # (l,) of each observation
    camera: IntArray  # (l,) the same
    point: IntArray  # (l,) the same
    uv: FloatArray  # (l, 2) px
    stamp_ns: IntArray  # (n,) of each frame
    sigma_px: FloatArray | None = None  # (l,) of each observation, px; 1 if None

    @property
    def sigma(self) -> FloatArray:
        """Return the standard deviation of each observation, (l,) px."""
        return np.ones(len(self.uv)) if self.sigma_px is None else self.sigma_px

    def images(self) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
        """Return frame and camera of each image (k, 2), its rotation and translation, and the image of observations."""
        images, image = np.unique(np.stack([self.frame, self.camera], axis=1), axis=0, return_inverse=True)
        frame, camera = images.T
        place = (self.cameras.rotation[camera], self.cameras.translation[camera])
        return images, *compose(*place, self.rotation[frame], self.translation[frame]), image.ravel()

    def problem(self) -> Problem:
        """Return the problem, of 6 parameters a frame, with nothing fixed."""
        order = np.argsort(self.point, kind="stable")
        start = State(self.rotation, self.translation, self.points, np.empty((0, 3)))
        observations = Observations(
            keyframe=self.frame[order],
            camera=self.camera[order],
            point=self.point[order],
            uv=self.uv[order],
            sigma_px=self.sigma[order],
            depth_m=np.empty(0),
            depth_sigma_m=np.empty(0),
        )
        return Problem(start, np.zeros(len(self.rotation), dtype=bool), self.cameras, observations)

    def with_state(self, state: State, cameras: Cameras) -> Reconstruction:
        """Return it with a solution of :meth:`problem` in place of what it has."""
        moved = replace(self, rotation=state.rotation, translation=state.translation)
        return replace(moved, points=state.points, cameras=cameras)

    def once(self) -> tuple[Reconstruction, int]:
        """Return it with each point once in an image, the first time, and how many observations were left out."""
        image = self.frame * max(len(self.lens), 1) + self.camera
        _, first = np.unique(np.stack([image, self.point], axis=1), axis=0, return_index=True)
        rows = np.sort(first)
        kept = replace(self, frame=self.frame[rows], camera=self.camera[rows], point=self.point[rows], uv=self.uv[rows])
        kept = kept if self.sigma_px is None else replace(kept, sigma_px=self.sigma_px[rows])
        return kept, len(self.frame) - len(rows)


def lens_of(model: int, params: FloatArray) -> str:
    """Return the simplest lens that a camera of ours, (12,), is."""
    for name, (family, columns) in sorted(LENSES.items(), key=lambda item: len(item[1][1])):
        held = np.zeros(N_PARAMS)
        for of in columns:
            held[list(of)] = params[of[0]]
        if family == model and np.array_equal(held, params):
            return name
    raise AssertionError("FULL_OPENCV and OPENCV_FISHEYE are all that there is")


def read_lens(name: str, values: FloatArray, where: str) -> tuple[Model, FloatArray]:
    """Return family and parameters (12,) of a camera of COLMAP, whose pixels begin at the corner.

    Raises:
        ModelError: the model is unknown; ``where`` names the camera.
    """
    if name not in LENSES:
        known = ", ".join(LENSES)
        raise ModelError(
            f"{where}: camera model {name} is not supported: expected one of {known}; undistort the images"
        )
    family, columns = LENSES[name]
    params = np.zeros(N_PARAMS)
    for value, of in zip(values, columns, strict=True):
        params[list(of)] = value
    params[[CX, CY]] -= 0.5
    return family, params


def lens_values(name: str, params: FloatArray) -> FloatArray:
    """Return the parameters of a lens in COLMAP's order, of pixels that begin at the corner."""
    shifted = params.copy()
    shifted[[CX, CY]] += 0.5
    return np.array([shifted[of[0]] for of in LENSES[name][1]])


def from_bal(bal: BalProblem) -> Reconstruction:
    """Return a BAL problem; each image has a camera of its own, the principal point is (0, 0)."""
    n = len(bal.cameras)
    params = np.zeros((n, N_PARAMS))
    params[:, [FX, FY]] = bal.cameras[:, 6:7]
    params[:, 4:6] = bal.cameras[:, 7:]
    rotation, translation = _OPTICAL @ so3_exp(bal.cameras[:, :3]), bal.cameras[:, 3:6] @ _OPTICAL
    cameras = Cameras(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros(n, np.uint8), params)
    return Reconstruction(
        ("RADIAL",) * n,
        np.zeros((n, 2), np.intp),
        cameras,
        rotation,
        translation,
        bal.points,
        np.full((len(bal.points), 3), 255),
        bal.camera_index,
        bal.camera_index,
        bal.point_index,
        bal.observations * [1.0, -1.0],
        stamps(n),
    )


def to_bal(model: Reconstruction) -> BalProblem:
    """Return a reconstruction as BAL and Bundler have it, an image each camera, pixels from the principal point.

    Raises:
        ModelError: a camera has more than f, k1 and k2.
    """
    for number, (family, params) in enumerate(zip(model.cameras.model, model.cameras.params, strict=True)):
        if family != Model.RATIONAL or params[FX] != params[FY] or params[6:].any():
            raise ModelError(
                f"camera {number} ({model.lens[number]}): BAL and Bundler have cameras of f, k1 and k2 alone:"
                f" fx = {params[FX]:g}, fy = {params[FY]:g}, other coefficients {params[6:].tolist()}"
            )
    images, rotation, translation, image = model.images()
    params = model.cameras.params
    values = [so3_log(_OPTICAL @ rotation), translation @ _OPTICAL, params[images[:, 1]][:, [FX, 4, 5]]]
    uv = (model.uv - params[model.camera][:, [CX, CY]]) * [1.0, -1.0]
    return BalProblem(np.hstack(values), model.points, image, model.point, uv)


def stamps(n: int) -> IntArray:
    """Return stamps for frames without: 0.1 s apart from 1 s on, ns."""
    return np.arange(n, dtype=np.int64) * 100_000_000 + 1_000_000_000
