# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""How well a solution is determined: the covariance of every free pose, and of points.

At the minimum the scores of all residuals balance, ``sum J' psi(r) = 0`` (rows.py has psi, w and d). To first order the
error of the unknowns is therefore ``-A^-1 sum J' psi``, and its covariance is the sandwich (Huber, *Robust Statistics*,
1981, 6.3-6.6)::

    Sigma = A^-1 G A^-1,    A = sum d J'J,    G = sum v J'J,

where v is the variance of the score. With squared loss and sigma_px as stated it is ``A^-1``. Nothing in it relies on
sigma_px: a robust loss that leaves the square too early, as noise is larger than stated, shows in d and v alike.

Residuals at the solution are smaller than the errors that they come from, by their leverage ``h = J A^-1 J'``; points
of few views take a third of it and more. With the residual's slope that makes, for each group of rows (pixels, depths,
each kind of factor):

- for the square, and for depths: one variance of unit weight, ``sum psi^2 / sum (1 - h d)``, r' r / (m - n) in the case
  of pixels alone;
- for pixels with a robust loss: the jackknife's, row by row, less the variance of the prediction that it
  takes in (Efron and Stein, *The Jackknife Estimate of Variance*, 1981)::

    v = psi^2 / (1 - h d)^2 - kappa d^2 h,    kappa = sum psi^2/(1 - h d)^2 / sum d/(1 - h d)

