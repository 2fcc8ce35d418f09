# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations and rigid transforms, over arrays of them.

Tangent order of a pose everywhere in this package: rotation (3), then translation (3), then, where
they are free, f, k1, k2. Equation numbers are those of Qu, *Efficient Optimization for Robust Bundle
Adjustment* (TU Munich, 2018). Quaternions are x y z w, as in ROS.
"""

from __future__ import annotations

import numpy as np

from ba_node import native
from ba_node.arrays import FloatArray, IntArray

# Below this angle (rad) the closed forms lose digits to cancellation and their series are used.
_SMALL = 1e-4
# What rounding leaves of R'R - I, and much more: its square is below rounding.
_ROUNDED = 1e-8
# A path leaves every plane by more than this share of its extent.
_FLAT = 1e-6
_IDENTITY = np.eye(3)


def hat(v: FloatArray) -> FloatArray:
    """Return the matrix ``[v]x`` with ``[v]x w = v x w``: (..., 3) -> (..., 3, 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1] = -v[..., 2]
    out[..., 0, 2] = v[..., 1]
    out[..., 1, 0] = v[..., 2]
    out[..., 1, 2] = -v[..., 0]
    out[..., 2, 0] = -v[..., 1]
    out[..., 2, 1] = v[..., 0]
    return out


def so3_exp(phi: FloatArray) -> FloatArray:
    """Return the rotation of a rotation vector by Rodrigues' formula: (..., 3) rad -> (..., 3, 3)."""
    # As few functions of numpy as will do: the first call of each takes ten times as long as others.
    square = phi * phi
    angle2 = square[..., 0] + square[..., 1] + square[..., 2]
    a, b = _sinc_terms(angle2)
    # [v]x^2 = v v' - v'v I.
    out = hat(a[..., None] * phi)
    out += (b[..., None] * phi)[..., :, None] * phi[..., None, :]
    out.reshape(*phi.shape[:-1], 9)[..., ::4] += (1.0 - b * angle2)[..., None]
    return out


def so3_log(rotation: FloatArray) -> FloatArray:
    """Return the rotation vector of a rotation, angle in [0, pi]: (..., 3, 3) -> (..., 3) rad.

    Goes through the quaternion, whose vector part is exact near 0 and near pi alike.
    """
    q = quaternion_from_matrix(rotation)
    vector, w = q[..., :3], q[..., 3]
    norm = np.sqrt(np.add.reduce(vector * vector, axis=-1))
    angle = 2.0 * np.arctan2(norm, w)
    small = norm < _SMALL
    # 2 atan2(n, w) / n = 2/w (1 - (n/w)^2 / 3 + ...) near the identity, where w is near 1.
    series = 2.0 / np.where(small, w, 1.0) * (1.0 - (norm / np.where(small, w, 1.0)) ** 2 / 3.0)
    scale = np.where(small, series, angle / np.where(small, 1.0, norm))
    return np.asarray(vector * scale[..., None])


def right_jacobian(phi: FloatArray) -> FloatArray:
    """Return ``Jr`` with ``Exp(phi + d) = Exp(phi) Exp(Jr d) + O(d^2)`` (3.26): (..., 3) -> (..., 3, 3)."""
    angle2 = np.sum(phi * phi, axis=-1)
    b, c = _sinc_terms(angle2)[1], _third_term(angle2)
    k = hat(phi)
    return np.eye(3) - b[..., None, None] * k + c[..., None, None] * (k @ k)


def inverse_right_jacobian(phi: FloatArray) -> FloatArray:
    """Return ``Jr^-1``: ``Log(Exp(phi) Exp(d)) = phi + Jr^-1 d + O(d^2)``, |phi| up to pi: (..., 3) -> (..., 3, 3)."""
    angle2 = np.sum(phi * phi, axis=-1)
    half = 0.5 * np.sqrt(np.where(angle2 < _SMALL**2, 1.0, angle2))
    # (1 - t/2 cot(t/2)) / t^2
    series = 1.0 / 12.0 + angle2 / 720.0
    factor = np.where(angle2 < _SMALL**2, series, (1.0 - half * np.cos(half) / np.sin(half)) / (4.0 * half * half))
    k = hat(phi)
    return np.asarray(np.eye(3) + 0.5 * k + factor[..., None, None] * (k @ k))


