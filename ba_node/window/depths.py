# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare measured depths with those at which a solution has the points.

Where they become wrong on the way, as in another unit, most tracks have their place already. Then they are outliers
among others, the images go on without them, and the solution is a good one: somebody has to be told all the same.
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core.problem import Problem, State
from ba_node.core.units import unit_of
from ba_node.scene.scene import Scene
from ba_node.window.selection import Selection

# A depth that is off by this factor is wrong.
_WRONG = 1.5
# A keyframe has wrong depths where so many, and this share, of them are; it takes so many keyframes.
_MANY, _SHARE, _KEYFRAMES = 8, 0.5, 3
# They are off by one factor where half of them agree on it to this much (of its logarithm).
_AGREE = 0.2


def expected(problem: Problem, state: State, rows: IntArray) -> FloatArray:
    """Return at which depth a solution has the points of some observations, (n,) m."""
    obs, cams = problem.observations, problem.cameras
    camera, keyframe = obs.camera[rows], obs.keyframe[rows]
    body = (state.rotation[keyframe] @ state.points[obs.point[rows]][:, :, None])[..., 0] + state.translation[keyframe]
    return np.asarray(np.sum(cams.rotation[camera, 2] * body, axis=1) + cams.translation[camera, 2])


def note_wrong(scene: Scene, selection: Selection, state: State) -> None:
    """Say so where most of the depths of some keyframes contradict a solution that is taken."""
    obs = selection.observations
    if not len(obs.depth_m):
        return
    rows = np.flatnonzero(np.isfinite(obs.depth_m))
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.log(obs.depth_m[rows] / expected(selection.whole, state, rows))
    known = np.isfinite(off)
    rows, off = rows[known], off[known]
    keyframe, n = obs.keyframe[rows], len(selection.keyframes)
    wrong = np.abs(off) > np.log(_WRONG)
    count, of = np.bincount(keyframe, wrong, n), np.bincount(keyframe, minlength=n)
    where = (count >= _MANY) & (count > _SHARE * of)
    if np.count_nonzero(where) < _KEYFRAMES:
        return
    ids = selection.keyframe_id[where]
    mine = off[wrong & where[keyframe]]
    middle = float(np.median(mine))
    if np.median(np.abs(mine - middle)) < _AGREE:
        factor = float(np.exp(middle))
        how = f"{factor:.4g} times what images and steps tell, as if {unit_of(factor) or 'in another unit'}"
    else:
        how = "far off what images and steps tell"
    scene.log.warn(
        "depths",
        f"most depth_m of {len(ids)} keyframes ({ids[0]} to {ids[-1]}) are {how}: they are left out; expected are"
        " metres along the optical axis throughout",
    )
