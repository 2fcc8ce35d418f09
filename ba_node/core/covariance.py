# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""How well a solution is determined: the covariance of every free pose.

At the minimum the errors of the unknowns are, to first order, ``-H^-1 J' W e`` for noise e of the residuals, so their
covariance is ``sigma^2 H^-1`` with the undamped ``H = J' W J``. Its keyframe part is the inverse of the Schur
complement of the points (3.64-3.67), which is small::

    Sigma_c = sigma^2 S^-1,    S = B - E C^-1 E',    sigma^2 = r' W r / (m - n)

W are the IRLS weights of the losses at the solution, m the rows of residuals and n the unknowns: sigma^2 is the
a-posteriori variance of unit weight, near 1 where sigma_px is right. So uncertain points count (they are integrated
out); factors count in S and in both sums like all else, and everything is relative to what the problem holds fixed.

Where a condition ``g'x = 0`` on the step of all keyframes fixes scale, and not a fixed pose, S is inverted on the
directions that the condition leaves: with an orthonormal basis Q of them, ``S^-1 -> Q (Q' S Q)^-1 Q'``.

A lower bound is had at once: the inverse of a keyframe's own block of S is its covariance with all other keyframes held
exact, hence that of its steps to them. It costs one elimination more, and tells which keyframe hangs loose.

A direction that nothing determines has no variance. Keyframes that take part in such a direction are unknown (NaN); the
others keep theirs. S is scaled to a unit diagonal first, so that units do not decide what is rounding.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy

from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import geometry, native_kernels
from ba_node.core.kernels import DENSE_LIMIT, Kernels
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem, State

# Eigenvalues of S, scaled to a unit diagonal, that are rounding.
_ROUNDING = 1e-11
# A keyframe with a larger share (unit vector) in an undetermined direction is unknown itself.
_SHARE = 1e-4
# So many of the last poses are looked at for the weakest: of the newest keyframes, where these are oldest first.
_NEWEST = 5


def pose_covariances(problem: Problem, state: State, options: SolverOptions, conditions: FloatArray) -> FloatArray:
    """Return the covariance of the step of every free pose at a solution, by the options that it was solved with.

    Conditions g (n_free, 6, n_conditions) hold what no fixed pose holds; poses are stepped locally.

    Returns:
        (n_free, 6, 6) in the local tangent, ``R <- R Exp(dphi), t <- t + R dt``: rotation (rad), then translation (m),
        row-major. NaN where unknown: nothing determines the pose, there are no more residuals than unknowns, or S is
        too large to be inverted (DENSE_LIMIT).
    """
    n_free = int(np.count_nonzero(~problem.fixed))
    unknown = np.full((n_free, 6, 6), np.nan)
    n = 6 * n_free
    if n == 0 or n > DENSE_LIMIT or problem.free_intrinsics:
        return unknown
    options = dataclasses.replace(options, parameterisation="local", schur="points")
    with np.errstate(all="ignore"):
        variance = unit_variance(Objective(problem, options), state, conditions.shape[2])
        kernels = native_kernels.make(problem, options)
        kernels.linearise(state)
        s = kernels.reduce(np.zeros((n_free, 6)), np.zeros((problem.n_points, 3))).dense()
    if not np.isfinite(variance) or not np.isfinite(s).all():
        return unknown
    return variance * _diagonal_of_inverse(s, conditions.reshape(n, -1))


def weakest(kernels: Kernels, problem: Problem, state: State, options: SolverOptions) -> tuple[float, float]:
    """Return the standard deviations of the least determined of the last free poses, in their worst directions.

    Each is that of a pose with all others held exact, and with noise as stated by sigma_px: a lower bound. Factors
    count.

    Args:
        kernels: linearised at the state; their reduced system is another one afterwards.
        problem: as it was solved.
        state: its solution.
        options: that it was solved with.

    Returns:
        Of the position (m) and of the rotation (rad); 0, 0 where they are unknown, or nothing determines one of them.
    """
    unknown = (0.0, 0.0)
    if options.parameterisation != "local" or problem.free_intrinsics or not kernels.n_free:
        return unknown
    system = kernels.damp("none", 0.0)
    if system.side != "points":
        return unknown
    tangent = _inverses(system.diagonal_blocks()[0][-_NEWEST:])
    newest = np.flatnonzero(~problem.fixed)[-_NEWEST:]
    # The body is at p = -R't, and moves by p x dphi - dt.
    _, position = geometry.inverse(state.rotation[newest], state.translation[newest])
    moves = np.concatenate([geometry.hat(position), np.broadcast_to(-np.eye(3), (len(position), 3, 3))], axis=2)
    both = np.stack([moves @ tangent @ np.swapaxes(moves, 1, 2), tangent[:, :3, :3]])
    if not np.isfinite(both).all():
        return unknown
    sigma_m, sigma_rad = np.sqrt(np.linalg.eigvalsh(both)[:, :, -1].max(axis=1))
    return float(sigma_m), float(sigma_rad)


def _inverses(blocks: FloatArray) -> FloatArray:
    """Return the inverses of blocks (n, 6, 6) of S; NaN for all if one of them is singular to rounding."""
    with np.errstate(all="ignore"):
        unit = 1.0 / np.sqrt(np.diagonal(blocks, axis1=1, axis2=2))
        scale = unit[:, :, None] * unit[:, None, :]
        try:
            inverse = np.linalg.inv(blocks * scale)
        except np.linalg.LinAlgError:
            return np.full_like(blocks, np.nan)
    # A positive definite block has positive variances.
    variances = np.diagonal(inverse, axis1=1, axis2=2)
    sound = variances.min() > 0.0 and variances.max() < 1.0 / _ROUNDING
    return inverse * scale if sound else np.full_like(blocks, np.nan)


def unit_variance(objective: Objective, state: State, n_conditions: int = 0) -> float:
    """Return ``r' W r / (m - n)``, NaN where there are no more rows than unknowns."""
    problem = objective.problem
    squares, rows = objective.weighted_squares(state)
    unknowns = 6 * int(np.count_nonzero(~problem.fixed)) + 3 * len(np.unique(problem.observations.point))
    freedom = rows - (unknowns - n_conditions)
    return squares / freedom if freedom > 0 else np.nan


def _diagonal_of_inverse(s: FloatArray, conditions: FloatArray) -> FloatArray:
    """Return the 6 x 6 blocks on the diagonal of ``Q (Q' S Q)^-1 Q'``, NaN for keyframes that are undetermined."""
    n = len(s)
    diagonal = np.diagonal(s)
    unit = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 1.0)
    scaled = s * unit[:, None] * unit
    if conditions.shape[1]:
        # x = D x~ turns g'x into (D g)'x~.
        basis = scipy.linalg.qr(conditions * unit[:, None])[0][:, conditions.shape[1] :]
        values, vectors = np.linalg.eigh(basis.T @ scaled @ basis)
        vectors = basis @ vectors
    else:
        values, vectors = np.linalg.eigh(scaled)
    kept = values > _ROUNDING * n
    roots = unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    blocks = roots.reshape(n // 6, 6, -1)
    # Not by matrix products: they are too small for the threads of BLAS, which would wait for each other.
    out = np.asarray(np.einsum("kim,kjm->kij", blocks, blocks))
    loose = np.sum(vectors[:, ~kept].reshape(n // 6, -1) ** 2, axis=1) > _SHARE**2
    out[loose] = np.nan
    return out