def _sinc_terms(angle2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``sin(t)/t`` and ``(1 - cos t)/t^2`` for ``angle2 = t^2``."""
    # Neither loses digits however small t is, as long as it is not zero.
    t = np.sqrt(angle2 + 1e-300)
    # 2 sin^2(t/2) instead of 1 - cos t: no cancellation.
    half = np.sin(0.5 * t) / t
    return np.sin(t) / t, 2.0 * half * half


def _third_term(angle2: FloatArray) -> FloatArray:
    """Return ``(t - sin t) / t^3`` for ``angle2 = t^2``; by its series where the difference would cancel."""
    t2 = np.where(angle2 < _SMALL**2, 1.0, angle2)
    t = np.sqrt(t2)
    series = 1.0 / 6.0 - angle2 / 120.0 + angle2**2 / 5040.0 - angle2**3 / 362880.0
    result: FloatArray = np.where(angle2 < 0.09, series, (t - np.sin(t)) / (t2 * t))
    return result


def matrix_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Return the rotation of a quaternion x y z w, which need not be normalised: (..., 4) -> (..., 3, 3)."""
    if native.kernels is not None:
        return np.asarray(native.kernels.rotations(quaternion)).reshape(*quaternion.shape[:-1], 3, 3)
    q = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    x, y, z, w = (q[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(rotation: FloatArray) -> FloatArray:
    """Return the unit quaternion x y z w (w >= 0) of a rotation: (..., 3, 3) -> (..., 4).

    Shepperd's method: of the four equivalent formulas it takes, per matrix, the one with the largest
    divisor, so that no half turn loses digits.
    """
    if native.kernels is not None:
        return np.asarray(native.kernels.quaternions(rotation)).reshape(*rotation.shape[:-2], 4)
    r = rotation
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    squares = 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz
    last = a, b, c, squares[3]
    if (np.maximum(np.maximum(squares[0], squares[1]), squares[2]) < squares[3]).all():  # as of most rotations
        q = _side_by_side(last)
    else:
        d, e, f = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
        rows = (squares[0], d, e, a), (d, squares[1], f, b), (e, f, squares[2], c), last
        best = np.argmax(_side_by_side(squares), axis=-1)
        candidates = np.stack([_side_by_side(row) for row in rows], axis=-2)
        q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.sqrt(np.add.reduce(q * q, axis=-1, keepdims=True))
    result: FloatArray = np.where(q[..., 3:] < 0, -q, q)
    return result


def _side_by_side(columns: tuple[FloatArray, ...]) -> FloatArray:
    """Return arrays of one shape as the last axis of another: np.stack without its overhead."""
    out = np.empty((*columns[0].shape, len(columns)))
    for i, column in enumerate(columns):
        out[..., i] = column
    return out


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotation nearest to a matrix in the Frobenius norm: (..., 3, 3) -> (..., 3, 3).

    Of a rotation that is off by rounding alone one step of Newton's method finds it, ``R (3 I - R'R) / 2``, in a tenth
    of the time of a singular value decomposition.
    """
    off = _IDENTITY - np.swapaxes(matrix, -1, -2) @ matrix
    if np.abs(off).max(initial=0.0) <= _ROUNDED and (np.linalg.det(matrix) > 0.0).all():
        return np.asarray(matrix + 0.5 * (matrix @ off))
    u, _, vt = np.linalg.svd(matrix)
    sign = np.linalg.det(u @ vt)
    u[..., :, 2] *= sign[..., None]
    return np.asarray(u @ vt)


def inverse(rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the inverse of rigid transforms: (..., 3, 3) and (..., 3) -> the same."""
    back = np.swapaxes(rotation, -1, -2)
    return back, -(back @ translation[..., None])[..., 0]


def compose(
    rotation_a: FloatArray, translation_a: FloatArray, rotation_b: FloatArray, translation_b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the transform that applies ``b`` first, then ``a``."""
    return rotation_a @ rotation_b, (rotation_a @ translation_b[..., None])[..., 0] + translation_a


def steps_between(
    rotation: FloatArray, position: FloatArray, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the steps between poses (n, 3, 3), (n, 3) that are world from body: the second as the first sees it.

    ``first`` and ``second`` (m,) are numbers of poses; returned are turns (m, 3, 3) and moves (m, 3).
    """
    if native.kernels is not None:
        found: tuple[FloatArray, FloatArray] = native.kernels.steps_between(rotation, position, first, second)
        return found
    back = np.swapaxes(rotation[first], 1, 2)
    moved = (position[second] - position[first])[:, :, None]
    return back @ rotation[second], (back @ moved)[..., 0]


def is_planar(position: FloatArray) -> bool:
    """Return True if positions (n, 3) m lie in a plane, as those of odometry that leaves out all else; no body's do."""
    extent = np.linalg.svd(position - position[:1], compute_uv=False)
    return len(extent) < 3 or bool(extent[2] <= _FLAT * extent[0])
