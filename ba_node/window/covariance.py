# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say how precise the refined poses of a window are, in the order and frame of ROS.

The solver steps body from world, ``R <- R Exp(dphi)``, ``t <- t + R dt``. The pose of the body in the world is
``p = -R't`` with orientation ``R'``. To first order the same step moves and turns it by::

    dp = p x dphi - dt,    dtheta = -dphi        (orientation <- Exp(dtheta) orientation)

both along the axes of the world. So ``(dp, dtheta) = T (dphi, dt)``, and its covariance is ``T Sigma T'``, in the order
of geometry_msgs/PoseWithCovariance: x, y, z, rotation about X, Y, Z of the fixed frame.

What the covariance is relative to is what the window holds (gauge.py): fixed keyframes count as exact. Where scale
floats, it is the front-end's steps that set it, after the solve: ``f = sum L l - sum l^2 = 0`` for the lengths L of its
steps and l of the estimate's. The keyframes keep to it, ``sum (L - 2 l) dl = 0``; that is the condition handed on.
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import SolverOptions
from ba_node.core import covariance, geometry
from ba_node.core.problem import State
from ba_node.window import gauge
from ba_node.window.selection import Selection


def covariances(selection: Selection, state: State, measured: FloatArray, options: SolverOptions) -> FloatArray:
    """Return the covariance of every pose of a window's problem.

    ``measured`` (n_kf, 3) are the positions of the keyframes by the front-end, m; the state is in the scale of the map.

    Returns:
        (n_kf, 6, 6): x, y, z (m), rotation about X, Y, Z (rad) of the fixed frame. NaN where unknown; 0 for fixed ones.
    """
    free = ~selection.problem.fixed
    _, position = geometry.inverse(state.rotation, state.translation)
    conditions = [
        _scale_condition(np.flatnonzero(selection.unscaled == anchor), measured, position)
        for anchor in np.unique(selection.unscaled[selection.unscaled >= 0])
    ]
    stacked = np.stack(conditions, axis=2) if conditions else np.empty((len(free), 6, 0))
    out = np.zeros((len(free), 6, 6))
    tangent = covariance.pose_covariances(selection.problem, state, options, stacked[free])
    out[free] = in_world(tangent, position[free])
    return out


def in_world(tangent: FloatArray, position: FloatArray) -> FloatArray:
    """Return ``T Sigma T'``.

    Args:
        tangent: (n, 6, 6) covariance of the local step of body from world: rotation, translation.
        position: (n, 3) of the body in the world, m.

    Returns:
        (n, 6, 6) of position, then rotation, along the axes of the world.
    """
    turn = np.zeros((len(position), 6, 6))
    turn[:, :3, :3] = geometry.hat(position)
    turn[:, :3, 3:] = -np.eye(3)
    turn[:, 3:, :3] = -np.eye(3)
    out = turn @ tangent @ np.swapaxes(turn, 1, 2)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


def _scale_condition(members: IntArray, measured: FloatArray, position: FloatArray) -> FloatArray:
    """Return g (n_kf, 6): the derivative of ``f`` by the step of each keyframe of a part whose scale floats."""
    by_position = np.zeros_like(position)
    steps = np.diff(position[members], axis=0)
    length = np.linalg.norm(steps, axis=1)
    wanted = np.linalg.norm(np.diff(measured[members], axis=0), axis=1)
    wanted = np.where(gauge.agreeing_steps(wanted, length), wanted, 2.0 * length)
    along = steps * ((wanted - 2.0 * length) / np.where(length > 0.0, length, 1.0))[:, None]
    np.add.at(by_position, members[1:], along)
    np.subtract.at(by_position, members[:-1], along)
    return np.concatenate([-np.cross(position, by_position), -by_position], axis=1)
