# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold one bundle-adjustment problem as arrays: poses, points, cameras and observations.

A keyframe is the pose of a body; cameras sit on the body with fixed extrinsics. The chain of an
observation of point ``x`` is, with ``R, t = body_from_world`` and ``Rc, tc = camera_from_body``::

    X_body = R x + t            (2.18)
    X_cam  = Rc X_body + tc     (camera optical frame: x right, y down, z forward)
    (u, v) = K distort(X_cam / Z_cam)

A Snavely (BAL) camera is a body that looks down -z with one camera at ``Rc = diag(1, -1, -1)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray


class ProblemError(ValueError):
    """A problem that cannot be posed: wrong shapes, indices out of range, numbers that are not finite."""


@dataclass(frozen=True)
class State:
    """The unknowns."""

    rotation: FloatArray  # (n_kf, 3, 3) body from world
    translation: FloatArray  # (n_kf, 3) body from world, m
    points: FloatArray  # (n_pt, 3) in the world, m
    # (n_kf, 3) f, k1, k2 of each keyframe's camera (f in px), or (0, 3) when the cameras' own are used
    intrinsics: FloatArray

    def is_finite(self) -> bool:
        """Return True if no number is NaN or infinite."""
        return all(np.isfinite(array).all() for array in vars(self).values())


@dataclass(frozen=True)
class Cameras:
    """The cameras of the rig."""

    rotation: FloatArray  # (n_cam, 3, 3) camera optical frame from body
    translation: FloatArray  # (n_cam, 3) camera optical frame from body, m
    model: NDArray[np.uint8]  # (n_cam,) see ``cameras.Model``
    # (n_cam, 12) fx fy cx cy in px, then eight distortion coefficients in CameraInfo's order, zero-padded
    params: FloatArray


@dataclass(frozen=True)
class Observations:
    """Who saw what where. Rows are sorted by point (stable), which every sum over a point's rows relies on."""

    keyframe: IntArray  # (n_obs,) index into the poses
    camera: IntArray  # (n_obs,) index into the cameras
    point: IntArray  # (n_obs,) index into the points, ascending
    uv: FloatArray  # (n_obs, 2) raw image coordinates, px
    sigma_px: FloatArray  # (n_obs,) standard deviation of u and of v, px
    depth_m: FloatArray  # (n_obs,) measured distance along the optical axis, m; NaN for none; (0,) if none has one
    depth_sigma_m: FloatArray  # (n_obs,) its standard deviation, m; or (0,)

    def __len__(self) -> int:
        return len(self.keyframe)

    def take(self, rows: IntArray) -> Observations:
        """Return some of them."""
        columns = (column.take(rows, axis=0) if len(column) else column for column in vars(self).values())
        return Observations(*columns)


class KeyframeFactors(Protocol):
    """Factors of one kind: n of them, each with m residuals on k keyframes.

    Attributes:
        keyframes: (n, k) indices of the keyframes of each.
        loss: robust loss, one of loss.LOSSES, on the norm of the whitened residual.
        loss_scale: where it leaves the square.
    """

    @property
    def keyframes(self) -> IntArray:
        """Return (n, k) indices of the keyframes of each."""

    @property
    def loss(self) -> str:
        """Return the robust loss."""

    @property
    def loss_scale(self) -> float:
        """Return where the loss leaves the square."""

    def residuals(self, state: State) -> FloatArray:
        """Return the whitened residuals, (n, m)."""

    def jacobians(self, state: State) -> FloatArray:
        """Return their derivatives by the local steps of the keyframes, (n, k, m, 6): rotation, then translation."""

    def check(self, n_keyframes: int) -> None:
        """Raise ProblemError if shapes, indices or numbers are wrong; name the first offender."""


@dataclass(frozen=True)
class PointPriors:
    """Points whose places were measured."""

    point: IntArray  # (n,) index into the points, all different
    position: FloatArray  # (n, 3) m
    covariance: FloatArray  # (n, 3, 3) m^2, positive definite


