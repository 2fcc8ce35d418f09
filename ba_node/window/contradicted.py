# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say that absolute measurements contradict the map, each by itself or with its neighbours in time.

One that lies far beside the map is wrong. A reference that changes by no more than a few standard deviations of a
measurement shows in no single one, but all of a stretch then lie to the same side, by more than their noise leaves of
their median, and far enough for a solve of everything to be worth it (``factors.adjust_m``).

One that drifts by degrees draws the map along, and nothing lies beside it. Where the covariance of steps was told,
as of wheels, both are held against each other whatever the map made of them: with the steps put together, each
turned as the map has the keyframe that it begins at, what was measured at both ends of a stretch may differ from
where they lead by what the covariances leave, and by a share of the way, as wheels have a scale that no covariance
tells.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray, take_rows
from ba_node.config import FactorsConfig
from ba_node.core.units import unit_of
from ba_node.scene.scene import Scene
from ba_node.window import constraints

# Measurements so many standard deviations beside the map contradict it; so do so many in a row whose median is this far
# off. By noise alone that of ten is 0.4 off, and 0.45 with what the map is off.
_BESIDE, _ROW, _TOGETHER = 5.0, 10, 1.3
# It is said if so many do, and this share.
_MANY, _TOO_MANY = 5, 0.2
# Measurements and steps may drift apart by so many standard deviations; one of these is so much of the way.
_DRIFTED, _OF_WAY = 5.0, 0.003
# Names by source. Pairs of measurements whose distances are compared with the map's, and how nearly these agree.
_KINDS = {0: "pose priors", 1: "fixes of a receiver", constraints.LANDMARK: "landmark priors"}
_DISTANCES, _ALIKE = 300, 0.1
# Groups of measurements, at least _ROW in each, that are compared with each other.
_GROUPS = 60


def say_contradicted(scene: Scene, config: FactorsConfig) -> None:
    """Say that many absolute measurements lie beside the map, where the others, or images, have outvoted them.

    And that they drift away from steps.
    """
    known, log = scene.constraints, scene.log
    for kind in ("contradicted", "drifted"):
        log.warnings.pop(kind, None)
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
            f"{_left_out(int(np.count_nonzero(jumped)))}{likely(scene, take_rows(pairs, wrong))}",
        )
    for source in np.unique(pairs.source[~jumped]):
        of = ~jumped & (pairs.source == source)
        _say_drifted(scene, take_rows(pairs, of), off[of], config)


def likely(scene: Scene, pairs: constraints.Pairs, *, units_alone: bool = False) -> str:
    """Return of which kind measurements far beside the map are, and by how far apart they are what may be wrong.

    ``units_alone``: nothing is known to be, so that it is said if their unit is.
    """
    if not len(pairs):
        return ""
    kind = " and ".join(_KINDS[source] for source in np.unique(pairs.source).tolist())
    some = np.random.default_rng(0).integers(len(pairs), size=(2, _DISTANCES))
    told_m, map_m = (np.linalg.norm(np.subtract(*at[some]), axis=1) for at in (pairs.position, pairs.points(scene)))
    apart = (map_m > 0.5 * np.median(map_m)) & (map_m > 0.0) & (told_m > 0.0)
    ratio = np.log(told_m[apart] / map_m[apart])
    alike = len(pairs) >= _ROW and apart.any() and np.median(np.abs(ratio - np.median(ratio))) < _ALIKE
    factor = float(np.exp(np.median(ratio))) if alike else float("nan")
    if unit := unit_of(factor):
        why = f"their positions are {unit}, expected metres ({factor:.4g} times as far apart as in the map)"
    elif units_alone:
        return ""
    elif abs(np.log(factor)) < _ALIKE and (pairs.source == 0).any():
        why = (
            "their positions are as far apart as in the map, so look at their orientations: expected are poses of the"
            " body in that frame, not inverted, nor of a camera"
        )
    else:
        why = "expected are positions in metres, in that frame, of the body (fixes: the antenna, landmarks: the point)"
    return f" They are {kind}: {why}."


