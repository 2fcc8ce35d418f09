# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Estimate the relative pose of two images from the rays that they share, and tell how well a pose explains them.

With ``x_b = R x_a + t`` every pair of rays fulfils ``b' [t]x R a = 0``. Its residual is Sampson's distance, in units of
the rays. OpenCV gives the essential matrix by consensus of samples (USAC, one thread, fixed seed), which a robust
Gauss-Newton then refines; so the same tracks give the same numbers.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ba_node.arrays import BoolArray, FloatArray
from ba_node.core import geometry
from ba_node.kept import kept_property

# Fewest pairs of rays that an estimate is made from, and that must agree with it.
MIN_PAIRS = 20
_MIN_AGREE = 15
_CONFIDENCE = 0.9999
# Steps of a refinement, and the last of them, rad.
_REFINEMENTS, _STEP = 8, 1e-7


def available() -> bool:
    """Return True where OpenCV is installed."""
    return importlib.util.find_spec("cv2") is not None


@cache
def _opencv() -> Any:
    import cv2  # noqa: PLC0415  # slow to import, and may be missing

    return cv2


@dataclass(frozen=True)
class Pair:
    """Rays that two images share: (n, 2) each; and the residual up to which they agree with a pose."""

    a: FloatArray
    b: FloatArray
    gate: float

    def __len__(self) -> int:
        return len(self.a)

    @kept_property
    def homogeneous(self) -> tuple[FloatArray, FloatArray]:
        """Return the rays as (X/Z, Y/Z, 1): (n, 3) each."""
        one = np.ones((len(self), 1))
        return np.concatenate([self.a, one], axis=1), np.concatenate([self.b, one], axis=1)

    def zoomed(self, factor: float) -> Pair:
        """Return what it is if the focal length of b was given too long by a factor."""
        return Pair(self.a, self.b * factor, 0.5 * (1.0 + factor) * self.gate)

    def shifted(self, by: FloatArray) -> Pair:
        """Return what it is if the rays of b were off by (2,)."""
        return Pair(self.a, self.b - by, self.gate)


@dataclass(frozen=True)
class Pose:
    """``x_b = R x_a + t``, t of unit length where only its direction is known."""

    rotation: FloatArray  # (3, 3)
    translation: FloatArray  # (3,)

    def turned_from(self, other: Pose) -> float:
        """Return the angle between two rotations, degrees."""
        return float(np.degrees(np.linalg.norm(geometry.so3_log(self.rotation @ other.rotation.T))))

    def direction_from(self, other: Pose) -> float:
        """Return the angle between two translations, degrees; NaN if one is zero."""
        length = np.linalg.norm(self.translation) * np.linalg.norm(other.translation)
        if not length > 0.0:
            return float("nan")
        return float(np.degrees(np.arccos(np.clip(self.translation @ other.translation / length, -1.0, 1.0))))


def residuals(pair: Pair, pose: Pose) -> FloatArray:
    """Return Sampson's distance of each pair of rays, (n,), signed."""
    length = np.linalg.norm(pose.translation)
    return _sampson(pair, (geometry.hat(pose.translation / (length or 1.0)) @ pose.rotation)[None])[0][:, 0]


