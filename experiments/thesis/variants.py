# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels that do something otherwise than the solver's own: what the thesis did, or what might cure it.

They serve experiments alone (``Run.kernels``); all in numpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ba_node.core import linear, scaling
from ba_node.core.numpy_kernels import NumpyKernels, NumpySystem
from ba_node.core.objective import Linearisation
from ba_node.core.problem import Problem, State
from ba_node.core.schur import normal_equations

FloatArray = NDArray[np.float64]

# Least mu of the cure, with D = diag(H): what is still damped where H determines nothing.
MU_FLOOR = 1e-8


class UnscaledPreconditioner(NumpyKernels):
    """M is made of S as it stands, while PCG works on ``D^-1 S D^-1``: lines 4 and 5 of Algorithm 4 to the letter."""

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> NumpySystem:
        """Return the system; its diagonal blocks come out as those of S after the solver has scaled them."""
        system = super().reduce(damping_c, damping_p)
        d = system.gather(*scaling.scaled_space(self._options.scaled_space, self.diagonals()))
        for name in ("diagonal_blocks", "own_blocks"):
            parts = _multiplied(getattr(system, name)(), d)
            setattr(system, name, lambda parts=parts: parts)
        return system


class Cured(NumpyKernels):
    """Points with fewer than two observations of any weight leave the equations, and mu has a floor."""

    def linearise(self, state: State) -> float:
        """Linearise without the rows of points that less than two observations hold."""
        value = super().linearise(state)
        lin = self._linearisation
        kept = ~lone(self._objective.problem, lin)[self._objective.problem.observations.point]
        self._linearisation = Linearisation(
            lin.objective,
            lin.residual * kept[:, None],
            lin.d_keyframe * kept[:, None, None],
            lin.d_point * kept[:, None, None],
        )
        self._equations = normal_equations(self._structure, self._linearisation)
        self.gradient_norm = self._equations.gradient_norm
        return value

    def damp(self, kind: str, mu: float) -> NumpySystem:
        """Damp by no less than the floor."""
        return super().damp(kind, max(mu, MU_FLOOR))


class SharedIntrinsics(NumpyKernels):
    """All images have one f, k1 and k2: their steps are tied, ``pc = P q``, and ``P'S P q = P'rhs`` is solved instead.

    They must be equal at the start, all keyframes free, and the solver a dense one.
    """

    def reduce(self, damping_c: FloatArray, damping_p: FloatArray) -> NumpySystem:
        """Return the system; its dense solution has equal steps of the intrinsics."""
        system = super().reduce(damping_c, damping_p)
        n, size = self.n_free, self.size
        tie = np.zeros((n, size, 6 * n + 3))
        index = np.arange(n)
        for j in range(6):
            tie[index, j, 6 * index + j] = 1.0
        tie[:, 6:, 6 * n :] = np.eye(3)
        p = tie.reshape(n * size, -1)

        def solve_dense() -> FloatArray | None:
            q = linear.cholesky(p.T @ system.dense() @ p, p.T @ system.rhs).x
            return None if q is None else p @ q

        system.solve_dense = solve_dense  # type: ignore[method-assign]
        return system


def lone(problem: Problem, lin: Linearisation) -> NDArray[np.bool_]:
    """Return which points (n_points,) fewer than two observations hold: all others have lost their weight."""
    active = np.any(lin.d_point != 0.0, axis=(1, 2))
    return np.bincount(problem.observations.point[active], minlength=problem.n_points) < 2


def _multiplied(parts: tuple[FloatArray, ...], d: FloatArray) -> tuple[FloatArray, ...]:
    """Return blocks (n, d, d) with rows and columns multiplied by what belongs to them."""
    out, begin = [], 0
    for part in parts:
        end = begin + part.shape[0] * part.shape[1]
        own = d[begin:end].reshape(part.shape[:2])
        out.append(part * own[:, :, None] * own[:, None, :])
        begin = end
    return tuple(out)


VARIANTS: dict[str, type[NumpyKernels]] = {
    "unscaled M": UnscaledPreconditioner,
    "cured": Cured,
    "shared intrinsics": SharedIntrinsics,
}
