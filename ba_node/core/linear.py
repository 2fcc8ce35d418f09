# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve the reduced system: Cholesky, and conjugate gradients inside a trust region.

Both take a symmetric positive semi-definite operator and give a finite vector or say that they could not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from ba_node.arrays import FloatArray

Product = Callable[[FloatArray], FloatArray]


class Solution(NamedTuple):
    """What a linear solver found."""

    x: FloatArray | None  # (n,) the solution, None if there is none that is finite
    iterations: int = 0  # PCG steps; 0 with a direct solver
    on_boundary: bool = False  # True if it ends on the boundary of the trust region


def cholesky(matrix: FloatArray | scipy.sparse.spmatrix, rhs: FloatArray) -> Solution:
    """Solve ``A x = b`` for symmetric positive definite A, dense (written over) or sparse; no solution if A is not."""
    try:
        if scipy.sparse.issparse(matrix):
            x = sparse_factor(matrix).solve(rhs)
        else:
            # The transpose of a symmetric matrix in C order is the same matrix in LAPACK's order: no copy.
            factor = scipy.linalg.cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)
            x = scipy.linalg.cho_solve(factor, rhs, check_finite=False)
    except (np.linalg.LinAlgError, RuntimeError):
        return Solution(None)
    return Solution(x if np.isfinite(x).all() else None)


def sparse_factor(matrix: scipy.sparse.spmatrix) -> scipy.sparse.linalg.SuperLU:
    """Return the factor of a sparse, symmetric matrix; RuntimeError if it is singular."""
    return scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )


@dataclass(frozen=True)
class PcgLimits:
    """When conjugate gradients stop."""

    t_eps: float  # |r| <= min(t_eps, |b|) |b|
    max_iterations: int  # cap on steps
    radius: float = np.inf  # of the region
    # step i added less than q_eps / i of what the model b'x - x'A x / 2 has gained (Nash and Sofer 1990): further steps
    # would not lower the objective by what they cost. 0 for never.
    q_eps: float = 0.0
    # |r| is sqrt(r'M^-1 r) in place of the Euclidean norm. Where M is near A that is the error of x in energy: a weak
    # mode, of which next to nothing is in r, counts by what it is worth.
    energy: bool = False


def pcg_steihaug(product: Product, rhs: FloatArray, precondition: Product, limits: PcgLimits) -> Solution:
    """Solve ``A x = b`` inside ``|x| <= radius`` (Algorithms 1, 3 and 4).

    Stops when the residual is small, after the cap, on leaving the region (then on its boundary, along the current
    direction, 3.93), or on a direction without curvature: there the model falls without end, so it goes to the
    boundary, or without a region stays where it is.

    ``product`` is x -> A x, ``precondition`` r -> M^-1 r. The solution is never NaN.
    """
    x = np.zeros_like(rhs)
    r = rhs.copy()
    z = precondition(r)
    d = z.copy()
    rz = _dot(r, z)
    norm_b = _size(r, rz, limits)
    if norm_b == 0.0 or not np.isfinite(norm_b):
        return Solution(x if norm_b == 0.0 else None)
    target = min(limits.t_eps, norm_b) * norm_b
    gained = 0.0
    for j in range(limits.max_iterations):
        ad = product(d)
        curvature = _dot(d, ad)
        if not np.isfinite(curvature) or not np.isfinite(rz):
            return Solution(x if j else None, j)
        if curvature <= 0.0:
            return Solution(_to_boundary(x, d, limits.radius) if np.isfinite(limits.radius) else x, j, True)
        alpha = rz / curvature
        x_next = x + alpha * d
        if np.sqrt(_dot(x_next, x_next)) >= limits.radius:
            return Solution(_to_boundary(x, d, limits.radius), j + 1, True)
        x = x_next
        r = r - alpha * ad
        before, gained = gained, 0.5 * _dot(x, rhs + r)
        if (j + 1) * (gained - before) < limits.q_eps * gained:
            return Solution(x, j + 1)
        z = precondition(r)
        rz_next = _dot(r, z)
        if _size(r, rz_next, limits) <= target:
            return Solution(x, j + 1)
        d = z + (rz_next / rz) * d
        rz = rz_next
    return Solution(x, limits.max_iterations)


def _size(r: FloatArray, rz: float, limits: PcgLimits) -> float:
    """Return |r| as the limits want it, from r and r'M^-1 r."""
    return float(np.sqrt(max(rz, 0.0) if limits.energy else _dot(r, r)))


def _dot(a: FloatArray, b: FloatArray) -> float:
    """Return a'b, without BLAS: that shares long vectors among threads, and waits for cores that may be busy."""
    return float(np.einsum("i,i", a, b))


def _to_boundary(x: FloatArray, d: FloatArray, radius: float) -> FloatArray:
    """Return ``x + tau d`` with tau >= 0 and norm ``radius`` (3.93), free of cancellation."""
    a, b, c = float(d @ d), float(x @ d), float(x @ x) - radius * radius
    root = np.sqrt(max(b * b - a * c, 0.0))
    tau = -c / (b + root) if b > 0 else (root - b) / a
    result: FloatArray = x + tau * d
    return result * (radius / float(np.linalg.norm(result)))
