# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tell tracks on objects that move from those of the scene that stands.

Tracks on an object agree with each other as those of the scene do, only on another motion of the camera. Each few of
their views nearly fit a point, so view by view most pass the gate of outliers, and together they pull the solution. The
motion that counts is the one that the keyframes begin with: refined before, or as the front-end's step has it. A point
that stands, seen by it, leaves noise alone; one that moves leaves more in most of its views. So tracks are classified
as a whole, by the mean of their squared residuals ``r`` in sigmas, none of which counts for more than the gate::

    mean of min(r, 6)^2 > 9,    r > 3 in two views in five, and in two at least

Noise alone gives a mean of 2. A view that is far off in the image, as a mismatch is, does not count at all. Poses are
somewhat off too, most of all those that were not refined yet: where the best third of the residuals exceed noise, of
the window or of such a keyframe, its residuals are divided by how many times they do.

What moves sits out the solve that it is found in, and is no point of the map. It is looked for anew before each.

Where much is found to move more does that is not found, as what moves slowly or was placed by few views. Then solutions
follow it, and explain it well. Or nothing moves, and the calibration is wrong: what contradicts it is taken for moving.
So there the front-end's steps count as they are stated (``odometry.py``), and a solution may differ less from them
(``guard.py``).
"""

from __future__ import annotations

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray, changed
from ba_node.core import consensus, native_kernels, triangulation
from ba_node.core.problem import Problem
from ba_node.window.problems import part_of

# Residuals, sigmas: of a mismatch, which tells nothing of motion; the most that one counts for; and more than noise.
_MISMATCH = 120.0
_BOUND = 6.0
_LARGE = 3.0
# So many residuals of a track, and that share of them, are larger.
_LEAST_LARGE = 2
_LARGE_SHARE = 0.4
_LIMITS = _LARGE, _MISMATCH, _BOUND, _LEAST_LARGE, _LARGE_SHARE
# With fewer observations a keyframe, or fewer keyframes, poses are not known well enough to tell: most of what seems to
# move in a young map stands.
_MANY = 50
_LEAST_KEYFRAMES = 8
# The residual of this rank tells how far off a keyframe begins, if so many are known; and what noise has at this rank.
_RANK = 0.3
_NOISE_AT_RANK = 0.845
_KNOWN = 10
# So large a share of the observations of points with a place is much.
_MUCH = 0.1


def moving(problem: Problem, norms: FloatArray, unrefined: BoolArray, kernels: str = "auto") -> BoolArray:
    """Return which points move, (n_pt,).

    A point that seems to may only be in the wrong place. So it is classified again where most of its views agree.

    The problem has all observations, flagged ones too; points without a place are NaN. ``norms`` (n_obs,) are the
    residuals at the start, sigmas; no solve has refined the poses of ``unrefined`` (n_kf,) yet.
    """
    point = problem.observations.point
    # Where most poses are the front-end's alone, as after a burst of keyframes, none is known well enough to tell.
    young = problem.n_keyframes < _LEAST_KEYFRAMES or np.count_nonzero(unrefined) > 1 + problem.n_keyframes // 2
    if young or len(point) < _MANY * problem.n_keyframes:
        return np.zeros(problem.n_points, bool)
    off, found = _seem_to_move(problem, norms, unrefined, kernels)
    rows = found.take(point).nonzero()[0]
    if not len(rows):
        return found
    doubted = part_of(problem, rows, found)
    places, _ = consensus.triangulate(triangulation.rays_of(doubted, kernels), doubted.n_points, _BOUND, kernels)
    at = changed(doubted.start, points=np.where(np.isnan(places.points), 0.0, places.points))
    again = native_kernels.residual_norms(doubted, at, kernels)
    again[_mismatches(doubted, again, kernels)] = np.inf
    found[found] = _leaves_more_than_noise(doubted, again, off, kernels)
    return found


def _seem_to_move(
    problem: Problem, norms: FloatArray, unrefined: BoolArray, kernels: str
) -> tuple[FloatArray, BoolArray]:
    """Return how far off keyframes are, see ``_off``, and which points leave more than noise."""
    unplaced = np.isnan(problem.start.points[:, 0])
    if kernels != "numpy" and native.kernels is not None:
        noise = _NOISE_AT_RANK, _RANK, _KNOWN
        off, found = native.kernels.seem_to_move(problem.observations, norms, unplaced, unrefined, noise, _LIMITS)
        return off, found
    norms = np.where(unplaced.take(problem.observations.point), np.inf, norms)
    off = _off(problem, norms, unrefined)
    return off, _leaves_more_than_noise(problem, norms, off, kernels)


def _mismatches(problem: Problem, norms: FloatArray, kernels: str) -> BoolArray:
    """Return which views are off by far more than those before and after them of the same point, (n_obs,).

    A point that moves leaves its place little by little. Nor may the views before and after by the same camera be off
    likewise: of a rig that is not as it is said to be, one camera's views are, in every keyframe.
    """
    obs = problem.observations
    if kernels != "numpy" and native.kernels is not None:
        found: BoolArray = native.kernels.stand_out(obs, norms, len(problem.cameras.model), _LARGE)
        return found
    track = obs.point * len(problem.cameras.model) + obs.camera
    order = np.argsort(track, kind="stable")
    found = _stands_out(obs.point, norms, alone=False)
    found[order] &= _stands_out(track.take(order), norms.take(order), alone=True)
    return found


def _stands_out(track: IntArray, norms: FloatArray, *, alone: bool) -> BoolArray:
    """Return which residuals are far larger than those before and after them in the same track, or ``alone``."""
    goes_on = np.diff(track) == 0
    with np.errstate(invalid="ignore"):
        step = np.diff(norms)
    rises, falls = step > _LARGE, step < -_LARGE
    rises, falls = np.where(goes_on, rises, alone), np.where(goes_on, falls, alone)
    return np.asarray(np.append(alone, rises) & np.append(falls, alone))


def much(problem: Problem, moves: BoolArray) -> bool:
    """Return True if a large share of what is seen moves; points without a place, (n_pt,) NaN, do not count."""
    if not moves.any():
        return False
    views = np.bincount(problem.observations.point, minlength=problem.n_points)
    placed = ~np.isnan(problem.start.points[:, 0])
    return bool(views @ (moves & placed) > _MUCH * (views @ placed))


def _off(problem: Problem, norms: FloatArray, unrefined: BoolArray) -> FloatArray:
    """Return how many times as large as noise the residuals of each keyframe are where it begins, (n_kf,)."""
    off = np.full(problem.n_keyframes, _times_noise(norms))
    for k in np.flatnonzero(unrefined):
        off[k] = max(off[k], _times_noise(norms[problem.observations.keyframe == k]))
    return off


def _times_noise(norms: FloatArray) -> float:
    """Return how many times as large as noise the better ones of some residuals are, 1 or more."""
    n = int(np.count_nonzero(np.isfinite(norms)))
    rank = int(_RANK * n)
    # To count takes a tenth of the time that it takes to find the one of this rank.
    if n < _KNOWN or np.count_nonzero(norms <= _NOISE_AT_RANK) > rank:
        return 1.0
    return max(1.0, float(np.partition(norms, rank)[rank]) / _NOISE_AT_RANK)


def _leaves_more_than_noise(problem: Problem, norms: FloatArray, off: FloatArray, kernels: str) -> BoolArray:
    """Return which points leave more than noise in most of their views, of residuals over what keyframes are off."""
    if kernels != "numpy" and native.kernels is not None:
        found: BoolArray = native.kernels.move_more_than_noise(
            problem.observations, norms, off, problem.n_points, _LIMITS
        )
        return found
    norms = norms / off.take(problem.observations.keyframe)
    point, n = problem.observations.point, problem.n_points
    large = np.bincount(point[(norms > _LARGE) & (norms < _MISMATCH)], minlength=n)
    moves = large >= _LEAST_LARGE
    # Few have so many large residuals: the others need not be looked at.
    rows = np.flatnonzero(moves.take(point) & (norms < _MISMATCH))
    point, norms = point.take(rows), norms.take(rows)
    total = np.bincount(point, np.minimum(norms, _BOUND) ** 2, n)
    count = np.bincount(point, minlength=n)
    return np.asarray(moves & (total > _LARGE**2 * count) & (large >= _LARGE_SHARE * count))
