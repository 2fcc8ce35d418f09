# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on single keyframes: where the body is, how it is turned, which way is down. And a base for one's own.

The body's centre in the world is ``c = -R' t``, that of a point l of the body (a lever arm) ``q = c + R' l``. By the
local step ``R <- R Exp(dphi), t <- t + R dt`` of factors.py::

    q(step) = q + [q]x dphi - dt
    Log(M' R'),  M a measured world-from-body,  changes by  -Jr^-1(Log(M' R')) R dphi
    R d,  d a direction in the world,           changes by  -R [d]x dphi
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core import geometry, parameterisation
from ba_node.core.factors import check_common
from ba_node.core.problem import ProblemError, State

# Step of the central differences: for residuals of the size of 1 their errors are about 1e-9.
_STEP = 1e-5


@dataclass(frozen=True)
class CustomFactors:
    """Base of factors of one's own: a derived class has ``residuals`` alone; derivatives are central differences."""

    keyframes: IntArray  # (n, k) indices of the keyframes of each
    loss: str = "squared"  # robust loss
    loss_scale: float = 1.0  # where it leaves the square

    def residuals(self, state: State) -> FloatArray:
        """Return the whitened residuals, (n, m); row i depends on the poses of ``keyframes[i]`` alone."""
        raise NotImplementedError

    def jacobians(self, state: State) -> FloatArray:
        """Return the derivatives of the residuals by the local steps of the keyframes, (n, k, m, 6)."""
        n, k = self.keyframes.shape
        # Each factor gets keyframes of its own, so that all are stepped at once.
        flat = self.keyframes.ravel()
        own = replace(self, keyframes=np.arange(n * k).reshape(n, k))
        state = replace(state, rotation=state.rotation[flat], translation=state.translation[flat])
        columns = []
        for place, axis in itertools.product(range(k), range(6)):
            step = np.zeros((n * k, 6))
            step[place::k, axis] = _STEP
            ends = [own.residuals(_stepped(state, sign * step)) for sign in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2.0 * _STEP))
        return np.stack(columns, axis=-1).reshape(n, -1, k, 6).swapaxes(1, 2)

    def check(self, n_keyframes: int) -> None:
        """Raise ProblemError if a keyframe does not exist, or the loss."""
        check_common(self, n_keyframes)


@dataclass(frozen=True)
class PosePriors:
    """Measured positions of a point of the body, and orientations of the body where ``root_information`` has them."""

    keyframes: IntArray  # (n, 1)
    rotation: FloatArray  # (n, 3, 3) world from body; any where it was not measured
    position: FloatArray  # (n, 3) of the point, m
    lever_arm: FloatArray  # (n, 3) where the point is in the body, m
    root_information: FloatArray  # (n, 6, 6) on rotation about the axes of the body (rad), then position (m)
    loss: str = "squared"
    loss_scale: float = 1.0

    def __len__(self) -> int:
        return len(self.keyframes)

    def residuals(self, state: State) -> FloatArray:
        """Return the whitened residuals, (n, 6)."""
        turn, off, _ = self._errors(state)
        return np.asarray((self.root_information @ np.concatenate([turn, off], axis=1)[:, :, None])[..., 0])

    def jacobians(self, state: State) -> FloatArray:
        """Return the derivatives of the residuals by the local steps, (n, 1, 6, 6)."""
        turn, _, point = self._errors(state)
        a = np.zeros((len(self), 6, 6))
        a[:, :3, :3] = -geometry.inverse_right_jacobian(turn) @ state.rotation[self.keyframes[:, 0]]
        a[:, 3:, :3] = geometry.hat(point)
        a[:, 3:, 3:] = -np.eye(3)
        return np.asarray((self.root_information @ a)[:, None])

    def check(self, n_keyframes: int) -> None:
        """Raise ProblemError if shapes, indices or numbers are wrong."""
        n = len(self)
        shapes = {"rotation": (n, 3, 3), "position": (n, 3), "lever_arm": (n, 3), "root_information": (n, 6, 6)}
        _check_shapes(self, {"keyframes": (n, 1)} | shapes)
        check_common(self, n_keyframes)

    def _errors(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rotation (n, 3) rad and position (n, 3) m against what was measured, and the point in the world."""
        at = self.keyframes[:, 0]
        back = np.swapaxes(state.rotation[at], 1, 2)
        point = (back @ (self.lever_arm - state.translation[at])[:, :, None])[..., 0]
        # Most measure positions alone, and a logarithm costs more than all else.
        turned = bool(self.root_information[:, :, :3].any())
        turn = geometry.so3_log(np.swapaxes(self.rotation, 1, 2) @ back) if turned else np.zeros((len(self), 3))
        return turn, point - self.position, point


@dataclass(frozen=True)
class Directions:
    """Measured directions in the body of directions that are known in the world: gravity, levelness."""

    keyframes: IntArray  # (n, 1)
    world: FloatArray  # (n, 3) in the world, unit
    body: FloatArray  # (n, 3) as measured in the body, unit
    sigma_rad: FloatArray  # (n,) standard deviation about each axis across it
    loss: str = "squared"
    loss_scale: float = 1.0

    def __len__(self) -> int:
        return len(self.keyframes)

    def residuals(self, state: State) -> FloatArray:
        """Return the whitened residuals, (n, 3); their part along the direction is of second order."""
        seen = (state.rotation[self.keyframes[:, 0]] @ self.world[:, :, None])[..., 0]
        return np.asarray((seen - self.body) / self.sigma_rad[:, None])

    def jacobians(self, state: State) -> FloatArray:
        """Return the derivatives of the residuals by the local steps, (n, 1, 3, 6)."""
        out = np.zeros((len(self), 1, 3, 6))
        out[:, 0, :, :3] = -state.rotation[self.keyframes[:, 0]] @ geometry.hat(self.world)
        return np.asarray(out / self.sigma_rad[:, None, None, None])

    def check(self, n_keyframes: int) -> None:
        """Raise ProblemError if shapes, indices or numbers are wrong."""
        n = len(self)
        _check_shapes(self, {"keyframes": (n, 1), "world": (n, 3), "body": (n, 3), "sigma_rad": (n,)})
        check_common(self, n_keyframes)


def root_information(covariance: FloatArray) -> FloatArray:
    """Return W, upper triangular, with ``W' W`` the inverse of covariances (n, m, m).

    From ``C = U U'`` with U upper triangular, ``W = U^-1``: the inverse of C, whose smallest eigenvalues rounding may
    have turned negative, is not made.
    """
    lower = np.linalg.cholesky(covariance[..., ::-1, ::-1])
    return np.asarray(np.tril(np.linalg.inv(lower))[..., ::-1, ::-1])


def _stepped(state: State, step: FloatArray) -> State:
    rotation, translation = parameterisation.retract("local", state.rotation, state.translation, step)
    return replace(state, rotation=rotation, translation=translation)


def _check_shapes(kind: PosePriors | Directions, shapes: dict[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        array = getattr(kind, name)
        if array.shape != shape:
            raise ProblemError(f"{name} of the factors ({type(kind).__name__}) has shape {array.shape}, not {shape}")
        if not np.isfinite(array).all():
            raise ProblemError(f"{name} of the factors ({type(kind).__name__}) is not finite")
