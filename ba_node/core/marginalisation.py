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
directions in which the whole map moves there, and the prior tells nothing of them that
nothing told.
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core.marginal import MarginalPrior, triangular
from ba_node.core.problem import State
from ba_node.core.rows import Rows


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
    root, offset = triangular(dense[:, :-1][:, going], dense[:, :-1][:, np.repeat(touched, 6)], dense[:, -1])
    if not len(root):
        return None
    of = keyframes[touched]
    blocks = root.reshape(len(root), -1, 6).swapaxes(0, 1)
    return MarginalPrior(
        np.flatnonzero(touched[stays])[None], state.rotation[of], state.translation[of], blocks, offset
    )


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
