# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve one damped, reduced system: by Cholesky, or by PCG in the scaled space inside the trust region (Algorithm 4).

In the scaled space ``x~ = D x`` (3.94-3.99) the system is ``D^-1 S D^-1 x~ = D^-1 rhs``; the region, the residual that
ends PCG, and the preconditioner all live there. Without a region D is that of the damping (Algorithm 7).
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ba_node.core import blocks, linear, scaling
from ba_node.core.kernels import DENSE_LIMIT, System
from ba_node.core.options import SolverOptions

FloatArray = NDArray[np.float64]

# A sparse matrix fuller than this share is factored as a dense one, up to so many entries (4.8 GB).
_DENSE_SHARE = 0.1
_DENSE_ENTRIES = 600_000_000


class ReducedSolver:
    """Solve the systems of one run."""

    def __init__(self, options: SolverOptions) -> None:
        """Keep the choices."""
        self._options = options

    def solve(self, system: System, hessian: tuple[FloatArray, FloatArray], radius: float) -> linear.Solution:
        """Return the solution of ``S x = rhs`` in the space that is not scaled.

        Args:
            system: damped.
            hessian: diag(B) and diag(C), not damped.
            radius: of the region, in the scaled space; infinite for none.
        """
        n = len(system.rhs)
        if n == 0:
            return linear.Solution(np.zeros(0))
        if self._by_cholesky(n):
            return linear.cholesky(_matrix(system), system.rhs)
        options = self._options
        scale = 1.0 / system.gather(*scaling.scaled_space(options.demands.space, hessian))
        limits = linear.PcgLimits(options.t_eps, options.max_linear_iterations, radius * system.radius_factor)
        precondition = preconditioner(options.preconditioner, system, scale)
        found = linear.pcg_steihaug(_scaled_product(system, scale), scale * system.rhs, precondition, limits)
        x = None if found.x is None else scale * found.x
        return linear.Solution(x, found.iterations, found.on_boundary)

    def _by_cholesky(self, n: int) -> bool:
        options = self._options
        if options.linear_solver == "auto":
            return options.trust_region == "none" and n <= DENSE_LIMIT
        return options.linear_solver == "cholesky"


def preconditioner(kind: str, system: System, scale: FloatArray) -> linear.Product:
    """Return ``r -> M^-1 r`` for the system scaled by ``scale`` = 1/D, (n,)."""
    if kind == "none":
        return lambda r: r
    parts = system.diagonal_blocks() if kind.startswith("schur") else system.own_blocks()
    if kind.endswith("diag"):
        diagonal = np.concatenate([np.diagonal(part, axis1=1, axis2=2).ravel() for part in parts]) * scale * scale
        inverse = np.where(diagonal > 0.0, 1.0 / np.where(diagonal > 0.0, diagonal, 1.0), 1.0)
        return lambda r: inverse * r
    bounds = np.cumsum([0] + [part.shape[0] * part.shape[1] for part in parts])
    spans = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
    inverses = []
    for part, span in zip(parts, spans, strict=True):
        s = scale[span].reshape(-1, part.shape[1])
        inverses.append(blocks.positive_inverses(part * s[:, :, None] * s[:, None, :]))

    def apply(r: FloatArray) -> FloatArray:
        pieces = [
            (inverse @ r[span].reshape(-1, inverse.shape[1], 1)).ravel()
            for inverse, span in zip(inverses, spans, strict=True)
        ]
        return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)

    return apply


def _scaled_product(system: System, scale: FloatArray) -> linear.Product:
    """Return x -> D^-1 S D^-1 x."""
    if len(scale) <= DENSE_LIMIT:
        matrix = system.dense()
        matrix *= scale[:, None]
        matrix *= scale
        return lambda x: np.asarray(matrix @ x)
    return lambda x: scale * system.product(scale * x)


def _matrix(system: System) -> FloatArray | scipy.sparse.spmatrix:
    """Return S in the form that is cheaper to factor."""
    if len(system.rhs) <= DENSE_LIMIT:
        return system.dense()
    matrix = system.sparse()
    n = len(system.rhs)
    if matrix.nnz > _DENSE_SHARE * n * n and n * n <= _DENSE_ENTRIES:
        return np.asarray(matrix.toarray())
    return matrix