def _sampson(pair: Pair, essential: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Sampson's distances and their derivatives in some directions.

    ``b'E a / sqrt(s)``, where s is the sum of the squares of the first two of E a and of E'b. ``essential`` (k, 3, 3)
    is E and by how much it changes in each direction; the result is (n, 1) and (n, k - 1).
    """
    a, b, shape = *pair.homogeneous, (len(pair), len(essential), 3)
    line_b = (a @ essential.reshape(-1, 3).T).reshape(shape)
    line_a = (b @ essential.transpose(1, 0, 2).reshape(3, -1)).reshape(shape)
    meets = (line_b @ b[:, :, None])[..., 0]
    slopes = np.concatenate([line_b[..., :2], line_a[..., :2]], axis=2)
    slopes = np.maximum((slopes @ slopes[:, 0, :, None])[..., 0], [[1e-300] + [-np.inf] * (len(essential) - 1)])
    meets /= np.sqrt(slopes[:, :1])
    return meets[:, :1], meets[:, 1:] - meets[:, :1] * slopes[:, 1:] / slopes[:, :1]


def depths(pair: Pair, pose: Pose) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where rays meet: depth in a and in b, in units of the translation, and the parallax, rad; (n,) each."""
    a, b = pair.homogeneous
    a = a @ pose.rotation.T
    cross = _cross(b, a)
    squared = np.maximum((cross * cross).sum(axis=1), 1e-300)
    in_a = -(_cross(b, pose.translation) * cross).sum(axis=1) / squared
    in_b = -(_cross(a, pose.translation) * cross).sum(axis=1) / squared
    parallax = np.sqrt(squared / ((a * a).sum(axis=1) * (b * b).sum(axis=1)))
    return in_a, in_b, parallax


def explained(pair: Pair, pose: Pose) -> BoolArray:
    """Return which pairs of rays agree with a pose: they meet, and not behind a camera (unless too far to tell)."""
    in_a, in_b, parallax = depths(pair, pose)
    in_front = ((in_a > 0.0) & (in_b > 0.0)) | (parallax < pair.gate)
    return np.asarray((np.abs(residuals(pair, pose)) < pair.gate) & in_front)


def share(pair: Pair, pose: Pose) -> float:
    """Return the share of the pairs of rays that agree with a pose."""
    return float(explained(pair, pose).mean()) if len(pair) else 0.0


def estimate(pair: Pair) -> Pose | None:
    """Return the pose that most pairs of rays agree with, None if there are too few."""
    if len(pair) < MIN_PAIRS:
        return None
    cv2 = _opencv()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        essential, _ = cv2.findEssentialMat(
            pair.a, pair.b, np.eye(3), method=cv2.USAC_DEFAULT, prob=_CONFIDENCE, threshold=pair.gate
        )
    except cv2.error:
        return None
    finally:
        cv2.setNumThreads(threads)
    if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
        return None
    first, second, translation = cv2.decomposeEssentialMat(essential)
    found = [Pose(turn, sign * translation[:, 0]) for turn in (first, second) for sign in (1.0, -1.0)]
    pose = refined(pair, max(found, key=lambda one: share(pair, one)))
    return pose if np.count_nonzero(explained(pair, pose)) >= _MIN_AGREE else None


def refined(pair: Pair, pose: Pose, free: int = 5) -> Pose:
    """Return the pose with the least Cauchy sum of residuals near one.

    ``free`` is 5 for rotation and direction of the translation, 3 for the rotation alone.
    """
    rotation, direction = pose.rotation, pose.translation / np.linalg.norm(pose.translation)
    scale = 0.4 * pair.gate
    for _ in range(_REFINEMENTS):
        across = np.linalg.svd(direction[None])[2][1:]
        turned = geometry.hat(direction) @ geometry.hat(np.eye(3)) @ rotation
        essential = np.concatenate(
            [(geometry.hat(direction) @ rotation)[None], turned, geometry.hat(across) @ rotation]
        )
        now, jacobian = _sampson(pair, essential[: 1 + free])
        weighted = jacobian / (1.0 + (now / scale) ** 2)
        normal = jacobian.T @ weighted
        normal += (1e-9 * np.trace(normal) + 1e-300) * np.eye(free)
        step = np.asarray(np.linalg.solve(normal, -weighted.T @ now[:, 0]), float)
        step *= min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-300))
        rotation, direction = geometry.so3_exp(step[:3]) @ rotation, direction + step[3:] @ across[: free - 3]
        direction /= np.linalg.norm(direction)
        if np.linalg.norm(step) < _STEP:
            break
    return Pose(geometry.nearest_rotation(rotation), direction)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product; that of numpy takes three times as long."""
    turned = [1, 2, 0]
    return (a * b[..., turned] - a[..., turned] * b)[..., turned]
