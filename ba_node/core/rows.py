# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""All residuals of a problem at a state as sparse rows, for what is worked out once and not in every iteration.

Covariances, shared parameters of cameras and marginalisation need Jacobians and weights apart. Each row has a whitened
residual r, not weighted, and the derivatives of r by the unknowns of the keyframes (and whatever is put beside them)
and by the points. A residual of several rows (u and v; the rows of a factor) has one weight. With x its norm and m its
rows, the robust loss gives it the IRLS weight w(x), so that its score is ``psi = w r``, and the mean slope of the score
over all directions::

    d = ((m - 1) w + s) / m,    s = d(x w) / dx,

which is the curvature that the residual really adds to the objective, where w is that of the IRLS equations.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import scipy

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import SolverOptions
from ba_node.core import loss
from ba_node.core.marginal import MarginalPrior
from ba_node.core.objective import Objective
from ba_node.core.problem import KeyframeFactors, PointPriors, Problem, State

# Groups of rows; each kind of factor is one more. GIVEN are rows whose standard deviation is taken as it is stated,
# MARGINAL those of a prior that is made of pixels, in their units.
MARGINAL, GIVEN, PIXELS, DEPTHS = -2, -1, 0, 1
# The slope of a loss is taken over this share of its scale.
_STEP = 1e-6


@dataclass(frozen=True)
class Rows:
    """Residuals that count: those behind a camera, and depths that were not measured, are left out."""

    residual: FloatArray  # (m,) whitened
    keyframes: scipy.sparse.csr_matrix  # (m, 6 n_free) derivatives by the local steps of the free keyframes
    points: scipy.sparse.csr_matrix  # (m, 3 n_pt) by the points, m^-1
    weight: FloatArray  # (m,) w
    slope: FloatArray  # (m,) d
    group: IntArray  # (m,) as above; 2 and up are factors of each kind
    source: IntArray  # (m,) observation, or factor of its kind

    def __len__(self) -> int:
        return len(self.residual)

    def evened(self, variance: FloatArray) -> FloatArray:
        """Return variances (m,) of scores as those of each group would be if its rows differed by their slope alone."""
        out = variance.copy()
        for group in np.unique(self.group):
            of = self.group == group
            slope = np.maximum(self.slope[of], 0.0)
            out[of] = slope * (variance[of].sum() / max(float(slope.sum()), 1e-300))
        return out

    def take(self, kept: BoolArray) -> Rows:
        """Return some of the rows."""
        return Rows(**{f.name: getattr(self, f.name)[kept] for f in dataclasses.fields(self)})


def rows_of(problem: Problem, state: State, options: SolverOptions) -> Rows:
    """Return all rows of a problem at a state; poses are stepped locally, with the loss of the options."""
    plain = dataclasses.replace(options, parameterisation="local", loss="squared")
    at = Objective(problem, plain).linearise(state)
    obs, n = problem.observations, at.residual.shape[1]
    column = np.where(problem.fixed, -1, np.cumsum(~problem.fixed) - 1)
    pixels = _weighed(options.loss, options.loss_scale_px, at.residual[:, :2])
    parts = [np.repeat(pixels[:, :, None], 2, axis=2)]
    if n == 3:
        depths = _weighed(options.loss, options.loss_scale_px, at.residual[:, 2:])
        # A single row has no other directions that keep its slope from falling below zero.
        depths[1] = depths[0] * (depths[1].sum() / max(float(depths[0].sum()), 1e-300))
        parts.append(depths[:, :, None])
    weights = np.concatenate(parts, axis=2)
    index = np.arange(len(obs))
    found = Rows(
        at.residual.ravel(),
        sparse_blocks(at.d_keyframe, column[obs.keyframe], int(np.count_nonzero(~problem.fixed))),
        sparse_blocks(at.d_point, obs.point, problem.n_points),
        weights[0].ravel(),
        weights[1].ravel(),
        np.tile(np.array([PIXELS, PIXELS, DEPTHS][:n]), len(obs)),
        np.repeat(index, n),
    )
    kinds = [_factor_rows(kind, 2 + i, state, column, problem.n_points) for i, kind in enumerate(problem.factors)]
    slope = float(pixels[1].sum()) / max(float(pixels[0].sum()), 1e-300)
    for i, kind in enumerate(problem.factors):
        if isinstance(kind, MarginalPrior):
            own = kinds[i]
            kinds[i] = dataclasses.replace(own, slope=slope * own.weight, group=np.full(len(own), MARGINAL))
    kinds += [] if problem.point_priors is None else [_prior_rows(problem, problem.point_priors, state, found)]
    found = joined([found, *kinds]) if kinds else found
    counts = np.any(at.d_point != 0.0, axis=2).ravel()
    return found.take(np.concatenate([counts, np.ones(len(found) - len(counts), bool)]))


