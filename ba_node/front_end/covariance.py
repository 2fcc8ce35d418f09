# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say how sure poses are: of an image that was tracked, of one that was not, and of a step that an odometry made.

All are (6, 6) in ROS's order, x, y, z (m) and turns about X, Y, Z (rad).
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.estimate import Transform

# While lost, the pose is off by at least so much with each image: m, rad.
_LOST_M, _LOST_RAD = 0.1, 0.05
# Steps of an odometry, along them and across them as a share of their length, and at rest, m; turns for each metre and
# at rest, rad. Only the odometry tells one camera a length. What images see of it are far points that hardly move: a
# tenth of a pixel by which all are off is a drift of per cents, which so many points seem to be sure of. So lengths are
# those of the odometry, and directions and turns those of the images.
_ALONG, _ACROSS, _AT_REST_M = 0.001, 0.01, 0.0005
_TURN_PER_M, _TURN = 0.003, 0.001


def of_lost(images: int) -> FloatArray:
    """Return that of a pose, or of the step to it, after so many images without one."""
    return np.diag([_LOST_M**2] * 3 + [_LOST_RAD**2] * 3) * (1.0 + images) ** 2


def of_step(step: Transform) -> FloatArray:
    """Return that of a step by odometry, body before from body now, in the axes of the body before."""
    length = float(np.linalg.norm(step.translation))
    along = np.outer(step.translation, step.translation) / max(length, 1e-12) ** 2
    result = np.eye(6) * (_TURN + _TURN_PER_M * length) ** 2
    result[:3, :3] = (_AT_REST_M + _ACROSS * length) ** 2 * (np.eye(3) - along)
    result[:3, :3] += (_AT_REST_M + _ALONG * length) ** 2 * along
    return result


def of_tracked(found: FloatArray, fixed_from_camera: FloatArray) -> FloatArray:
    """Return that of an image in the fixed frame, of its covariance of turn and place in the camera's."""
    order = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
    R = np.kron(np.eye(2), fixed_from_camera)
    return np.asarray(R @ found[order] @ R.T)
