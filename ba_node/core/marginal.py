# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is left of keyframes and points that are taken out of a problem: a prior on the keyframes that saw them too.

Square-root marginalisation (Demmel et al., *Square Root Marginalization for Sliding-Window Bundle Adjustment*, ICCV
2021; the null-space projection of Mourikis and Roumeliotis, ICRA 2007). Of the rows ``r + J_p dp + J_g dg + J_k dk``,
weighted, that a point p, keyframes g that go and keyframes k that stay share, the part that depends on dp is taken out
by the rows Q_2 of ``J_p = Q_1 R``, then that on dg by another QR decomposition of what is left of all points::

    [Q_2' J_g, Q_2' J_k, Q_2' r] = Q [R_gg R_gk z_g; 0 R_kk z_k],    prior  1/2 |z_k + R_kk delta_k|^2

``H`` is never formed, so that no digits are lost, and the rank stays what it is. delta_k is the local step from the
pose at which the rows were linearised, for good (first-estimate Jacobians, Huang et al., IJRR 2010): J annihilates the
directions in which the whole map moves (:func:`gauge_directions`) there, and the prior tells nothing of them that
nothing told.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import geometry
from ba_node.core.factors import check_common
from ba_node.core.problem import State

if TYPE_CHECKING:
    from ba_node.core.rows import Rows


@dataclass(frozen=True)
class MarginalPrior:
    """One factor on k keyframes, with m residuals ``offset + sum_k root_k delta_k``."""

    keyframes: IntArray  # (1, k)
    rotation: FloatArray  # (k, 3, 3) body from world where it was linearised
    translation: FloatArray  # (k, 3) m
    root: FloatArray  # (k, m, 6)
    offset: FloatArray  # (m,)
    loss: str = "squared"
    loss_scale: float = 1.0
    # (3,) of the world of the problem in that in which the prior was linearised, m; None for the same one
    origin: FloatArray | None = None

    def residuals(self, state: State) -> FloatArray:
        """Return the residuals, (1, m)."""
        return np.asarray(self.offset + np.einsum("kmi,ki->m", self.root, self._delta(state)))[None]

    def jacobians(self, state: State) -> FloatArray:
        """Return their derivatives by the local steps, (1, k, m, 6)."""
        of = self.keyframes[0]
        turn = np.zeros((len(of), 6, 6))
        turn[:, :3, :3] = geometry.inverse_right_jacobian(self._delta(state)[:, :3])
        turn[:, 3:, 3:] = np.swapaxes(self.rotation, 1, 2) @ state.rotation[of]
        if self.origin is not None:
            # With t' = t + R o the step of t is dt' - dphi x o.
            turn[:, 3:, :3] = turn[:, 3:, 3:] @ geometry.hat(self.origin[None])
        return np.asarray(self.root @ turn)[None]

    def check(self, n_keyframes: int) -> None:
        """Raise ProblemError if indices are wrong."""
        check_common(self, n_keyframes)

    def _delta(self, state: State) -> FloatArray:
        """Return the steps (k, 6) from where it was linearised."""
        of = self.keyframes[0]
        back = np.swapaxes(self.rotation, 1, 2)
        turn = geometry.so3_log(back @ state.rotation[of])
        translation = state.translation[of]
        if self.origin is not None:
            translation = translation - state.rotation[of] @ self.origin
        moved = (back @ (translation - self.translation)[:, :, None])[..., 0]
        return np.concatenate([turn, moved], axis=1)

    def moved(self, origin: FloatArray) -> MarginalPrior:
        """Return the same for a world whose origin is at (3,) m of the one in which the prior was linearised."""
        return replace(self, origin=origin)

    def kept(self, stays: BoolArray, numbers: IntArray) -> MarginalPrior | None:
        """Return the prior of the keyframes that stay (k,), the others taken out; ``numbers`` are their new indices."""
        if not stays.any():
            return None
        m = self.root.shape[1]
        flat = np.swapaxes(self.root, 0, 1)
        root, offset = _triangular(flat[:, ~stays].reshape(m, -1), flat[:, stays].reshape(m, -1), self.offset)
        parts = root.reshape(len(root), -1, 6).swapaxes(0, 1)
        return MarginalPrior(numbers[None], self.rotation[stays], self.translation[stays], parts, offset)


def marginalise(rows: Rows, state: State, keyframes: IntArray, stays: BoolArray) -> MarginalPrior | None:
    """Return what rows tell of the keyframes that stay, with points and all other keyframes taken out.

    Args:
        rows: at a state, all that is to be absorbed; ``keyframes`` (n_free,) are the indices of its keyframes.
        state: that of the rows.
        keyframes: indices in the state.
        stays: (n_free,) those that stay.

    Returns:
        The prior, with ``keyframes`` 0 to k - 1 for those that stay; None if nothing is told of any.
    """
    seen = np.diff(rows.keyframes.tocsc().indptr).reshape(-1, 6).any(axis=1)
    touched = stays & seen
    if not touched.any():
        return None
    dense = _without_points(rows)
    going = np.repeat(seen & ~stays, 6)
    root, offset = _triangular(dense[:, :-1][:, going], dense[:, :-1][:, np.repeat(touched, 6)], dense[:, -1])
    if not len(root):
        return None
    of = keyframes[touched]
    blocks = root.reshape(len(root), -1, 6).swapaxes(0, 1)
    return MarginalPrior(
        np.flatnonzero(touched[stays])[None], state.rotation[of], state.translation[of], blocks, offset
    )


def gauge_directions(state: State) -> FloatArray:
    """Return the local steps (n_kf, 6, 7) of all keyframes with which the world turns, moves and grows."""
    n = len(state.translation)
    out = np.zeros((n, 6, 7))
    out[:, :3, :3] = np.eye(3)
    out[:, 3:, 3:6] = np.eye(3)
    out[:, 3:, 6] = (np.swapaxes(state.rotation, 1, 2) @ state.translation[:, :, None])[..., 0]
    return out


def _without_points(rows: Rows) -> FloatArray:
    """Return the weighted rows [J_c, r] (m', n + 1) of which the points are projected out."""
    scale = np.sqrt(rows.weight)
    dense = np.column_stack([rows.keyframes.toarray(), rows.residual]) * scale[:, None]
    of_points = rows.points.tocsr()
    entries = np.diff(of_points.indptr)
    point = np.full(len(rows), -1)
    point[entries > 0] = of_points.indices[of_points.indptr[:-1][entries > 0]] // 3
    parts = [dense[point < 0]]
    order = np.argsort(point, kind="stable")
    order = order[point[order] >= 0]
    starts = np.flatnonzero(np.diff(point[order], prepend=-1))
    counts = np.diff(np.append(starts, len(order)))
    jacobian = np.zeros((len(rows), 3))
    jacobian[entries > 0] = of_points.data.reshape(-1, 3)
    jacobian *= scale[:, None]
    for count in np.unique(counts[counts > 3]):
        of = order[starts[counts == count][:, None] + np.arange(count)]
        q = np.linalg.qr(jacobian[of], mode="complete")[0][:, :, 3:]
        parts.append((np.swapaxes(q, 1, 2) @ dense[of]).reshape(-1, dense.shape[1]))
    return np.concatenate(parts)


def _triangular(going: FloatArray, staying: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R_kk and z_k of the QR decomposition of [J_g, J_k, r]; rows that nothing of k is in are left out."""
    stacked: FloatArray = np.column_stack([going, staying, residual])
    r: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))[going.shape[1] :, going.shape[1] :]
    told = np.abs(r[:, :-1]).max(axis=1, initial=0.0) > 0.0
    return r[told, :-1], r[told, -1]
