# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What reweighting does to the condition of C, B and S along the iterations, the thesis's last open question.

The matrices are those that a step inverts, damping included. ``plain`` says whether textbook algebra would have come
through: every block of C inverted as it stands, ``S = B - E C^-1 E'`` formed of the inverses, and factored by Cholesky.
The solver itself goes other ways (schur.py, blocks.py), and goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.core import scaling
from ba_node.core.numpy_kernels import NumpyKernels, NumpySystem
from ba_node.core.schur import block_diagonal
from ba_node.core.solver import solve
from ba_node.offline.solver_settings import solver_options
from experiments.thesis.problems import Posed
from experiments.thesis.variants import Cured, lone

FloatArray = NDArray[np.float64]

# What stands for a condition that is infinite, or lost in rounding.
WORST = 1e20
_WORST_OF = ("condition_c", "condition_b", "condition_b_scaled", "condition_s", "lone_points")


class Watched(NumpyKernels):
    """The kernels in numpy, and a row of metrics for every linear system."""

    rows: list[dict[str, float]]  # the metrics, by name

    def damp(self, kind: str, mu: float) -> NumpySystem:
        """Add damping and eliminate, as ever; look at what is inverted."""
        system = super().damp(kind, mu)
        (d_c, d_p), equations = self._damping, self._equations
        b = equations.b + d_c[:, :, None] * np.eye(self.size)
        c = equations.c + d_p[:, :, None] * np.eye(3)
        d = scaling.diagonals("inc", self.diagonals())[0]
        rows = np.any(self._linearisation.d_point != 0.0, axis=(1, 2))
        self.rows.append(
            {
                "condition_c": worst(c),
                "condition_b": worst(b),
                "condition_b_scaled": worst(b / (d[:, :, None] * d[:, None, :])),
                "condition_s": worst(system.dense()[None]),
                "lone_points": float(lone(self._objective.problem, self._linearisation).sum()),
                "active": float(np.mean(rows)),
                "plain": float(self._plain(b, c)),
            }
        )
        return system

    def _plain(self, b: FloatArray, c: FloatArray) -> bool:
        """Return True if textbook algebra gives S and its Cholesky factor."""
        try:
            inverse = block_diagonal(np.asarray(np.linalg.inv(c)))
            e = self._structure.edge_matrix(self._equations.e)
            s = (block_diagonal(b) - e @ inverse @ e.T).toarray()
            if not np.isfinite(s).all():
                return False
            np.linalg.cholesky(0.5 * (s + s.T))
        except np.linalg.LinAlgError:
            return False
        return True


class WatchedCure(Watched, Cured):
    """The same with the cure."""


def worst(blocks: FloatArray) -> float:
    """Return the largest condition number of blocks (n, d, d), at most WORST: the smallest eigenvalue may be lost."""
    values = np.linalg.eigvalsh(blocks)
    smallest, largest = values[:, 0], values[:, -1]
    good = smallest > largest / WORST
    return float(np.max(np.where(good, largest / np.where(good, smallest, 1.0), WORST), initial=1.0))


def conditions(posed: Posed, settings: Sequence[str], _clock: Callable[[], float]) -> dict[str, Any]:
    """Return metrics and curves of one solve.

    Args:
        posed: the problem.
        settings: method, number of iterations, ``cured`` or nothing, then options as of ``--set``.
    """
    method, iterations, cure, *assignments = settings
    options = solver_options(method, [*assignments, f"max_iterations={iterations}", "backend=numpy"])
    kernels = (WatchedCure if cure else Watched)(posed.problem, options)
    kernels.rows = []
    result = solve(posed.problem, options, kernels=kernels)
    rows = kernels.rows
    broken = [index for index, row in enumerate(rows, start=1) if not row["plain"]]
    # A solve that ends where it begins has no system to look at.
    found: dict[str, Any] = {name: max((row[name] for row in rows), default=None) for name in _WORST_OF}
    if rows:
        # The thesis tells what it is, not what it is at its worst.
        found["condition_b_scaled"] = float(np.median([row["condition_b_scaled"] for row in rows]))
    found |= {
        "first_break": float(broken[0]) if broken else None,
        "breaks": float(len(broken)),
        "solves": float(len(rows)),
        "objective": result.objective_after,
        "gradient": result.gradient_norm,
    }
    columns = {name: [row[name] for row in rows] for name in (*_WORST_OF, "active", "plain")}
    return {"figures": found, "data": {"conditions": columns}}
