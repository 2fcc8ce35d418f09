# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of a young map whether its steps are all longer or shorter than the front-end's by one factor, or all aside.

A focal length, a baseline or a unit of depths that is wrong by a few percent stretches the map along the view, and on a
straight way nothing in the images contradicts that: each solve explains its tracks and stays within the bounds of a
single step. Its error grows with the way. So the steps of all refined keyframes are taken together: with r_k the ratio
of the k-th refined step to the front-end's, both along the mean of the two, the trimmed mean of log r_k is compared
with its standard error. Noise of the front-end averages out, a factor stays.

A principal point that is wrong by some pixels shears the map where the cameras do not turn, and a camera that is turned
on the body turns its steps: so their directions, in the body, are compared in the same way, axis by axis.

Which of the two is right cannot be told from here, so what came in stands and both are named. Nothing is asked where
something absolute places the map, and of a map that is no longer young; of lengths nothing where images have no scale
of their own (one camera, no depths).

What changes on the way, as when a lens is zoomed, shows in the newest steps alone: they are asked by themselves.

Where much of what is seen moves, objects carry a solution along for a while, and it explains them well. The front-end
errs alike all the time, so there each stretch of steps is compared with how the steps of all scatter: means of the
differences of moves and turns d, n of them, leave ``n sum(mean(d)^2 / sigma^2)``, sigma by the median of all, which is
chi-square of six degrees of freedom where nothing carries it along.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding, angle
from ba_node.check.exposure import find_late
from ba_node.check.tracks import tracks_of
from ba_node.check.watch import NEWEST, Check
from ba_node.core import geometry
from ba_node.core.cameras import FX, FY
from ba_node.core.loss import robust_spread
from ba_node.scene.scene import Scene

# Factors beyond which lengths are said to differ, each if it is so many standard errors from 1 (one pair is enough):
# rigs and wheels are known better, and odometry that shows a smaller factor so clearly is precise. Directions differ by
# as much aside.
Limits = tuple[tuple[float, float], ...]
_FACTORS: Limits = ((1.015, 4.5), (1.012, 8.0))
# At the end, when it is asked but once, fewer standard errors do: 2 or 3 in 10 000 sound drives have as many by chance,
# in lengths or along an axis, and two in three with a baseline that is 2 % off. Of directions it is a warning alone, as
# cameras are seldom mounted to better than half a degree.
_AT_THE_END: Limits = ((1.012, 3.6),)
# Odometry that shows a turn so plainly is more precise than cameras are mounted: with 0.4 to 1 degree aside maps of 60
# keyframes ended up to six times as wrong. Sound drives show less than 0.1 degrees with more than 3 standard errors.
_PLAIN: Limits = ((1.007, 10.0),)
# With as much the set-up may have changed: the newest keyframes are worth a look with all tests.
_WORTH_A_LOOK: Limits = ((1.012, 2.4),)
# Too little to say so, too much to trust lengths: one in 60 sound drives shows as much by chance.
_HARDLY_CHANCE: Limits = ((1.004, 2.4),)
# Fewer steps than so many hardly tell what is chance: there lengths by images stand only if they are off by less, or by
# fewer standard errors, as where the front-end's steps scatter widely.
_MANY, _LITTLE, _FEW_ERRORS = 25, 1.012, 1.8
# Few steps tell their own spread badly: n of them need 1 + (this / n)^1.5 times as many standard errors, about what
# Student's distribution asks for.
_FEW = 8.0
# Where images have no scale, noise turns all steps of a straight way to one side together: directions differ by so many
# times as much.
_ONE_CAMERA = 1.5
# Steps that are needed, at the end and before it, where the tests of the set-up may yet name a cause more closely; and
# keyframes up to which a map is young.
_STEPS, _STEPS_BEFORE, _YOUNG = 7, 15, 120
# It is asked once in so many keyframes, and at the end.
_EVERY = 5
# Shorter steps are noise, as those of a robot that stands or turns on the spot, m.
_LEAST_M = 0.02
# Steps of a stretch, and what its score is at least where objects carried it along: stereo drives of which 30 to 60 %
# moves show 25 where the result is better than what came in, 32 to 200 where it is worse. One camera's scale errs so.
_STRETCH, _CARRIED, _CARRIED_WHERE_MOST_MOVES = 12, 60.0, 35.0
# Cosines between where a camera looks and where it moves, from which on a focal length turns steps, and scales them.
_ASIDE, _AHEAD = 0.95, 0.2
# Part of a turn that may be out of the plane of these two, for a focal length to explain it.
_IN_PLANE = 0.5
_K = "k of camera_info in camera_rig"
# Steps that are more standard deviations off the others are drawn in to so many.
_USUAL = 3.0
# Neighbours err alike where they correlate by more than so many standard errors; the largest correlation that counts,
# and the share of the variance that their own mean leaves at least.
_ALIKE, _MOST_ALIKE, _LEFT = 2.0, 0.95, 0.1
# Standard errors by which the lengths that windows told of one camera may be off those that all steps tell.
_LIKELY = 4.2
# Share of a way by which its ends are apart where it does not come back.
_STRAIGHT = 0.7
# Share of the usual step below which one tells nothing; share that is left out at either end of their ratios.
_TELLING, _TRIMMED = 0.3, 0.1


