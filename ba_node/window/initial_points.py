# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the first position of a landmark: the front-end's guess, or a triangulation.

The gate on the median reprojection error widens with the bulk of the points: where most have large errors, the poses
are still bad and the points are not to blame. A guess that passes the gate is taken. Otherwise the better of the two by
robust error is taken, so that a whole map with bad start values (pixel errors of tens) is not thrown away; a
triangulation must have passed its own gates. Both must lie in front of the cameras: all of them for a triangulation,
two (one with a measured depth) for a guess.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ba_node.core import loss, native_kernels, triangulation

if TYPE_CHECKING:
    from ba_node.config import TracksConfig
    from ba_node.core.problem import Problem

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Robust error of a view with the point behind the camera, in sigmas: worse than any view that is only bad.
_BEHIND = 1e4
BULK = 10
# Three standard deviations of a normal distribution, of which 1.4826 median absolute deviations are one.
SPREAD = 3.0 * 1.4826


@dataclasses.dataclass(frozen=True)
class _Fit:
    """How well points fit their views: views in front, median error (sigmas), summed robust error; each (n_pt,)."""

    in_front: NDArray[np.intp]
    views: NDArray[np.intp]
    median: FloatArray
    robust: FloatArray


def initial_points(problem: Problem, guess: FloatArray, config: TracksConfig, backend: str = "auto") -> FloatArray:
    """Return first positions (n_pt, 3) of the points of a problem, NaN where none can be had yet.

    Args:
        problem: views of the points; its start points are not looked at.
        guess: (n_pt, 3) guesses in the frame of the problem, NaN for none.
        config: the gates.
        backend: kernels.
    """
    found = triangulation.triangulate(triangulation.rays_of(problem), problem.n_points, backend)
    fit = _fit(problem, found.points, backend)
    wide = found.parallax_rad >= np.deg2rad(config.min_parallax_deg)
    sound = (wide | found.measured) & (fit.in_front == fit.views) & (fit.views > 0)
    gate = widened(config.max_triangulation_px, fit.median[sound])
    good = sound & (fit.median <= gate)
    points = np.where(good[:, None], found.points, np.nan)
    if np.isnan(guess).all():
        return points
    guess_fit = _fit(problem, guess, backend)
    needed = np.where(found.measured, 1, 2)
    guess_usable = guess_fit.in_front >= needed
    take_guess = guess_usable & ((guess_fit.median <= gate) | ~good | (guess_fit.robust <= fit.robust))
    return np.where(take_guess[:, None], guess, points)


def widened(gate: float, errors: FloatArray, bulk: int = BULK) -> float:
    """Return a gate that lets the bulk of the errors pass: three robust standard deviations.

    Args:
        gate: smallest gate.
        errors: to look at.
        bulk: with fewer errors than this there is no bulk, and the gate stays.
    """
    if len(errors) < bulk or not _median_exceeds(gate, errors):
        return gate
    return max(gate, SPREAD * float(np.median(errors)))


def _median_exceeds(gate: float, errors: FloatArray) -> bool:
    """Return False only where the median is small enough for the gate; counting is ten times as fast as the median."""
    return 2 * int(np.count_nonzero(SPREAD * errors > gate)) >= len(errors)


def _fit(problem: Problem, points: FloatArray, backend: str) -> _Fit:
    obs, n = problem.observations, problem.n_points
    missing: BoolArray = np.asarray(np.isnan(points).any(axis=1))
    state = dataclasses.replace(problem.start, points=np.where(missing[:, None], 0.0, points))
    norm = native_kernels.residual_norms(problem, state, backend)
    in_front = np.isfinite(norm) & ~missing[obs.point]
    norm = np.where(in_front, norm, _BEHIND)
    cost, _ = loss.evaluate("huber", norm, 1.0)
    return _Fit(
        np.bincount(obs.point[in_front], minlength=n),
        np.bincount(obs.point, minlength=n),
        _median_by_point(norm, obs.point, n),
        np.bincount(obs.point, cost, n).astype(float),
    )


def _median_by_point(values: FloatArray, point: NDArray[np.intp], n_points: int) -> FloatArray:
    """Return the (upper) median of each point's values, inf for points without any."""
    order = np.lexsort((values, point))
    begin = np.searchsorted(point[order], np.arange(n_points + 1))
    count = np.diff(begin)
    median = np.full(n_points, np.inf)
    some = count > 0
    median[some] = values[order[begin[:-1][some] + count[some] // 2]]
    return median
