# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Fix the gauge of a problem: place, heading, and scale where it cannot be seen.

Scale can be seen where two cameras of one keyframe, apart from each other, see the same point, or where depth is
measured. The front-end's steps (odometry.py) tie consecutive keyframes to each other, and have a scale. For each part
of a problem that common points and ties connect:

- scale is seen, or told by ties and older keyframes take part: one fixed keyframe holds the rest;
- it is not, and older keyframes take part: two fixed ones hold it, the oldest of the window being the second if need
  be;
- it is not, and the whole part is free (a map begins): the oldest is fixed, and after the solve the part is scaled
  about it so that the steps from keyframe to keyframe are as long as the front-end's, in the least-squares sense.
  Fixing the first two keyframes instead would take the scale from one short step, and keep its direction's error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core.problem import Problem

# A fixed keyframe with fewer observations takes part, but is not relied on to hold anything.
_ANCHOR_OBSERVATIONS = 10
# Steps whose lengths differ by this factor more than those of most of the way say nothing about the scale.
_RATIO = 3.0
# Cameras of a rig nearer to each other (m) show no scale.
_MIN_BASELINE_M = 1e-6


@dataclass(frozen=True)
class Gauge:
    """What fixes the gauge of a problem."""

    fixed: BoolArray  # (n_kf,) keyframes whose pose is held
    unscaled: IntArray  # (n_kf,) for a keyframe of a part whose scale floats the number of its fixed keyframe, else -1


def choose(problem: Problem, old: BoolArray, tied: BoolArray) -> Gauge:
    """Choose what holds a problem.

    Keyframes are oldest first. Those ``old`` (n_kf,) are fixed in any case; where ``tied`` (n_kf - 1,), one is tied to
    the next by a step of the front-end.
    """
    obs, n_kf = problem.observations, problem.n_keyframes
    fixed, unscaled = old.copy(), np.full(n_kf, -1)
    if tied.all() and old.any():  # ties hold all of it, one to the other, as in most windows
        return Gauge(fixed, unscaled)
    part_of = _parts(problem, tied)
    has_tie = np.zeros(n_kf, bool)
    has_tie[:-1] |= tied
    has_tie[1:] |= tied
    strong = has_tie
    if not strong.all():
        strong = has_tie | (np.bincount(obs.keyframe, minlength=n_kf) >= _ANCHOR_OBSERVATIONS)
    parts = [part_of == part for part in (np.unique(part_of) if part_of.any() else (0,))]
    # To look for what shows the scale takes as long as all the rest; poses that are held and steps show it too.
    known = all((members & old).any() and (members & has_tie).any() for members in parts)
    shows_scale = np.zeros(n_kf, bool) if known else _shows_scale(problem)
    for members in parts:
        free = np.flatnonzero(members & ~old)
        scaled = bool(np.any(shows_scale & members))
        needed = 1 if scaled or np.any(members & has_tie) else 2
        missing = needed - int(np.count_nonzero(members & old & strong))
        if not scaled and not np.any(members & old):
            fixed[free[:1]] = True
            unscaled[members] = free[0]
        elif missing > 0:
            fixed[free[:missing]] = True
    return Gauge(fixed, unscaled)


def step_ratio(measured: FloatArray, estimated: FloatArray) -> float:
    """Return the scale that makes the steps between estimated positions as long as between measured ones.

    Least squares over the lengths of those consecutive steps that agree; 1 where there is nothing to compare. Positions
    are (n, 3), by the front-end (m) and in the scale of the problem.
    """
    long = np.linalg.norm(np.diff(measured, axis=0), axis=1)
    short = np.linalg.norm(np.diff(estimated, axis=0), axis=1)
    kept = agreeing_steps(long, short)
    top, bottom = float(long[kept] @ short[kept]), float(short[kept] @ short[kept])
    return top / bottom if top > 0 and bottom > 0 and np.isfinite(top / bottom) else 1.0


def agreeing_steps(measured: FloatArray, estimated: FloatArray) -> BoolArray:
    """Return which steps have about the ratio of lengths that most of the way has, (n,): a front-end may jump.

    Lengths are (n,), by the front-end (m) and in the scale of the problem.
    """
    ratio = np.where(estimated > 0, measured / np.where(estimated > 0, estimated, 1.0), np.inf)
    order = np.argsort(ratio)
    travelled = np.cumsum(estimated[order])
    if not len(order) or travelled[-1] <= 0:
        return np.ones(len(measured), bool)
    middle = ratio[order[np.searchsorted(travelled, 0.5 * travelled[-1])]]
    return np.asarray((ratio <= _RATIO * middle) & (ratio * _RATIO >= middle))


def _parts(problem: Problem, tied: BoolArray) -> IntArray:
    """Return for each keyframe the first keyframe that it is connected with over common points and ties."""
    obs, n_kf, n_points = problem.observations, problem.n_keyframes, problem.n_points
    if tied.all():
        return np.zeros(n_kf, np.intp)
    # A tie connects as a point does that both keyframes see.
    ties = np.flatnonzero(tied)
    keyframe = np.concatenate([obs.keyframe, ties, ties + 1])
    point = np.concatenate([obs.point, n_points + ties, n_points + ties])
    label = np.arange(n_kf)
    while True:
        by_point = np.full(n_points + n_kf, n_kf)
        np.minimum.at(by_point, point, label.take(keyframe))
        spread = label.copy()
        np.minimum.at(spread, keyframe, by_point.take(point))
        # Labels name keyframes, so a label's own label is a shortcut: long chains settle in few rounds.
        spread = spread[spread]
        if np.array_equal(spread, label) or not spread.any():
            return spread
        label = spread


def _shows_scale(problem: Problem) -> BoolArray:
    """Return which keyframes (n_kf,) see what fixes the scale.

    That is a depth, or a point that another of its cameras sees from another place.
    """
    obs, cams = problem.observations, problem.cameras
    found = np.zeros(problem.n_keyframes, bool)
    if len(obs.depth_m):
        found[obs.keyframe[np.isfinite(obs.depth_m)]] = True
    centres = -(np.swapaxes(cams.rotation, -1, -2) @ cams.translation[:, :, None])[..., 0]
    if np.linalg.norm(np.ptp(centres, axis=0)) <= _MIN_BASELINE_M:
        return found
    # Rows are sorted by point, keyframe, camera: the views of one point from one keyframe are neighbours.
    second = 1 + np.flatnonzero((obs.point[1:] == obs.point[:-1]) & (obs.keyframe[1:] == obs.keyframe[:-1]))
    baseline = centres.take(obs.camera[second], axis=0) - centres.take(obs.camera[second - 1], axis=0)
    found[obs.keyframe[second[np.sum(baseline * baseline, axis=1) > _MIN_BASELINE_M**2]]] = True
    return found