def departed(scene: Scene, *, final: bool = False, doubted: bool = False) -> Check | None:
    """Return what is wrong if the refined steps of a young map are off the front-end's by one factor or to one side.

    ``final``: no more keyframes will come, so that it is asked at any number of them, and of directions too: another
    test of the set-up would have told by now that two cameras do not fit each other. ``doubted``: less is enough of
    directions, for a warning alone.
    """
    count, least = len(scene.keyframes), _STEPS if final else _STEPS_BEFORE
    if (count % _EVERY and not final) or not least < count <= _YOUNG or scene.cameras is None:
        return None
    if scene.constraints.absolute or scene.constraints.landmarks:
        return None
    refined, given = _steps(scene)
    if len(refined) < least:
        return None
    sure = final and "moving" not in scene.log.warnings
    by_length, aside = _AT_THE_END if sure or doubted else _FACTORS, _AT_THE_END if doubted else (*_FACTORS, *_PLAIN)
    finding = _by_a_factor(scene, refined, given, by_length) if has_scale(scene) else None
    if final:
        finding = finding or _aside(scene, refined, given, aside)
    if final and not doubted:
        finding = finding or _of_the_newest(scene, _FACTORS) or carried(scene)
    if finding is None:
        return None
    found = Diagnosis([dataclasses.replace(finding, harmful=not doubted)])
    tracks = tracks_of(scene) if found.harmful and two_view.available() else None
    if tracks is not None:
        found = find_late(tracks, found)
    return Check(scene, lambda: found, found)


def deviates(scene: Scene, *, final: bool = False) -> bool:
    """Return True if the newest refined steps are so far off the front-end's that the set-up is worth a look."""
    if len(scene.keyframes) % _EVERY and not final:
        return False
    return _of_the_newest(scene, _WORTH_A_LOOK, look=True) is not None


def _of_the_newest(scene: Scene, limits: Limits, *, look: bool = False) -> Finding | None:
    """Return what is wrong with the newest steps; for a ``look`` lengths count even where images have no scale."""
    if scene.cameras is None or scene.constraints.absolute or scene.constraints.landmarks:
        return None
    refined, given = _steps(scene, NEWEST)
    if len(refined) <= _STEPS:
        return None
    by_a_factor = look or has_scale(scene)
    return (_by_a_factor(scene, refined, given, limits) if by_a_factor else None) or _aside(
        scene, refined, given, limits
    )


