# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the first position of a landmark: the front-end's guess, or where its views agree that it is.

A point is triangulated from the views that agree with each other (core/consensus.py), if they are more than a third of
all, and show a parallax that is not noise. The gate on how far off a view may be and agree widens with the errors of
the points that are known already, or, where none is, if hardly any view agrees with another: the poses are still bad
then, and the points are not to blame. A guess that passes the gate is taken. Otherwise the better of the two by robust
error is taken, so that a whole map with bad start values (pixel errors of tens) is not thrown away. A guess must lie in
front of two cameras (one with a measured depth).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import TracksConfig
from ba_node.core import consensus, loss, native_kernels, triangulation
from ba_node.core.problem import Problem

# Robust error of a view with the point behind the camera, in sigmas: worse than any view that is only bad.
_BEHIND = 1e4
BULK = 10
# Of a point's views more than this share has to agree: half of them may be wrong, and not all of the wrong ones apart.
_LEAST_SUPPORT = 1.0 / 3.0
# Two rays meet by chance more easily than three: they have to come so much nearer to each other.
_TWO_VIEWS = 0.5
# A track of as many views that do not agree is tried with its newest third.
_DIVIDED_VIEWS = 9
# Where fewer views than this share agree with another, the poses are bad.
_LEAST_AGREEMENT = 0.2
# Parallax below this many standard deviations of the rays' directions is noise.
_LEAST_PARALLAX = 4.0
# Three standard deviations, in median absolute deviations.
SPREAD = 3.0 * loss.NORMAL


@dataclasses.dataclass(frozen=True)
class _Fit:
    """How well points fit their views: views in front, median error (sigmas), summed robust error; each (n_pt,)."""

    in_front: IntArray
    median: FloatArray
    robust: FloatArray


@dataclasses.dataclass(frozen=True)
class Agreed:
    """What the views of points agree on."""

    points: FloatArray  # (n_pt, 3), m
    good: BoolArray  # (n_pt,) True where that is a place to go by
    measured: BoolArray  # (n_pt,) True where a distance was measured by one that agrees


def initial_points(
    problem: Problem, guess: FloatArray, config: TracksConfig, gate: float, kernels: str = "auto"
) -> FloatArray:
    """Return first positions (n_pt, 3) of the points of a problem, NaN where none can be had yet.

    ``guess`` is (n_pt, 3) in the frame of the problem, NaN for none; ``gate`` is how far off a view may be and agree,
    sigmas. The problem's own start points are not looked at.
    """
    found = agreed_points(problem, config, gate, kernels)
    points = np.where(found.good[:, None], found.points, np.nan)
    if np.isnan(guess).all():
        return points
    fit, guess_fit = _fit(problem, points, kernels), _fit(problem, guess, kernels)
    needed = np.where(found.measured, 1, 2)
    guess_usable = guess_fit.in_front >= needed
    take_guess = guess_usable & ((guess_fit.median <= gate) | ~found.good | (guess_fit.robust <= fit.robust))
    return np.where(take_guess[:, None], guess, points)


def poses_gate(problem: Problem, config: TracksConfig, kernels: str = "auto") -> float:
    """Return how far off a view may be, sigmas: more where hardly any view agrees with another, so bad the poses are.

    Args: as of :func:`initial_points`.
    """
    rays, n = triangulation.rays_of(problem, kernels), problem.n_points
    gate = config.max_triangulation_px
    views = np.bincount(rays.point, minlength=n)
    agrees = consensus.agreeing(rays, n, gate, kernels) & (views > 1).take(rays.point)
    if np.count_nonzero(agrees) >= _LEAST_AGREEMENT * int(views[views > 1].sum()):
        return gate
    rough = triangulation.triangulate(rays, n, kernels)
    fit = _fit(problem, rough.points, kernels)
    wide = rough.parallax_rad >= np.deg2rad(config.min_parallax_deg)
    return widened(gate, fit.median[(wide | rough.measured) & (fit.in_front == views) & (views > 0)])