def _say_drifted(scene: Scene, pairs: constraints.Pairs, off: FloatArray, config: FactorsConfig) -> None:
    """Say that measurements of one source, ``off`` (n, 3) m beside the map, drift away from measured steps."""
    groups = min(len(pairs) // _ROW, _GROUPS)
    if groups < 2:
        return
    steps, place = _Steps.of(scene), scene.places()[pairs.row]
    parts = np.array_split(np.argsort(pairs.stamp_ns, kind="stable"), groups)
    at = place[[part[len(part) // 2] for part in parts]]
    variance = np.trace(pairs.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    noise = np.array([0.5 * np.pi * np.mean(variance[part]) / len(part) for part in parts])
    astray = off + steps.gap[place]
    middle = np.array([np.median(astray[part], axis=0) for part in parts])
    drift_m = np.linalg.norm(middle - middle[:, None], axis=2)
    way, walk, untold = (values[at] - values[at][:, None] for values in (steps.length_m, steps.variance, steps.untold))
    sigma = np.sqrt(noise + noise[:, None] + np.abs(walk) + (_OF_WAY * way) ** 2)
    times = np.triu(np.where((untold == 0) & (drift_m > config.adjust_m), drift_m / sigma, 0.0))
    i, j = np.unravel_index(int(np.argmax(times)), times.shape)
    if times[i, j] > _DRIFTED:
        since, to = (scene.keyframes.stamp_ns[scene.order[one]] * 1e-9 for one in at[[i, j]])
        scene.log.warn(
            "drifted",
            f"priors in frame {scene.constraints.world_frame!r} and measured steps drift apart by {drift_m[i, j]:.1f} m"
            f" over {way[i, j]:.0f} m of the way, from {since:.3f} to {to:.3f} s, {times[i, j]:.0f} times what their"
            " covariances leave: one of them drifts, or the wheels' size is not what was said. The map lies between.",
        )


@dataclass(frozen=True)
class _Steps:
    """Measured steps, put together: by keyframes in the order of time."""

    gap: FloatArray  # (n, 3) where the map has a keyframe less where they lead from the first one, m
    variance: FloatArray  # (n,) of where they lead along an axis, m^2
    length_m: FloatArray  # (n,) of the way
    untold: IntArray  # (n,) how many of the steps up to there have no covariance

    @classmethod
    def of(cls, scene: Scene) -> _Steps:
        """Return relative poses between consecutive keyframes, and steps of the front-end whose covariance it told."""
        table, order, known = scene.keyframes, scene.order, scene.constraints
        moved = np.diff(table.position[order], axis=0)
        back = np.swapaxes(table.input_rotation[order[:-1]], 1, 2)
        step = (back @ np.diff(table.input_position[order], axis=0)[:, :, None])[..., 0]
        variance = np.full(len(step), np.nan)
        for k, (one, other) in enumerate(itertools.pairwise(table.keyframe_id[order].tolist())):
            if other in known.steps:
                variance[k] = np.trace(known.steps[other][3:, 3:]) / 3.0
            for key in ((one, other), (other, one)):
                measured = known.relative.get(key)
                if measured is not None and not measured.is_loop:
                    step[k] = measured.position if key[0] == one else -measured.rotation.T @ measured.position
                    variance[k] = np.sum(np.linalg.inv(measured.root)[3:] ** 2) / 3.0
        gap = moved - (table.rotation[order[:-1]] @ step[:, :, None])[..., 0]
        gap = np.append(np.zeros((1, 3)), np.cumsum(gap, axis=0), axis=0)
        each = np.nan_to_num(variance), np.linalg.norm(moved, axis=1), np.isnan(variance)
        return cls(gap, *(np.append(0, np.cumsum(values)) for values in each))


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