def _by_a_factor(scene: Scene, refined: FloatArray, given: FloatArray, limits: Limits) -> Finding | None:
    """Return what is wrong if refined steps (n, 3) are longer or shorter than the given ones."""
    factor = _factor(scene, refined, given, limits)
    if factor == 1.0:
        return None
    evidence = f"refined steps are {factor:.3g} times as long as the front-end's, over {len(given)} of them"
    if _measures_depths(scene):
        by, ours = "depth_m tells", f"scale of depth_m: it is {factor:.3g} times what the front-end's steps tell"
        causes = {ours: "the factor from depth images to depth_m in the feature_tracks"}
        ahead = float(_seen(scene, _along(scene, refined, given).mean(axis=0))[2])
        if abs(ahead) < _ASIDE:
            # It scales what lies across the axis alone.
            causes[_focal(1.0 + (1.0 / factor - 1.0) / (1.0 - ahead**2))] = _K
    else:
        by = "the cameras tell"
        ours = f"scale of focal length or baseline: lengths are {factor:.3g} times what the front-end's steps tell"
        causes = {ours: "k in the camera_info, or body_from_camera, of the camera_rig"}
    steps = f"scale of the front-end's steps: they are {1.0 / factor:.3g} times what {by}"
    causes[steps] = "the position in the keyframes, expected metres"
    return Finding(tuple(causes), evidence, tuple(causes.values()))


def _factor(scene: Scene, refined: FloatArray, given: FloatArray, limits: Limits) -> float:
    """Return by what factor refined steps (n, 3) are longer than the given ones; 1 where that may be chance."""
    along = _along(scene, refined, given)
    ratio = np.sum(refined * along, axis=1) / np.sum(given * along, axis=1)
    mean, error = trimmed_mean(np.log(ratio))
    return float(np.exp(mean)) if _differs(mean, error, len(given), limits) else 1.0


def _along(scene: Scene, refined: FloatArray, given: FloatArray) -> FloatArray:
    """Return (n, 3) along what the lengths of steps are compared."""
    # Where the front-end moves in a plane it has of a step what lies along its own.
    return given if geometry.is_planar(scene.keyframes.input_position) else refined + given


def length_factor(scene: Scene) -> float:
    """Return by what factor refined steps of a young map are longer than the front-end's where these tell it better.

    Where images tell lengths, that is where the difference is hardly chance. It is 1 elsewhere, and where lengths are
    told by more than the two.
    """
    known = scene.constraints
    alone = not (known.absolute or known.landmarks or known.relative)
    if not (alone and len(scene.keyframes) <= _YOUNG) or scene.cameras is None:
        return 1.0
    refined, given = _steps(scene)
    if has_scale(scene):
        n = len(refined)
        limits = _HARDLY_CHANCE if n >= _MANY else ((_LITTLE, _FEW_ERRORS / more_errors(n)),)
        return _factor(scene, refined, given, limits) if n else 1.0
    return _of_one_camera(scene, refined, given) if len(refined) >= _STEPS_BEFORE else 1.0


def _of_one_camera(scene: Scene, refined: FloatArray, given: FloatArray) -> float:
    """Return by what factor refined steps (n, 3) are longer than the given ones, which alone tell lengths.

    All together tell them better than a few at a time did in windows, each with a loss. It stays 1 where many are far
    off the others, and on a way that comes back: there turns are what the front-end errs by.
    """
    way = scene.keyframes.position[scene.order]
    if np.linalg.norm(way[-1] - way[0]) < _STRAIGHT * np.sum(np.linalg.norm(np.diff(way, axis=0), axis=1)):
        return 1.0
    along = _along(scene, refined, given)
    ratio = np.log(np.sum(refined * along, axis=1) / np.sum(given * along, axis=1))
    middle = float(np.median(ratio))
    sigma = float(robust_spread(ratio - middle))
    within = np.clip(ratio, middle - _USUAL * sigma, middle + _USUAL * sigma)
    # Noise aside makes steps longer, by twice as much as that along them lowers the mean of the logarithm.
    mean = float(np.average(within, weights=np.linalg.norm(refined, axis=1))) + 0.5 * sigma**2
    return float(np.exp(mean)) if abs(mean) < _LIKELY * sigma / np.sqrt(len(ratio)) else 1.0


