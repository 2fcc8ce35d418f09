# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Two ways to step a pose: local (on the rotation matrix) and global (on the rotation vector).

Local (4.1-4.19): ``R <- R Exp(dphi)``, ``t <- t + R dt``. With ``G = d residual / d x`` of a point x, the derivative is
``-G [x]x = rows x x G`` for dphi and ``G`` for dt: no trigonometry, and G is needed for the point anyway.

Global (3.26-3.28): ``phi <- phi + dphi``, ``t <- t + dt``; ``-G [x]x Jr(phi)`` and ``G R'``.
"""

from __future__ import annotations

from ba_node.arrays import FloatArray, IntArray
from ba_node.core import columns, geometry


def local_jacobian(d_point: FloatArray, point: FloatArray) -> FloatArray:
    """Return the derivative of residuals by a local step of the pose, (n, d, 6), from those by the points (n, d, 3)."""
    out = columns.empty(*d_point.shape[:2], 6)
    x, g = point[:, None, :], d_point
    out[..., 0] = x[..., 1] * g[..., 2] - x[..., 2] * g[..., 1]
    out[..., 1] = x[..., 2] * g[..., 0] - x[..., 0] * g[..., 2]
    out[..., 2] = x[..., 0] * g[..., 1] - x[..., 1] * g[..., 0]
    out[..., 3:] = g
    return out


def pose_jacobian(
    kind: str, d_point: FloatArray, point: FloatArray, rotation: FloatArray, row_pose: IntArray
) -> FloatArray:
    """Return the derivative of residuals by the step of their keyframe's pose.

    ``d_point`` (n, d, 3) is the derivative by the points in the world (n, 3), m; ``row_pose`` (n,) is the keyframe of
    each row, with rotations (n_kf, 3, 3) body from world.

    Returns:
        (n, d, 6): rotation, then translation.
    """
    out = local_jacobian(d_point, point)
    if kind != "local":
        jr = geometry.right_jacobian(geometry.so3_log(rotation))
        out[..., :3] = columns.product(out[..., :3], columns.take(jr, row_pose))
        out[..., 3:] = columns.product(d_point, columns.transposed(columns.take(rotation, row_pose)))
    return out


def retract(
    kind: str, rotation: FloatArray, translation: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return poses, (n, 3, 3) and (n, 3) m, after a step (n, 6): rotation (rad), then translation (m)."""
    if kind == "local":
        moved = translation + (rotation @ step[:, 3:, None])[..., 0]
        return rotation @ geometry.so3_exp(step[:, :3]), moved
    return geometry.so3_exp(geometry.so3_log(rotation) + step[:, :3]), translation + step[:, 3:]