- for a marginal prior, which is made of pixels: that of the pixels;
- for factors, which are few and may have another weight than they deserve: a component of variance for each kind
  (Helmert's, as in Foerstner, 1979), v_i = v d_i, so that the scores have the size that is expected of them::

    sum psi^2 = sum v d (1 - 2 h d) + sum d^2 J Sigma J'

  with Sigma of all components together, pixels at their mean variance; the sigma that a factor states counts as two
  rows more. They are few, and what is left of them once pixels are taken out may come out as next to nothing by chance,
  or as their loss hardly grows any more: v is at least what their scores show as they are.

The keyframes' part needs S = B - E C^-1 E' of A alone (3.64-3.67): with C the points' blocks, and ``u = J_c - J_p C^-1
E'`` of a row, the error of the keyframes is ``delta_c = -S^-1 sum u' psi``, and that of a point ``-C^-1 (sum J_p' psi +
E' delta_c)``.

**Which covariance it is**: of the free poses given those that the problem holds fixed, which count as exact. Points are
integrated out. Errors of all residuals are taken to be independent: a front-end whose steps come from the same images
as its tracks is not, and where the factors of its steps decide, the covariance is too small.

Where a condition ``g'x = 0`` on the step of all keyframes fixes scale, and not a fixed pose, S is inverted on the
directions that the condition leaves: with an orthonormal basis Q of them, ``S^-1 -> Q (Q' S Q)^-1 Q'``.

A lower bound is had at once: the inverse of a keyframe's own block of S is its covariance with all other keyframes held
exact, hence that of its steps to them. It costs one elimination more, and tells which keyframe hangs loose.

A direction that nothing determines has no variance. Keyframes that take part in such a direction are unknown (NaN); the
others keep theirs. S is scaled to a unit diagonal first, so that units do not decide what is rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import SolverOptions
from ba_node.core import geometry
from ba_node.core.kernels import DENSE_LIMIT, Kernels
from ba_node.core.problem import Problem, State
from ba_node.core.rows import DEPTHS, GIVEN, MARGINAL, PIXELS, Rows, rows_of

# Eigenvalues of S, scaled to a unit diagonal, that are rounding.
_ROUNDING = 1e-11
# A keyframe with a larger share (unit vector) in an undetermined direction is unknown itself.
_SHARE = 1e-4
# So many of the last poses are looked at for the weakest: of the newest keyframes, where these are oldest first.
_NEWEST = 5
# Rows with more leverage are taken to have this: they tell next to nothing about the noise.
_MOST_LEVERAGE = 0.9
# What the sigma that a factor states counts, in rows.
_STATED = 2.0
# Its variance is at least this share of what it states.
_LEAST = 0.1
# Rows at a time whose leverage is worked out, and points whose covariance is.
_CHUNK = 2000
# A matrix with a larger share of its elements is multiplied as a full one.
_FULL = 0.2


def uncertainty_of(
    problem: Problem, state: State, options: SolverOptions, conditions: FloatArray
) -> Uncertainty | None:
    """Return the uncertainty of a solution, by the options that it was solved with; poses are stepped locally.

    Conditions g (n_free, 6, n_conditions) hold what no fixed pose holds. None where it is unknown: there are no more
    residuals than unknowns, or S is too large to be inverted (DENSE_LIMIT).
    """
    n = 6 * int(np.count_nonzero(~problem.fixed))
    if n == 0 or n > DENSE_LIMIT or problem.free_intrinsics:
        return None
    with np.errstate(all="ignore"):
        rows = rows_of(problem, state, options)
        return uncertainty_of_rows(rows, options.loss == "squared", conditions.reshape(n, -1))


def uncertainty_of_rows(rows: Rows, squared: bool, conditions: FloatArray) -> Uncertainty | None:
    """Return the same of rows, whose unknowns beside the points may be others than poses, under conditions (n, k).

    ``squared`` where pixels and depths have no robust loss.
    """
    seen = np.unique(rows.points.indices[rows.points.data != 0.0] // 3)
    unknowns = rows.keyframes.shape[1] + 3 * len(seen) - conditions.shape[1]
    if len(rows) <= unknowns:
        return None
    reduced = Reduced(rows, np.maximum(rows.slope, 0.0))
    if not np.isfinite(reduced.s).all():
        return None
    roots, loose = _roots(reduced.s, conditions)
    slope = np.maximum(rows.slope, 0.0)
    leverage = reduced.leverages(roots) * slope
    variance = np.zeros(len(rows))
    for group in np.unique(rows.group[(rows.group <= DEPTHS) & (rows.group > MARGINAL)]):
        of = rows.group == group
        score = rows.weight[of] * rows.residual[of]
        make = _pooled if squared or group > PIXELS else _jackknifed
        variance[of] = slope[of] if group == GIVEN else make(score, slope[of], leverage[of])
    pixels = rows.group == PIXELS
    unit = float(variance[pixels].sum()) / max(float(slope[pixels].sum()), 1e-300)
    variance = np.where(rows.group == MARGINAL, unit * slope, variance)
    _add_factors(reduced, roots, leverage, variance)
    return Uncertainty(reduced, variance, roots, loose)


def _pooled(score: FloatArray, slope: FloatArray, leverage: FloatArray) -> FloatArray:
    unit = np.sum(score * score) / np.sum(1.0 - leverage)
    return np.asarray(unit * slope / max(float(slope.mean()), 1e-300))


def _add_factors(reduced: Reduced, roots: FloatArray, leverage: FloatArray, variance: FloatArray) -> None:
    """Write the variances of the scores of factors over: the components v of ``v d`` by kinds, see above."""
    rows = reduced.rows
    groups = np.unique(rows.group[rows.group > DEPTHS])
    if not len(groups):
        return
    of_seen = roots.T @ _weighted_square(reduced.influence, rows.evened(variance)) @ roots
    members = [np.flatnonzero(rows.group == group) for group in groups]
    slopes = [np.maximum(rows.slope[of], 0.0) for of in members]
    moved = [np.asarray(rows.keyframes[of] @ roots) for of in members]
    n = len(groups)
    matrix, total, shown = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    for g, (of, d, j) in enumerate(zip(members, slopes, moved, strict=True)):
        mean = float(d.mean())
        matrix[g, g] = np.sum(d * (1.0 - 2.0 * leverage[of])) + _STATED * mean
        for other in range(n):
            matrix[g, other] += np.sum(
                (j * d[:, None] @ (moved[other].T * slopes[other]) @ moved[other]) * j * d[:, None]
            )
        score, scaled = rows.weight[of] * rows.residual[of], j * d[:, None]
        shown[g] = np.mean(score * score) / max(mean, 1e-300)
        total[g] = np.sum(score * score) + _STATED * mean * mean - np.sum((scaled @ of_seen) * scaled)
    found = np.linalg.lstsq(matrix, total, rcond=None)[0]
    for of, d, v, least in zip(members, slopes, found, shown, strict=True):
        variance[of] = max(float(v), float(least), _LEAST * float(d.mean())) * d


def _jackknifed(score: FloatArray, slope: FloatArray, leverage: FloatArray) -> FloatArray:
    left = 1.0 - np.minimum(leverage, _MOST_LEVERAGE)
    square = (score / left) ** 2
    kappa = np.sum(square) / max(float(np.sum(slope / left)), 1e-300)
    return np.asarray(np.maximum(square - kappa * slope * (1.0 - left), 0.0))


class Reduced:
    """The equations ``sum weight J'J`` of rows with the points eliminated.

    Attributes:
        s: (n, n) Schur complement.
        influence: (m, n) u of each row.
        back: (3 n_pt, n) ``C^-1 E'``.
        inverse: (3 n_pt, 3 n_pt) ``C^-1``, block diagonal.
    """

    def __init__(self, rows: Rows, weight: FloatArray) -> None:
        self.rows = rows
        weighted = scipy.sparse.diags(weight)
        self.inverse = _inverse_blocks((rows.points.T @ weighted @ rows.points).tobsr((3, 3)))
        self.back = (self.inverse @ (rows.points.T @ weighted @ rows.keyframes)).tocsr()
        # By pieces: scipy keeps the interpreter for the whole of a product, and solves beside this one wait for it.
        pieces = [slice(begin, begin + _CHUNK) for begin in range(0, len(rows), _CHUNK)]
        parts = [rows.keyframes[piece] - rows.points[piece] @ self.back for piece in pieces]
        self.influence = scipy.sparse.vstack(parts, format="csr")
        left = (rows.keyframes.T @ weighted).tocsr()
        n = left.shape[0]
        self.s = np.concatenate([(left[k : k + 6] @ self.influence).toarray() for k in range(0, n, 6)])
        self.s = 0.5 * (self.s + self.s.T)

    def leverages(self, roots: FloatArray) -> FloatArray:
        """Return ``J A^-1 J'`` of every row, (m,), with ``S^-1 = X X'`` for the roots X (n, k)."""
        points = self.rows.points
        local = (points @ self.inverse).multiply(points).sum(axis=1)
        parts = [
            np.sum((self.influence[begin : begin + _CHUNK] @ roots) ** 2, axis=1)
            for begin in range(0, len(self.rows), _CHUNK)
        ]
        return np.asarray(np.asarray(local).ravel() + np.concatenate(parts))


def _weighted_square(matrix: scipy.sparse.csr_matrix, weight: FloatArray) -> FloatArray:
    """Return ``M' diag(weight) M`` (n, n) of a matrix M (m, n): as a full one unless few of its elements are there."""
    m, n = matrix.shape
    if matrix.nnz < _FULL * m * n:
        return np.asarray((matrix.T @ scipy.sparse.diags(weight) @ matrix).toarray())
    out = np.zeros((n, n))
    for begin in range(0, m, _CHUNK):
        rows = matrix[begin : begin + _CHUNK].toarray()
        out += (rows.T * weight[begin : begin + _CHUNK]) @ rows
    return out


def _inverse_blocks(c: scipy.sparse.bsr_matrix) -> scipy.sparse.bsr_matrix:
    """Return the inverse of a block diagonal matrix; 0 for points that nothing determines."""
    n = c.shape[0] // 3
    blocks = np.zeros((n, 3, 3))
    c.sum_duplicates()
    blocks[np.repeat(np.arange(n), np.diff(c.indptr))] = c.data
    values, vectors = np.linalg.eigh(blocks)
    sound = values > _ROUNDING * np.maximum(values[:, 2:], 1e-300)
    inverse = np.where(sound, 1.0 / np.where(sound, values, 1.0), 0.0)
    blocks = (vectors * inverse[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return scipy.sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=c.shape)


@dataclass(frozen=True)
class Uncertainty:
    """What is known of the error of a solution."""

    reduced: Reduced
    variance: FloatArray  # (m,) v of each row
    roots: FloatArray  # (n, k) X with S^-1 = X X'
    loose: BoolArray  # (n,) unknowns that nothing determines

    def _meat(self, variance: FloatArray) -> FloatArray:
        """Return ``X' (sum v u'u) X``, (k, k)."""
        return np.asarray(self.roots.T @ _weighted_square(self.reduced.influence, variance) @ self.roots)

    def of(self, unknowns: IntArray) -> FloatArray:
        """Return the covariance of some unknowns beside the points, (k, k); NaN for those that are undetermined."""
        roots = self.roots[unknowns]
        out = np.asarray(roots @ self._meat(self.variance) @ roots.T)
        out[self.loose[unknowns]], out[:, self.loose[unknowns]] = np.nan, np.nan
        return out

    def poses(self) -> FloatArray:
        """Return the covariances (n_free, 6, 6) of the poses, which are all unknowns beside the points.

        In the local tangent, ``R <- R Exp(dphi), t <- t + R dt``: rotation (rad), then translation (m). NaN for those
        that nothing determines.
        """
        blocks = self.roots.reshape(-1, 6, self.roots.shape[1])
        # Not by matrix products of the blocks: they are too small for the threads of BLAS, which wait for each other.
        out = np.asarray(np.einsum("kim,kjm->kij", blocks @ self._meat(self.variance), blocks))
        out[self.loose.reshape(-1, 6).any(axis=1)] = np.nan
        return out

    def points(self, which: IntArray) -> FloatArray:
        """Return the covariances (n, 3, 3) of some points, m^2; NaN for those that nothing determines."""
        # A point has few rows of its own: each group's mean variance tells more than theirs.
        variance = self.reduced.rows.evened(self.variance)
        meat = self._meat(variance)
        starts = range(0, len(which), _CHUNK)
        parts = [self._of_points(which[begin : begin + _CHUNK], variance, meat) for begin in starts]
        return np.concatenate([np.empty((0, 3, 3)), *parts])

    def _of_points(self, which: IntArray, variance: FloatArray, meat: FloatArray) -> FloatArray:
        """Return ``L - K - K' + M``: of the own rows, of both, and of the poses."""
        reduced, rows = self.reduced, self.reduced.rows
        place = (3 * which[:, None] + np.arange(3)).ravel()
        n = len(which)
        inverse = reduced.inverse.tocsr()[place][:, place]
        seen = rows.points[:, place] @ inverse
        weighted = scipy.sparse.diags(variance) @ seen
        back = np.asarray(reduced.back[place] @ self.roots)
        own = (seen.T @ weighted).tobsr((3, 3))
        out = np.zeros((n, 3, 3))
        own.sum_duplicates()
        out[np.repeat(np.arange(n), np.diff(own.indptr))] = own.data
        cross = (weighted.T @ reduced.influence @ self.roots).reshape(n, 3, -1)
        both = np.einsum("pik,pjk->pij", cross, back.reshape(n, 3, -1))
        poses = np.einsum("pik,pjk->pij", (back @ meat).reshape(n, 3, -1), back.reshape(n, 3, -1))
        out += poses - both - np.swapaxes(both, 1, 2)
        hangs = np.asarray(abs(reduced.back[place]) @ self.loose).reshape(n, 3).any(axis=1)
        undetermined = np.diagonal(out, axis1=1, axis2=2).min(axis=1) <= 0.0
        out[hangs | undetermined] = np.nan
        return out


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
    blocks = system.diagonal_blocks()[0][-_NEWEST:]
    newest = np.flatnonzero(~problem.fixed)[-_NEWEST:]
    _, position = geometry.inverse(state.rotation[newest], state.translation[newest])
    if options.kernels != "numpy" and native.kernels is not None:
        found: tuple[float, float] = native.kernels.loosest(blocks, position, 1.0 / _ROUNDING)
        return found
    tangent = _inverses(blocks)
    # The body is at p = -R't, and moves by p x dphi - dt.
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


def _roots(s: FloatArray, conditions: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return X (n, k) with ``X X' = Q (Q' S Q)^-1 Q'``, and which unknowns (n,) nothing determines."""
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
    return roots, np.sum(vectors[:, ~kept] ** 2, axis=1) > _SHARE**2
