# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say that absolute measurements contradict the map, each by itself or with its neighbours in time.

One that lies far beside the map is wrong. A reference that changes by no more than a few standard deviations of a
measurement shows in no single one, but all of a stretch then lie to the same side, by more than their noise leaves of
their median, and far enough for a solve of everything to be worth it (``factors.adjust_m``).
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import BoolArray, FloatArray
from ba_node.config import FactorsConfig
from ba_node.scene.scene import Scene
from ba_node.window import constraints

# Measurements so many standard deviations beside the map contradict it; so do so many in a row whose median is this far
# off. By noise alone that of ten is 0.4 off, and 0.45 with what the map is off.
_BESIDE, _ROW, _TOGETHER = 5.0, 10, 1.3
# It is said if so many do, and this share.
_MANY, _TOO_MANY = 5, 0.2


def say_contradicted(scene: Scene, config: FactorsConfig) -> None:
    """Say that many absolute measurements lie beside the map, where the others, or images, have outvoted them."""
    known, log = scene.constraints, scene.log
    log.warnings.pop("contradicted", None)
    pairs = constraints.every_pair(scene, config, everything=True)
    if known.map_from_world is None or not len(pairs):
        return
    rotation, translation = known.map_from_world
    off = pairs.position @ rotation.T + translation - pairs.points(scene)
    sigma = np.sqrt(np.trace(pairs.covariance[:, 3:, 3:], axis1=1, axis2=2))
    off_m = np.linalg.norm(off, axis=1)
    jumped = np.zeros(len(pairs), bool)
    for source, since, to in known.left_out:
        jumped |= (pairs.source == source) & (pairs.stamp_ns >= since) & (pairs.stamp_ns <= to)
    wrong = jumped | (off_m > _BESIDE * sigma) | _astray_together(off, sigma, config.adjust_m)
    count = int(np.count_nonzero(wrong))
    if count >= _MANY and count > _TOO_MANY * len(pairs):
        stamps = scene.keyframes.stamp_ns[pairs.row[wrong]]
        log.warn(
            "contradicted",
            f"{count} of {len(pairs)} priors in frame {known.world_frame!r} lie {np.median(off_m[wrong]):.1f} m beside"
            f" the map (median), from {stamps.min() * 1e-9:.3f} to {stamps.max() * 1e-9:.3f} s: they contradict the"
            " others, or images and odometry, or their covariance is too small. Did their source change its reference?"
            f"{_left_out(int(np.count_nonzero(jumped)))}",
        )


def _left_out(count: int) -> str:
    return f" {count} are of stretches that odometry and images show to have jumped, and take no part." if count else ""


def _astray_together(off: FloatArray, sigma: FloatArray, least_m: float) -> BoolArray:
    """Return which measurements lie beside the map as their neighbours do, (n,).

    ``off`` (n, 3) m is how far, in the order of time, with standard deviations ``sigma`` (n,) m of all axes together.
    """
    wrong = np.zeros(len(off), bool)
    for some in np.array_split(np.arange(len(off)), max(len(off) // _ROW, 1)):
        middle_m = float(np.linalg.norm(np.median(off[some], axis=0)))
        wrong[some] = len(some) >= _ROW and middle_m > max(least_m, _TOGETHER * float(np.median(sigma[some])))
    return wrong
