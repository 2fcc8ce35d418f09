# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say how precise the refined poses of a window are, in the order and frame of ROS.

The solver steps body from world, ``R <- R Exp(dphi)``, ``t <- t + R dt``. The pose of the body in the world is
``p = -R't`` with orientation ``R'``. To first order the same step moves and turns it by::

    dp = p x dphi - dt,    dtheta = -dphi        (orientation <- Exp(dtheta) orientation)

both along the axes of the world. So ``(dp, dtheta) = T (dphi, dt)``, and its covariance is ``T Sigma T'``, in the order
of geometry_msgs/PoseWithCovariance: x, y, z, rotation about X, Y, Z of the fixed frame.

Which covariance it is: of the free poses against those that the problem holds fixed (gauge.py), which count as exact.
In a window these are older keyframes, in a map that begins and in a solve of everything the oldest keyframe alone: then
it is along the whole path, and grows with the way travelled.

Scale that cannot be seen comes from the front-end's steps. Where they are factors, their noise is that of the scale.
Where they are not, they set it after the solve: ``f = sum L l - sum l^2 = 0`` for the lengths L of its steps and l of
the estimate's. The keyframes keep to it, ``sum (L - 2 l) dl = 0``; that is the condition handed on, and the scale of
the steps counts as exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import SolverOptions
from ba_node.core import covariance, geometry
from ba_node.core.problem import State
from ba_node.window import gauge
from ba_node.window.selection import Selection


@dataclass(frozen=True)
class Covariances:
    """Covariances of a problem's keyframes, and of its points where they were asked for."""

    # (n_kf, 6, 6): x, y, z (m), rotation about X, Y, Z (rad) of the fixed frame. NaN where unknown; 0 for fixed ones.
    poses: FloatArray
    points: FloatArray | None = None  # (n_pt, 3, 3), m^2; NaN where unknown


def covariances(
    selection: Selection, state: State, measured: FloatArray, options: SolverOptions, *, points: bool = False
) -> Covariances:
    """Return the covariance of every pose of a solved problem, and of every point if ``points``.

    ``measured`` (n_kf, 3) are the positions of the keyframes by the front-end, m; the state is in the scale of the map.
    """
    problem = selection.problem
    free = ~problem.fixed
    _, position = geometry.inverse(state.rotation, state.translation)
    floating = selection.unscaled if not problem.n_factors else np.full(len(free), -1)
    conditions = [
        _scale_condition(np.flatnonzero(floating == anchor), measured, position)
        for anchor in np.unique(floating[floating >= 0])
    ]
    stacked = np.stack(conditions, axis=2) if conditions else np.empty((len(free), 6, 0))
    poses = np.where(problem.fixed, 0.0, np.nan)[:, None, None] * np.ones((6, 6))
    found = covariance.uncertainty_of(problem, state, options, stacked[free])
    if found is None:
        return Covariances(poses, np.full((problem.n_points, 3, 3), np.nan) if points else None)
    poses[free] = in_world(found.poses(), position[free])
    return Covariances(poses, found.points(np.arange(problem.n_points)) if points else None)


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
