# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find out which way is up, to draw what is seen from above."""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.estimate import Poses

# A picture that is so many times as high as wide is turned.
_HIGH = 1.5
# A camera whose axis is this steep looks down; and the axes of one that looks along x, on a body of REP 103.
_DOWN = 0.7
_FORWARDS = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def upwards(poses: Poses, body_from_camera: FloatArray | None = None) -> FloatArray:
    """Return which way is up in the fixed frame of poses, (3,): cameras have y downwards, or look down themselves.

    ``body_from_camera`` (3, 3) are the axes of a camera on the body. Where they are not known the body is taken to go
    forwards: along z in optical axes, otherwise along x, with z upwards (REP 103).
    """
    if not len(poses):
        return np.array([0.0, 0.0, 1.0])
    body = geometry.matrix_from_quaternion(poses.orientation)
    steps = np.diff(poses.position, axis=0)[:, None, :]
    if body_from_camera is None:
        body_from_camera = np.eye(3) if np.argmax(_travelled(steps, body)) == 2 else _FORWARDS
    camera = body @ body_from_camera
    along = _travelled(steps, camera)
    optical = np.trace(body_from_camera) > 2.0
    # A body with axes of its own says where it looks; one with those of its camera moves across it where that is down.
    looks_down = 2.0 * along[2] < along[:2].min() if optical else body_from_camera[2, 2] < -_DOWN
    return np.asarray(-camera[:, :, 2 if looks_down else 1].mean(axis=0))


def seen_from(up: FloatArray) -> tuple[int, int, int]:
    """Return the axes to the right and upwards in a picture taken from a direction (3,), and the one along that.

    They are right-handed: the picture is not mirrored.
    """
    along = int(np.argmax(np.abs(up)))
    right, upwards_in_picture = (along + 1) % 3, (along + 2) % 3
    return (right, upwards_in_picture, along) if up[along] > 0.0 else (upwards_in_picture, right, along)


def page(up: FloatArray, paths: list[FloatArray]) -> tuple[int, int, bool]:
    """Return the axes to the right and upwards on a page that is wider than high, and whether the latter is reversed.

    A picture of paths (n, 3) from above that is much higher than wide is turned by a quarter.
    """
    right, upwards_in_picture, _ = seen_from(up)
    points = np.concatenate([np.zeros((0, 3)), *paths])
    width, height = np.ptp(points[:, [right, upwards_in_picture]], axis=0) if len(points) else (0.0, 0.0)
    return (upwards_in_picture, right, True) if height > _HIGH * width else (right, upwards_in_picture, False)


def _travelled(steps: FloatArray, axes: FloatArray) -> FloatArray:
    """Return how far steps (n - 1, 1, 3) go along the axes (n, 3, 3) that they begin with, (3,) m."""
    return np.asarray(np.abs(steps @ axes[:-1]).sum(axis=(0, 1)))