def _prior_rows(problem: Problem, priors: PointPriors, state: State, beside: Rows) -> Rows:
    """Return the rows of priors of points, whose covariances are taken as stated."""
    n = len(priors.point)
    root = np.linalg.inv(np.linalg.cholesky(priors.covariance))
    residual = (root @ (state.points[priors.point] - priors.position)[:, :, None])[..., 0]
    return Rows(
        residual.ravel(),
        scipy.sparse.csr_matrix((3 * n, beside.keyframes.shape[1])),
        sparse_blocks(root, priors.point, problem.n_points),
        np.ones(3 * n),
        np.ones(3 * n),
        np.full(3 * n, GIVEN),
        np.repeat(np.arange(n), 3),
    )


def _factor_rows(kind: KeyframeFactors, group: int, state: State, column: IntArray, n_points: int) -> Rows:
    """Return the rows of factors of a kind; rows without any derivative do not count."""
    residual, jacobian = kind.residuals(state), kind.jacobians(state)
    n, m = residual.shape
    n_free = int(column.max()) + 1
    counts = np.any(jacobian != 0.0, axis=(1, 3))
    weights = _weighed(kind.loss, kind.loss_scale, residual, np.maximum(np.count_nonzero(counts, axis=1), 1))
    blocks = [
        sparse_blocks(jacobian[:, place], column[kind.keyframes[:, place]], n_free)
        for place in range(jacobian.shape[1])
    ]
    rows = Rows(
        residual.ravel(),
        sum(blocks[1:], blocks[0]),
        scipy.sparse.csr_matrix((n * m, 3 * n_points)),
        np.repeat(weights[0], m),
        np.repeat(weights[1], m),
        np.full(n * m, group),
        np.repeat(np.arange(n), m),
    )
    return rows.take(counts.ravel())


def joined(parts: list[Rows]) -> Rows:
    """Return the rows of several, one after another."""
    columns = {f.name: [getattr(part, f.name) for part in parts] for f in dataclasses.fields(Rows)}
    stacked = {
        name: scipy.sparse.vstack(of, "csr") if scipy.sparse.issparse(of[0]) else np.concatenate(of)
        for name, of in columns.items()
    }
    return Rows(**stacked)


def _weighed(name: str, scale: float, residual: FloatArray, size: IntArray | int | None = None) -> FloatArray:
    """Return w and d of residuals (n, m), (2, n); ``size`` is how many of the m rows count."""
    norm = np.sqrt(np.sum(residual * residual, axis=1))
    m = residual.shape[1] if size is None else size
    h = _STEP * scale
    weight = loss.evaluate(name, norm, scale)[1]
    ahead, behind = (x * loss.evaluate(name, np.abs(x), scale)[1] for x in (norm + h, norm - h))
    return np.stack([weight, ((m - 1) * weight + (ahead - behind) / (2.0 * h)) / m])


def sparse_blocks(blocks: FloatArray, column: IntArray, n: int) -> scipy.sparse.csr_matrix:
    """Return rows of blocks (n_obs, m, d), each in its block column of n, none where that is -1, as a sparse matrix."""
    rows, (_, m, d) = np.flatnonzero(column >= 0), blocks.shape
    data = np.ascontiguousarray(blocks[rows])
    bounds = np.searchsorted(rows, np.arange(len(blocks) + 1))
    return scipy.sparse.bsr_matrix((data, column[rows], bounds), shape=(m * len(blocks), d * n)).tocsr()
