# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Improve points alone, keyframes fixed: the inner iterations after a step of the keyframes.

Each point has its own 3 x 3 damped normal equations (Marquardt) and its own objective. A point whose step does not
lower its objective goes back to where it was, and stays: no point can make the whole worse. Only observations of points
that still move are looked at again.

Under Huber's loss IRLS meets w J'J where an observation outside of ``scale`` has w J'(I - r r' / |r|^2) J: along its
residual the loss is linear. A point of two views that do not agree creeps along a flat valley then: a hundred
iterations of Ladybug-49 did not reach the objective that fifteen reach with nine tenths of that taken away. So it is
from the second step on where IRLS promises little more: far from there steps that long fail, and a point whose step
fails goes on by the first.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import SolverOptions
from ba_node.core import columns
from ba_node.core.objective import Objective, PointRows
from ba_node.core.problem import State
from ba_node.core.schur import Structure, inverse_cholesky3

_FIRST_DAMPING = 1e-4
_MIN_DIAGONAL = 1e-6
# A point that gains less than this share has arrived.
_MIN_GAIN = 1e-4
# One that its model promises less than this share does not step at all. With 1e-4 the last 1e-6 of the objective of a
# loop of 1000 cameras took 57 iterations in place of 21; with 1e-8 windows and Ladybug end as if all stepped. Where the
# solve ends for little, a point steps for no less than this share of that.
_MIN_PROMISE, _OF_TOLERANCE = 1e-8, 1e-2
# With an observation outside of Huber's loss: the share that has arrived; that which IRLS must promise less than; and
# how much of the curvature along the residual is taken away.
_MIN_GAIN_OUTLIER, _CLOSE, _RADIAL = 1e-6, 1e-3, 0.9


@dataclass(frozen=True)
class InnerIterations:
    """What the inner iterations did."""

    state: State  # of which only the points differ
    before: float  # the objective at the start
    after: float  # the objective of ``state``
    rows: PointRows  # of all observations at ``state``


def least_promise(options: SolverOptions) -> float:
    """Return the share of its own cost that a point's step has to promise."""
    return max(_MIN_PROMISE, _OF_TOLERANCE * options.function_tolerance)


def iterate_points(objective: Objective, structure: Structure, state: State, steps: int) -> InnerIterations:
    """Take up to ``steps`` damped Newton steps a point from a state."""
    best, points = state.points.copy(), state.points.copy()
    best_cost = np.full(len(points), np.inf)
    # The points that still move, the observations of them, and where those of each begin.
    ids, rows, start = structure.seen_points, np.arange(structure.n_rows), structure.point_start
    damping = _FIRST_DAMPING
    seen = kept = objective.point_rows(state)
    factors = objective.factors_value(state)
    before = 0.5 * float(np.sum(seen.cost)) + factors
    for step in range(steps + 1):
        count = columns.counts(start, len(rows))
        flat = _flatness(objective, seen, start)
        cost = columns.sum_runs(seen.cost, start)
        better = cost < best_cost[ids]
        if step:
            taken = np.flatnonzero(np.repeat(better, count))
            kept.update(rows[taken], seen, taken)
        with np.errstate(invalid="ignore"):
            least: float | FloatArray = _MIN_GAIN
            if flat is not None:
                least = np.where(np.trace(flat, axis1=1, axis2=2) > 0.0, _MIN_GAIN_OUTLIER, _MIN_GAIN)
            active = better & ~(best_cost[ids] - cost < least * cost)
        won = ids[better]
        best[won], best_cost[won] = points[won], cost[better]
        if step == steps or not active.any():
            break
        c, gradient = columns.normal_equations(seen.d_point, seen.residual, start)
        diagonal = damping * np.maximum(np.diagonal(c, axis1=1, axis2=2), _MIN_DIAGONAL)
        inverse = inverse_cholesky3(columns.plus_diagonal(c, diagonal))
        scaled = columns.times(inverse, gradient)
        if step and flat is not None:
            close = np.sum(scaled * scaled, axis=1) <= _CLOSE * cost
            if close.any():
                c[close] -= flat[close]
                inverse = inverse_cholesky3(columns.plus_diagonal(c, diagonal))
                scaled = columns.times(inverse, gradient)
        active &= np.sum(scaled * scaled, axis=1) > least_promise(objective.options) * cost
        going = active.nonzero()[0]
        if not len(going):
            break
        points = best.copy()
        ids, rows = ids.take(going), rows[np.repeat(active, count)]
        points[ids] -= columns.times(columns.transposed(columns.take(inverse, going)), columns.take(scaled, going))
        count = count.take(going)
        start = np.cumsum(count) - count
        seen = objective.point_rows(dataclasses.replace(state, points=points), rows)
        damping *= 0.1
    after = 0.5 * float(np.sum(best_cost[np.isfinite(best_cost)])) + factors
    return InnerIterations(dataclasses.replace(state, points=best), before, after, kept)


def _flatness(objective: Objective, seen: PointRows, start: IntArray) -> FloatArray | None:
    """Return what Huber's loss takes from the curvature of each point, (n_pt, 3, 3); None if it takes nothing."""
    options = objective.options
    if options.loss != "huber" or options.loss_per != "observation":
        return None
    # r and J are both weighted: |r|^2 is scale times the norm outside.
    residual = seen.residual[:, :2]
    norm2 = np.sum(residual * residual, axis=1)
    outside = np.flatnonzero(norm2 > options.loss_scale_px**2)
    if not len(outside):
        return None
    along = np.zeros((len(residual), 3))
    projected = columns.times(columns.transposed(seen.d_point[outside, :2]), residual[outside])
    along[outside] = projected * np.sqrt(_RADIAL / norm2[outside])[:, None]
    return columns.normal_equations(along[:, None], along[:, :1], start)[0]