def _aside(scene: Scene, refined: FloatArray, given: FloatArray, limits: Limits) -> Finding | None:
    """Return what is wrong if refined steps (n, 3) point to another side of the body than the given ones."""
    lengths = np.linalg.norm(refined, axis=1) * np.linalg.norm(given, axis=1)
    turns = np.cross(given, refined) / lengths[:, None]
    found = [trimmed_mean(of_axis) for of_axis in turns.T]
    times = 1.0 if has_scale(scene) else _ONE_CAMERA
    if not any(_differs(mean, error, len(given), limits, times) for mean, error in found):
        return None
    assert scene.cameras is not None
    turn = np.array([mean for mean, _ in found])
    focal = float(np.mean(scene.cameras.params[0, [FX, FY]]))
    px = focal * float(np.linalg.norm((scene.cameras.rotation[0] @ turn)[:2]))
    degrees = angle(float(np.degrees(np.linalg.norm(turn))))
    evidence = f"refined steps point {degrees} aside of the front-end's, over {len(turns)} of them"
    region = f"region of interest not applied, or principal point wrong, by about {px:.0f} px"
    place = f"camera 0 does not fit its place on the body by about {degrees}"
    changes = (
        "roi in camera_info in camera_rig, or subtract its offset from the principal point in k",
        "body_from_camera in camera_rig (or tf_static), or the pose in the keyframes if it is not that of the body",
    )
    way = given.mean(axis=0)
    towards, aside = _seen(scene, way), _seen(scene, way + np.cross(turn, way))
    if min(abs(towards[2]), abs(aside[2])) > _AHEAD and abs(towards[2]) < _ASIDE:
        # A focal length turns the way in its plane with the axis.
        flat, bent = towards[:2] / towards[2], aside[:2] / aside[2]
        factor = float(flat @ flat / (bent @ flat))
        if np.linalg.norm(bent - flat / factor) < _IN_PLANE * np.linalg.norm(bent - flat):
            return Finding((_focal(factor), place, region), evidence, (_K, *changes[::-1]))
    return Finding((region, place), evidence, changes)


def _seen(scene: Scene, move: FloatArray) -> FloatArray:
    """Return the direction (3,) of a move in the body as camera 0 sees it."""
    assert scene.cameras is not None
    return np.asarray(scene.cameras.rotation[0] @ move / max(float(np.linalg.norm(move)), 1e-12))


def _focal(factor: float) -> str:
    return f"focal length off by a factor of about {factor:.2f}"


def carried(scene: Scene, *, mostly: bool = False) -> Finding | None:
    """Return where what moves has carried refined steps along, if it was said that much does, or ``mostly`` all."""
    if not mostly and ("moving" not in scene.log.warnings or not has_scale(scene)):
        return None
    pairs = _telling(scene)
    if len(pairs[0]) < 2 * _STRETCH:
        return None
    table = scene.keyframes
    turn, refined = geometry.steps_between(table.rotation, table.position, *pairs)
    turned, given = geometry.steps_between(table.input_rotation, table.input_position, *pairs)
    off = np.hstack([refined - given, geometry.so3_log(np.swapaxes(turned, 1, 2) @ turn)])
    sigma = np.maximum(robust_spread(off), 1e-9)
    sums = np.cumsum(np.vstack([np.zeros(6), off]), axis=0)
    means = (sums[_STRETCH:] - sums[:-_STRETCH]) / _STRETCH
    scores = _STRETCH * np.sum((means / sigma) ** 2, axis=1)
    k = int(np.argmax(scores))
    if scores[k] < (_CARRIED_WHERE_MOST_MOVES if mostly else _CARRIED):
        return None
    first, last = (int(table.keyframe_id[row]) for row in (pairs[0][k], pairs[1][k + _STRETCH - 1]))
    aside, angle_deg = np.linalg.norm(means[k, :3]), np.degrees(np.linalg.norm(means[k, 3:]))
    cause = f"what moves carried the solution along from keyframe {first} to {last}, where most of what is seen moves"
    evidence = (
        f"refined steps there are off the front-end's to one side, by {aside:.2g} m and {angle(float(angle_deg))} each,"
        " and elsewhere they are not"
    )
    return Finding((cause,), evidence, ("what the feature_tracks follow: leave out people, vehicles and the like",))


