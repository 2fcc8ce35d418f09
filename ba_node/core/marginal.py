# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The prior that keyframes and points leave behind on the keyframes that saw them too; marginalisation.py makes it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import geometry
from ba_node.core.factors import check_common
from ba_node.core.problem import State


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
        root, offset = triangular(flat[:, ~stays].reshape(m, -1), flat[:, stays].reshape(m, -1), self.offset)
        parts = root.reshape(len(root), -1, 6).swapaxes(0, 1)
        return MarginalPrior(numbers[None], self.rotation[stays], self.translation[stays], parts, offset)


def triangular(going: FloatArray, staying: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R_kk and z_k of the QR decomposition of [J_g, J_k, r]; rows that nothing of k is in are left out."""
    stacked: FloatArray = np.column_stack([going, staying, residual])
    r: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))[going.shape[1] :, going.shape[1] :]
    told = np.abs(r[:, :-1]).max(axis=1, initial=0.0) > 0.0
    return r[told, :-1], r[told, -1]