def agreed_points(problem: Problem, config: TracksConfig, gate: float, kernels: str = "auto") -> Agreed:
    """Return where most views of each point agree that it is; where they do not, the newest third of them.

    Args: as of :func:`initial_points`.
    """
    rays, n = triangulation.rays_of(problem, kernels), problem.n_points
    found = _agreed(rays, n, config, gate, kernels)
    views = np.bincount(rays.point, minlength=n)
    # An id may have become another point's.
    divided = ~found.good & (views >= _DIVIDED_VIEWS)
    if not divided.any():
        return found
    rank = np.arange(len(rays.point)) - (np.cumsum(views) - views).take(rays.point)
    newest = divided.take(rays.point) & (3 * rank >= 2 * views.take(rays.point))
    later = _agreed(rays.part(newest), n, config, gate, kernels)
    return Agreed(
        np.where(later.good[:, None], later.points, found.points),
        found.good | later.good,
        np.where(later.good, later.measured, found.measured),
    )


def _agreed(rays: triangulation.Rays, n: int, config: TracksConfig, gate: float, kernels: str) -> Agreed:
    min_parallax_rad = float(np.deg2rad(config.min_parallax_deg))
    if kernels != "numpy" and native.kernels is not None:
        limits = min_parallax_rad, _LEAST_PARALLAX, _TWO_VIEWS, _LEAST_SUPPORT
        return Agreed(*native.kernels.agreed(rays, n, gate, limits))
    found, agrees = consensus.triangulate(rays, n, gate, kernels)
    point = rays.point[agrees]
    views, support = np.bincount(rays.point, minlength=n), np.bincount(point, minlength=n)
    sharpness, worst = np.zeros(n), np.zeros(n)
    np.maximum.at(sharpness, point, rays.px_per_rad[agrees])
    np.maximum.at(worst, point, triangulation.errors(rays, found.points)[agrees])
    wide = found.parallax_rad >= min_parallax_rad
    wide &= found.parallax_rad * sharpness >= _LEAST_PARALLAX
    fits = worst <= gate * np.where(support > 2, 1.0, _TWO_VIEWS)
    good = ((wide & (support >= 2)) | found.measured) & fits & (support > _LEAST_SUPPORT * views)
    return Agreed(found.points, good, found.measured)


def widened(gate: float, errors: FloatArray, bulk: int = BULK) -> float:
    """Return a gate, at least ``gate``, that lets the bulk of the errors pass: three robust standard deviations.

    Fewer errors than ``bulk`` have no bulk, and the gate stays.
    """
    if len(errors) < bulk or not _median_exceeds(gate, errors):
        return gate
    return max(gate, SPREAD * float(np.median(errors)))


def _median_exceeds(gate: float, errors: FloatArray) -> bool:
    """Return False only where the median is small enough for the gate; counting is ten times as fast as the median."""
    return 2 * int(np.count_nonzero(SPREAD * errors > gate)) >= len(errors)


def _fit(problem: Problem, points: FloatArray, kernels: str) -> _Fit:
    obs, n = problem.observations, problem.n_points
    missing: BoolArray = np.asarray(np.isnan(points).any(axis=1))
    state = dataclasses.replace(problem.start, points=np.where(missing[:, None], 0.0, points))
    norm = native_kernels.residual_norms(problem, state, kernels)
    in_front = np.isfinite(norm) & ~missing[obs.point]
    norm = np.where(in_front, norm, _BEHIND)
    cost, _ = loss.evaluate("huber", norm, 1.0)
    return _Fit(
        np.bincount(obs.point[in_front], minlength=n),
        _median_by_point(norm, obs.point, n),
        np.bincount(obs.point, cost, n).astype(float),
    )


def _median_by_point(values: FloatArray, point: IntArray, n_points: int) -> FloatArray:
    """Return the (upper) median of each point's values, inf for points without any."""
    order = np.lexsort((values, point))
    begin = np.searchsorted(point[order], np.arange(n_points + 1))
    count = np.diff(begin)
    median = np.full(n_points, np.inf)
    some = count > 0
    median[some] = values[order[begin[:-1][some] + count[some] // 2]]
    return median