def _differs(mean: float, error: float, count: int, limits: Limits, times: float = 1.0) -> bool:
    error *= more_errors(count)
    return any(abs(mean) >= max(times * np.log(factor), errors * error) for factor, errors in limits)


def more_errors(count: int) -> float:
    """Return how many times as many standard errors so few steps need."""
    return float(1.0 + (_FEW / max(count, 1)) ** 1.5)


def has_scale(scene: Scene) -> bool:
    """Return True if images tell lengths."""
    return scene.cameras is not None and (len(scene.cameras.model) > 1 or _measures_depths(scene))


def _measures_depths(scene: Scene) -> bool:
    return bool(np.isfinite(scene.observations.depth_m[:1000]).any())


def _steps(scene: Scene, newest: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return refined and given steps, (n, 3) m in the body, of those long enough to tell; of all or the newest."""
    table, pairs = scene.keyframes, _telling(scene, newest)
    _, refined = geometry.steps_between(table.rotation, table.position, *pairs)
    _, given = geometry.steps_between(table.input_rotation, table.input_position, *pairs)
    return refined, given


def _telling(scene: Scene, newest: int = 0) -> IntArray:
    """Return the rows (2, n) of keyframes between which steps are long enough to tell."""
    table, order = scene.keyframes, scene.order[-newest - 1 if newest else 0 :]
    both = table.refined[order[1:]] & table.refined[order[:-1]]
    pairs = np.stack([order[:-1][both], order[1:][both]])
    _, refined = geometry.steps_between(table.rotation, table.position, *pairs)
    _, given = geometry.steps_between(table.input_rotation, table.input_position, *pairs)
    along = refined + given
    length = np.sqrt(np.sum(along**2, axis=1))
    least = max(_LEAST_M, 0.5 * _TELLING * float(np.median(length))) if len(length) else 0.0
    telling = np.sum(refined * along, axis=1) > 0.0
    telling &= (np.sum(given * along, axis=1) > 0.0) & (0.5 * length > least)
    return pairs[:, telling]


def trimmed_mean(values: FloatArray) -> tuple[float, float]:
    """Return the mean without the extremes and its standard error, by the spread of the values drawn in to these.

    Values are in the order of time: where neighbours err alike, as where odometry's errors wander, few are independent.
    """
    low = int(_TRIMMED * len(values))
    in_order = np.sort(values)
    kept = in_order[low : len(values) - low]
    drawn_in = np.clip(values, kept[0], kept[-1])
    spread = float(np.std(drawn_in, ddof=min(len(values) - 1, 1)))
    error = spread / ((1.0 - 2.0 * _TRIMMED) * float(np.sqrt(len(values))))
    return float(np.mean(kept)), error * _wanders(drawn_in)


def _wanders(values: FloatArray) -> float:
    """Return how many times as large the standard error of a mean is as if n values were independent.

    With the correlation r of neighbours, ``g = (1 + r) / (1 - r)`` of them tell as much as one (autoregression of first
    order), and their spread about their own mean is that of 1 - g / n of the variance. The r that is found is raised by
    ``(1 + 3 r) / n``, as much as it is too low (Kendall, *Note on bias in the estimation of autocorrelation*, 1954).
    """
    off, n = values - np.mean(values), len(values)
    r = float(off[1:] @ off[:-1]) / max(float(off @ off), 1e-300)
    if r <= _ALIKE / np.sqrt(n):
        return 1.0
    r = min(r + (1.0 + 3.0 * r) / n, _MOST_ALIKE)
    g = (1.0 + r) / (1.0 - r)
    return float(np.sqrt(g / max(1.0 - g / n, _LEFT)))