@dataclass(frozen=True)
class Problem:
    """A problem: start values, what is fixed, cameras and observations."""

    start: State  # where the solver begins
    fixed: BoolArray  # (n_kf,) True where the pose (and intrinsics) of a keyframe is fixed
    cameras: Cameras  # the rig
    observations: Observations  # sorted by point
    factors: tuple[KeyframeFactors, ...] = ()  # all terms of the objective that are not reprojections, see factors.py
    point_priors: PointPriors | None = None  # of points, see point_priors.py; None for none

    @property
    def n_keyframes(self) -> int:
        """Return the number of poses, free and fixed."""
        return len(self.start.translation)

    @property
    def n_points(self) -> int:
        """Return the number of points."""
        return len(self.start.points)

    @property
    def has_scale(self) -> bool:
        """Return True if images tell lengths: by several cameras, or by depths."""
        return len(self.cameras.model) > 1 or len(self.observations.depth_m) > 0

    @property
    def free_intrinsics(self) -> bool:
        """Return True if each keyframe has its own f, k1, k2 (9 parameters a keyframe instead of 6)."""
        return len(self.start.intrinsics) > 0

    @property
    def n_factors(self) -> int:
        """Return the number of factors of all kinds."""
        return sum(len(kind.keyframes) for kind in self.factors)

    def check(self) -> None:
        """Raise ProblemError if shapes, indices or numbers are wrong; name the first offender."""
        for kind in self.factors:
            kind.check(self.n_keyframes)
        obs = self.observations
        n_obs = len(obs)
        _check_shapes(self, n_obs)
        if native.kernels is not None and native.kernels.is_sound(self):
            return
        limits = ((obs.keyframe, self.n_keyframes), (obs.camera, len(self.cameras.model)), (obs.point, self.n_points))
        for (index, limit), name in zip(limits, ("keyframe", "camera", "point"), strict=True):
            if n_obs and (index.min() < 0 or index.max() >= limit):
                bad = np.flatnonzero((index < 0) | (index >= limit))
                raise ProblemError(f"observation {bad[0]}: {name} index {index[bad[0]]} is out of range [0, {limit})")
        if (obs.point[1:] < obs.point[:-1]).any():
            raise ProblemError("observations are not sorted by point: sort them (stable) first")
        for name, array in (("uv", obs.uv), ("sigma_px", obs.sigma_px), ("camera params", self.cameras.params)):
            if not np.isfinite(array).all():
                row = int(np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))[0])
                raise ProblemError(f"{name} of row {row} is not finite: {array[row]}")
        if (obs.sigma_px <= 0).any():
            row = int(np.argmax(obs.sigma_px <= 0))
            raise ProblemError(f"sigma_px of observation {row} is {obs.sigma_px[row]}: expected > 0")
        if not self.start.is_finite():
            raise ProblemError("the start values hold a number that is not finite")


def _check_shapes(problem: Problem, n_obs: int) -> None:
    start, obs, cams = problem.start, problem.observations, problem.cameras
    n_kf, n_cam = len(start.translation), len(cams.model)
    expected: dict[str, tuple[NDArray[np.generic], tuple[int, ...]]] = {
        "rotation": (start.rotation, (n_kf, 3, 3)),
        "translation": (start.translation, (n_kf, 3)),
        "points": (start.points, (len(start.points), 3)),
        "intrinsics": (start.intrinsics, (n_kf if len(start.intrinsics) else 0, 3)),
        "fixed": (problem.fixed, (n_kf,)),
        "camera rotation": (cams.rotation, (n_cam, 3, 3)),
        "camera translation": (cams.translation, (n_cam, 3)),
        "camera params": (cams.params, (n_cam, 12)),
        "observation camera": (obs.camera, (n_obs,)),
        "observation point": (obs.point, (n_obs,)),
        "uv": (obs.uv, (n_obs, 2)),
        "sigma_px": (obs.sigma_px, (n_obs,)),
        "depth_m": (obs.depth_m, (n_obs if len(obs.depth_m) else 0,)),
        "depth_sigma_m": (obs.depth_sigma_m, (len(obs.depth_m),)),
    }
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise ProblemError(f"{name} has shape {array.shape}, expected {shape}")
