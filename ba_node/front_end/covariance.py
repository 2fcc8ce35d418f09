# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say how sure poses are: of an image that was tracked, of one that was not, and of a step that an odometry made.

All are (6, 6) in ROS's order, x, y, z (m) and turns about X, Y, Z (rad).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.estimate import Transform

# While lost, the pose is off by at least so much with each image: m, rad.
_LOST_M, _LOST_RAD = 0.1, 0.05
# Steps of an odometry, along them and across them as a share of their length, and at rest, m; turns for each metre and
# at rest, rad. Only the odometry tells one camera a length. What images see of it are far points that hardly move: a
# tenth of a pixel by which all are off is a drift of per cents, which so many points seem to be sure of. So lengths are
# those of the odometry, but for what scatters from step to step, and directions and turns those of the images.
_ALONG, _ACROSS, _AT_REST_M = 0.001, 0.01, 0.0005
_TURN_PER_M, _TURN = 0.003, 0.001
# Steps of an odometry that tell how its lengths scatter, at most and at least; the share that they are taken to scatter
# by until then, as the first steps would set the scale of all; and what images make of lengths that are true.
_STEPS, _FEWEST, _UNKNOWN, _BY_IMAGES = 30, 8, 0.02, 0.004


class Lengths:
    """Learn how the lengths of an odometry's steps scatter, beside those that images see."""

    def __init__(self) -> None:
        self._off: deque[float] = deque(maxlen=_STEPS)  # shares by which the latest differ

    def compare(self, before: Transform, told: Transform, by_images: Transform) -> None:
        """Take a step to a keyframe: camera from map at the one before, as the odometry has it and as images do."""
        start, end = before.inverse().translation, told.inverse().translation
        step, off = end - start, by_images.inverse().translation - end
        if step.any():
            self._off.append(float(off @ step / (step @ step)))

    @property
    def noise(self) -> float:
        """Return the standard deviation of lengths, as a share, beyond what images are unsure by."""
        if len(self._off) < _FEWEST:
            return _UNKNOWN
        # What all differ by alike, as points far away make images err, tells nothing of the odometry.
        spread = 1.48 * float(np.median(np.abs(np.array(self._off) - np.median(self._off))))
        return float(np.sqrt(max(spread**2 - _BY_IMAGES**2, 0.0)))


def of_lost(images: int) -> FloatArray:
    """Return that of a pose, or of the step to it, after so many images without one."""
    return np.diag([_LOST_M**2] * 3 + [_LOST_RAD**2] * 3) * (1.0 + images) ** 2


def of_step(step: Transform, length_noise: float) -> FloatArray:
    """Return that of a step by odometry, body before from body now, in the axes of the body before.

    ``length_noise`` is what the steps' lengths are seen to scatter by, as a share.
    """
    length = float(np.linalg.norm(step.translation))
    along = np.outer(step.translation, step.translation) / max(length, 1e-12) ** 2
    result = np.eye(6) * (_TURN + _TURN_PER_M * length) ** 2
    result[:3, :3] = (_AT_REST_M + _ACROSS * length) ** 2 * (np.eye(3) - along)
    result[:3, :3] += (_AT_REST_M + np.hypot(_ALONG, length_noise) * length) ** 2 * along
    return result


def of_tracked(found: FloatArray, fixed_from_camera: FloatArray) -> FloatArray:
    """Return that of an image in the fixed frame, of its covariance of turn and place in the camera's."""
    order = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
    R = np.kron(np.eye(2), fixed_from_camera)
    return np.asarray(R @ found[order] @ R.T)
