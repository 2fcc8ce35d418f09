# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of a young map whether its steps are all longer or shorter than the front-end's by one factor.

A focal length, a baseline or a unit of depths that is wrong by a few percent stretches the map along the view, and on a
straight way nothing in the images contradicts that: each solve explains its tracks and stays within the bounds of a
single step. Its error grows with the way. So the steps of all refined keyframes are taken together: with r_k the ratio
of the k-th refined step to the front-end's, both along the mean of the two, the trimmed mean of log r_k is compared
with its standard error. Noise of the front-end averages out, a factor stays.

Which of the two is right cannot be told from here, so what came in stands and both are named. Nothing is asked where
images have no scale of their own (one camera, no depths), where something absolute gives the map its scale, and of a
map that is no longer young.
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.watch import Check
from ba_node.scene.scene import Scene

# Factors beyond which lengths are said to differ, each if it is so many standard errors from 1: rigs and wheels are
# known better, and odometry that shows a smaller factor so clearly is precise.
_FACTORS = ((1.025, 5.0), (1.012, 8.0))
# Steps that are needed, and keyframes up to which a map is young.
_STEPS, _YOUNG = 15, 120
# It is asked once in so many keyframes.
_EVERY = 5
# Shorter steps are noise, as those of a robot that stands or turns on the spot, m.
_LEAST_M = 0.02
# Share of the usual step below which one tells nothing; share that is left out at either end of their ratios.
_TELLING, _TRIMMED = 0.3, 0.1


def departed(scene: Scene) -> Check | None:
    """Return what is wrong if the refined steps of a young map are off the front-end's by one factor; else None."""
    count = len(scene.keyframes)
    if count % _EVERY or not _STEPS < count <= _YOUNG or not _has_scale(scene):
        return None
    ratio = _ratios(scene)
    if len(ratio) < _STEPS:
        return None
    mean, error = _trimmed_mean(np.log(ratio))
    if not any(abs(mean) >= max(np.log(factor), errors * error) for factor, errors in _FACTORS):
        return None
    factor = float(np.exp(mean))
    evidence = f"refined steps are {factor:.3g} times as long as the front-end's, over {len(ratio)} of them"
    if _measures_depths(scene):
        by, ours = "depth_m tells", f"scale of depth_m: it is {factor:.3g} times what the front-end's steps tell"
        change = "the factor from depth images to depth_m in the feature_tracks"
    else:
        by = "the cameras tell"
        ours = f"scale of focal length or baseline: lengths are {factor:.3g} times what the front-end's steps tell"
        change = "k in the camera_info, or body_from_camera, of the camera_rig"
    steps = f"scale of the front-end's steps: they are {1.0 / factor:.3g} times what {by}"
    change_of_steps = "the position in the keyframes, expected metres"
    found = Diagnosis([Finding((ours, steps), evidence, (change, change_of_steps))])
    return Check(scene, lambda: found, found)


def _has_scale(scene: Scene) -> bool:
    known = scene.constraints
    if scene.cameras is None or known.absolute or known.landmarks:
        return False
    return len(scene.cameras.model) > 1 or _measures_depths(scene)


def _measures_depths(scene: Scene) -> bool:
    return bool(np.isfinite(scene.observations.depth_m[:1000]).any())


def _ratios(scene: Scene) -> FloatArray:
    """Return the ratio of each refined step to the front-end's, of those that are long enough to tell, (n,)."""
    table, order = scene.keyframes, scene.order
    both = table.refined[order[1:]] & table.refined[order[:-1]]
    first, second = order[:-1][both], order[1:][both]
    refined = _moves(table.rotation, table.position, first, second)
    given = _moves(table.input_rotation, table.input_position, first, second)
    along = refined + given
    length = np.sqrt(np.sum(along**2, axis=1))
    ours, theirs = (np.sum(one * along, axis=1) / np.maximum(length, 1e-12) for one in (refined, given))
    least = max(_LEAST_M, 0.5 * _TELLING * float(np.median(length))) if len(length) else 0.0
    telling = (ours > 0.0) & (theirs > 0.0) & (0.5 * length > least)
    return np.asarray(ours[telling] / theirs[telling])


def _moves(rotation: FloatArray, position: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """Return the moves between keyframes in the body of the first, (n, 3) m."""
    back = np.swapaxes(rotation[first], 1, 2)
    return np.asarray((back @ (position[second] - position[first])[:, :, None])[..., 0])


def _trimmed_mean(values: FloatArray) -> tuple[float, float]:
    """Return the mean without the extremes and its standard error, by the spread of the values drawn in to these."""
    values = np.sort(values)
    cut = int(_TRIMMED * len(values))
    kept = values[cut : len(values) - cut]
    drawn_in = np.clip(values, kept[0], kept[-1])
    error = float(np.std(drawn_in, ddof=1)) / ((1.0 - 2.0 * _TRIMMED) * float(np.sqrt(len(values))))
    return float(np.mean(kept)), error
