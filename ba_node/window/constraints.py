# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn what is known beside pixels into factors of a problem, and find where the map lies in the world.

**Pairing.** A pose prior or a fix of time t, between the keyframes a and b, tells of the nearer one, k: the front-end's
motion from a to b, at constant velocity, leads from k to the body at t. So what was measured at t is a measurement of
a point of the body at k, ``l' = p_kt + R_kt l``, l being the lever arm.

**The world.** The map begins where the front-end begins, the world where its surveyors or the first fix have it. Once
enough is known, ``map_from_world`` is the rotation and translation that bring the priors nearest to the keyframes that
they tell of: Kabsch's, from weighted pairs of positions, orientations, and the vertical, which both frames have by
REP-103, for what the rest does not tell. The pairs are weighted by Cauchy's loss, from the best of some minimal sets.
It is held until the next solve of everything begins, so that the map is drawn to where the world is, and no one fix
moves the map.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray, IntArray, join_rows, take_rows
from ba_node.config import Config, FactorsConfig
from ba_node.core import geometry
from ba_node.core.factors import RelativePoses
from ba_node.core.priors import Directions, PosePriors, root_information
from ba_node.core.problem import KeyframeFactors, PointPriors, Problem
from ba_node.scene.scene import Scene

_LOSS = "cauchy"
# Standard deviation of the vertical of one frame in the other, rad; and of an orientation that was not measured.
_LEVEL_RAD = 0.05
UNKNOWN = 1e6
# What a pair is from where it is a landmark.
LANDMARK = 2
# Pairs that map and world are aligned by, spread over all.
_ALIGNED = 2000
# Minimal sets that are tried, pairs in each, pairs that score them, rounds of weighting; what share of pairs is right.
_SURE = 0.3
_SETS, _IN_SET, _SCORED, _ROUNDS = 60, 5, 300, 10
# The path has to spread so many times the noise of positions, and the heading to be known to so much (rad).
_SPREAD, _HEADING_RAD = 5.0, 0.03
# What a relative pose is sure of to less than this (1/rad, 1/m) it does not measure.
_NOTHING = 0.01

# What a program that embeds the back-end adds: (scene, problem, rows of its keyframes in the scene) -> factors.
Source = Callable[[Scene, Problem, IntArray], tuple[KeyframeFactors, ...]]
SOURCES: list[Source] = []


@dataclass(frozen=True)
class Pairs:
    """Absolute measurements and the keyframes that they tell of."""

    row: IntArray  # (n,) of the keyframe in the scene
    lever_arm: FloatArray  # (n, 3) of the point in its body, m
    position: FloatArray  # (n, 3) of the point in the world, m
    rotation: FloatArray  # (n, 3, 3) world from the keyframe's body, as measured; unit where it was not
    covariance: FloatArray  # (n, 6, 6) rotation about the body's axes, then position
    stamp_ns: NDArray[np.int64]  # (n,) of the measurement, ns; of a landmark that of the keyframe
    source: IntArray  # (n,) as of Constraints.scatter

    def __len__(self) -> int:
        return len(self.row)

    def points(self, scene: Scene) -> FloatArray:
        """Return where the map has the points, (n, 3) m."""
        table = scene.keyframes
        return np.asarray(table.position[self.row] + (table.rotation[self.row] @ self.lever_arm[:, :, None])[..., 0])


def pair(scene: Scene, config: FactorsConfig, first: int = 0, *, everything: bool = False) -> Pairs:
    """Return all absolute measurements between two keyframes, by the nearer one.

    Keyframes are those from the place ``first`` in the order of time on. ``everything``: what was left out, too.
    """
    table, order = scene.keyframes, scene.order[max(first - 1, 0) :]
    stamps = table.stamp_ns[order]
    since = bisect.bisect_left(scene.constraints.absolute, int(stamps[0]), key=lambda one: one.stamp_ns)
    known = scene.constraints.absolute[since:]
    if not everything and scene.constraints.left_out:
        known = [one for one in known if not scene.constraints.leaves_out(one)]
    time = np.array([one.stamp_ns for one in known], np.int64)
    after = np.searchsorted(stamps, time)
    exact = stamps[np.minimum(after, len(stamps) - 1)] == time
    after = after + exact
    inside = (after > 0) & ((after < len(stamps)) | exact)
    session = np.append(scene.sessions_of(order), -1)
    inside &= exact | (session[after - 1] == session[after])
    which = np.flatnonzero(inside)
    a = after[which] - 1
    b = np.minimum(a + 1, len(stamps) - 1)
    share = (time[which] - stamps[a]) / np.maximum(stamps[b] - stamps[a], 1)
    nearer = np.where(share > 0.5, b, a)
    turn, move = np.tile(np.eye(3), (len(which), 1, 1)), np.zeros((len(which), 3))
    if share.any():
        turn, move = _between(scene, order[a], order[b], share)
    antenna = np.array([config.antenna_x_m, config.antenna_y_m, config.antenna_z_m])
    arm = np.array([antenna * known[i].of_antenna for i in which]).reshape(-1, 3)
    measured = [known[i].rotation for i in which]
    rotation = np.array([np.eye(3) if one is None else one for one in measured]).reshape(-1, 3, 3)
    covariance = np.array([_six(known[i].covariance, config) for i in which]).reshape(-1, 6, 6)
    source = np.array([known[i].source for i in which], np.intp)
    for number, times in scene.constraints.scatter.items():
        covariance[source == number, 3:] *= times
        covariance[source == number, :, 3:] *= times
    return Pairs(
        order[nearer],
        move + (turn @ arm[:, :, None])[..., 0],
        np.array([known[i].position for i in which]).reshape(-1, 3),
        rotation @ np.swapaxes(turn, 1, 2),
        covariance,
        time[which],
        source,
    )


def _between(scene: Scene, a: IntArray, b: IntArray, share: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the body at a ``share`` (n,) of the time from keyframes a to b (rows), seen from the nearer one.

    By the front-end, at constant velocity.
    """
    table = scene.keyframes
    back = geometry.inverse(table.input_rotation[a], table.input_position[a])
    step = geometry.compose(*back, table.input_rotation[b], table.input_position[b])
    from_a = geometry.so3_exp(share[:, None] * geometry.so3_log(step[0])), share[:, None] * step[1]
    back, is_b = geometry.inverse(*step), share > 0.5
    start = np.where(is_b[:, None, None], back[0], np.eye(3)), np.where(is_b[:, None], back[1], 0.0)
    return geometry.compose(*start, *from_a)


def every_pair(scene: Scene, config: FactorsConfig, first: int = 0, *, everything: bool = False) -> Pairs:
    """Return the same, and points whose places are known: each by the last keyframe that sees it, as a point of that.

    How far a point is from there is taken as known to a twentieth.
    """
    pairs, known, points = (
        pair(scene, config, first, everything=everything),
        scene.constraints.landmarks,
        scene.landmarks,
    )
    if not known:
        return pairs
    rows = scene.find_landmarks(np.fromiter(known, np.uint64, len(known)))
    good = np.flatnonzero((rows >= 0) & points.has_position[rows] & (points.last[rows] >= 0))
    seen = scene.observations.keyframe[points.last[rows[good]]].astype(np.intp)
    recent = scene.places()[seen] >= first
    good, seen = good[recent], seen[recent]
    priors = list(known.values())
    covariance = np.array([_six(priors[i][1], config) for i in good]).reshape(-1, 6, 6)
    position = np.array([priors[i][0] for i in good]).reshape(-1, 3)
    return join_rows(pairs, as_seen(scene, rows[good], seen, position, covariance))


def as_seen(scene: Scene, points: IntArray, seen: IntArray, position: FloatArray, covariance: FloatArray) -> Pairs:
    """Return points (rows in the scene) whose places are known as points of the body at keyframes ``seen`` (rows)."""
    away = scene.landmarks.position[points] - scene.keyframes.position[seen]
    covariance = covariance.copy()
    covariance[:, 3:, 3:] += (0.05**2 * np.sum(away**2, axis=1))[:, None, None] * np.eye(3)
    back = np.swapaxes(scene.keyframes.rotation[seen], 1, 2)
    unit = np.tile(np.eye(3), (len(points), 1, 1))
    arm, source = (back @ away[:, :, None])[..., 0], np.full(len(seen), LANDMARK)
    return Pairs(seen, arm, position, unit, covariance, scene.keyframes.stamp_ns[seen], source)


def _six(covariance: FloatArray, config: FactorsConfig) -> FloatArray:
    if len(covariance) == 6:
        return covariance
    out = UNKNOWN**2 * np.eye(6)
    out[3:, 3:] = covariance if covariance.any() else config.gnss_sigma_m**2 * np.eye(3)
    return out


def align(scene: Scene, config: Config) -> bool:
    """Find where the map lies in the world; return whether that is known now."""
    known = scene.constraints
    if known.world_frame == config.frames.map_frame:
        known.map_from_world = np.eye(3), np.zeros(3)
        return True
    found = aligned(scene, every_pair(scene, config.factors), config.factors)
    if found is not None:
        known.map_from_world = found
    return known.map_from_world is not None


def aligned(scene: Scene, pairs: Pairs, config: FactorsConfig) -> tuple[FloatArray, FloatArray] | None:
    """Return map from world, None where too little is known."""
    if not len(pairs):
        return None
    pairs = take_rows(pairs, np.unique(np.linspace(0, len(pairs) - 1, _ALIGNED).astype(int)))
    there = pairs.points(scene)
    sigma = np.sqrt(np.trace(pairs.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0)
    turn_rad = np.sqrt(np.trace(pairs.covariance[:, :3, :3], axis1=1, axis2=2) / 3.0)
    told = float(1.0 / np.sqrt(np.sum(1.0 / turn_rad**2)))
    if told > _HEADING_RAD and float(np.sqrt(np.sum(np.var(there, axis=0)))) < config.align_m:
        return None
    turned = scene.keyframes.rotation[pairs.row] @ np.swapaxes(pairs.rotation, 1, 2)
    best, lowest = None, np.inf
    rng = np.random.default_rng(0)
    scored = np.unique(np.linspace(0, len(pairs) - 1, _SCORED).astype(int))
    for _ in range(_SETS):
        few = rng.choice(len(pairs), min(_IN_SET, len(pairs)), replace=False)
        weight = np.zeros(len(pairs))
        weight[few] = 1.0 / sigma[few] ** 2
        found = _kabsch(there, pairs.position, weight, turned, turn_rad)
        cost = float(np.sum(np.log1p(_off(found, there[scored], pairs.position[scored], sigma[scored]) ** 2)))
        if cost < lowest:
            best, lowest = found, cost
    assert best is not None
    for _ in range(_ROUNDS):
        off = _off(best, there, pairs.position, sigma)
        off = off / max(1.0, float(np.quantile(off, _SURE)))
        weight = 1.0 / (sigma**2 * (1.0 + off**2))
        best = _kabsch(there, pairs.position, weight, turned, turn_rad)
    share = weight / weight.sum()
    spread = float(np.sqrt(np.sum(share[:, None] * (there - share @ there) ** 2)))
    sigma_m = float(1.0 / np.sqrt(np.mean(1.0 / sigma**2)))
    heading = sigma_m / (max(spread, 1e-9) * np.sqrt(len(pairs)))
    enough = spread >= max(config.align_m, _SPREAD * sigma_m) and heading <= _HEADING_RAD
    return best if enough or told <= _HEADING_RAD else None


def _kabsch(
    there: FloatArray, here: FloatArray, weight: FloatArray, turned: FloatArray, turn_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation that bring positions ``here`` (n, 3) to ``there``, best by weights 1/m^2."""
    share = weight / weight.sum()
    middle = share @ there, share @ here
    product = ((there - middle[0]) * weight[:, None]).T @ (here - middle[1])
    product[2, 2] += 1.0 / _LEVEL_RAD**2
    product += np.sum(np.where(weight > 0.0, 1.0, 0.0)[:, None, None] * turned / turn_rad[:, None, None] ** 2, axis=0)
    rotation = geometry.nearest_rotation(product)
    return rotation, middle[0] - rotation @ middle[1]


def _off(found: tuple[FloatArray, FloatArray], there: FloatArray, here: FloatArray, sigma: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(here @ found[0].T + found[1] - there, axis=1) / (1.7 * sigma))


def factors(
    scene: Scene, config: Config, problem: Problem, rows: IntArray, origin: FloatArray
) -> list[KeyframeFactors]:
    """Return the factors of a problem whose keyframes stand in some rows of the scene, oldest first.

    ``origin`` (3,) is that of the problem in the map, m.
    """
    known = scene.constraints
    out: list[KeyframeFactors] = []
    for source in SOURCES:
        out += source(scene, problem, rows)
    if not config.factors.enabled or not (known.relative or known.steps or known.gravity or known.absolute):
        return out
    number = np.full(len(scene.keyframes), -1)
    number[rows] = np.arange(len(rows))
    free = ~problem.fixed
    if known.relative or known.steps:
        out += _relative(scene, config, number, free)
        out += _loops(scene, config, number, free, origin)
    if known.gravity:
        out += _gravity(scene, config, number, free)
    if known.absolute and known.map_from_world is not None and free.any():
        pairs = pair(scene, config.factors, int(scene.places()[rows[free]].min()))
        mine = number[pairs.row]
        pairs = take_rows(pairs, (mine >= 0) & free[mine])
        if len(pairs):
            out.append(absolute(scene, config, pairs, number[pairs.row], origin))
    return out


def absolute(scene: Scene, config: Config, pairs: Pairs, numbers: IntArray, origin: FloatArray) -> PosePriors:
    """Return the factors of absolute measurements in the map, whose keyframes have these numbers in a problem."""
    assert scene.constraints.map_from_world is not None
    rotation, translation = scene.constraints.map_from_world
    root = root_information(pairs.covariance)
    root[pairs.covariance[:, 0, 0] >= UNKNOWN**2, :3] = 0.0
    root[:, :, 3:] = root[:, :, 3:] @ rotation.T
    position = pairs.position @ rotation.T + translation - origin
    where = numbers[:, None], rotation @ pairs.rotation, position, pairs.lever_arm
    return PosePriors(*where, root, _LOSS, config.factors.loss_scale)


def _relative(scene: Scene, config: Config, number: IntArray, free: BoolArray) -> list[KeyframeFactors]:
    """Return the measured relative poses, and steps of the front-end whose covariance it told."""
    known, table = scene.constraints, scene.keyframes
    found = []
    for key in _keys(scene, number):
        one = known.relative[key]
        ends = [scene.find_keyframe(end) for end in key]
        if None not in ends:
            pair_of = number[np.array(ends, np.intp)]
            if (pair_of >= 0).all() and free[pair_of].any():
                found.append((pair_of, one.rotation, one.position, one.root))
    if known.steps:
        # Keyframes that follow each other in the problem and in time.
        here = np.flatnonzero(number[scene.order] >= 0)
        for place in here[1:][np.diff(here) == 1]:
            first, second = scene.order[place - 1], scene.order[place]
            covariance = known.steps.get(int(table.keyframe_id[second]))
            ends_of = number[[first, second]]
            if covariance is not None and free[ends_of].any():
                back = geometry.inverse(table.input_rotation[first], table.input_position[first])
                turn, move = geometry.compose(*back, table.input_rotation[second], table.input_position[second])
                turned = np.eye(6)
                turned[:3, :3] = turn.T
                found.append((ends_of, turn, move, root_information(turned @ covariance @ turned.T)))
    if not found:
        return []
    pairs, rotation, position, root = (np.array(values) for values in zip(*found, strict=True))
    return [RelativePoses(pairs, rotation, position, root, _LOSS, config.factors.loss_scale)]


def _loops(
    scene: Scene, config: Config, number: IntArray, free: BoolArray, origin: FloatArray
) -> list[KeyframeFactors]:
    """Return loops by pose to refined keyframes that take no part: priors, as these are where the map has them.

    Without them a window would forget the loop that its keyframes were moved by. With i outside, j's pose is ``T_i
    T_ij``; with j outside, the point t_ij of the body i is where j is, turned likewise.
    """
    known, table = scene.constraints, scene.keyframes
    found = []
    for key in _keys(scene, number):
        one, ends = known.relative[key], [scene.find_keyframe(end) for end in key]
        if not one.is_loop or None in ends or key in known.unchecked:
            continue
        rows = np.array(ends, np.intp)
        inside = number[rows] >= 0
        if inside.sum() != 1 or not free[number[rows[inside]]][0] or not table.refined[rows[~inside]][0]:
            continue
        rotation, position = table.rotation[rows[~inside]][0], table.position[rows[~inside]][0] - origin
        turn = np.eye(6)
        if inside[1]:
            turn[3:, 3:] = rotation.T
            measured = rotation @ one.rotation, position + rotation @ one.position, np.zeros(3)
        else:
            turned = rotation @ one.rotation.T
            turn[:3, :3], turn[3:, 3:] = one.rotation.T, turned.T
            measured = turned, position, one.position
        found.append((number[rows[inside]], *measured, one.root @ turn))
    if not found:
        return []
    at, turns, positions, arms, roots = (np.array(values) for values in zip(*found, strict=True))
    return [PosePriors(at, turns, positions, arms, roots, _LOSS, config.factors.loss_scale)]


def _keys(scene: Scene, number: IntArray) -> list[tuple[int, int]]:
    """Return the relative poses of keyframes of a problem, in the order of these."""
    known = scene.constraints
    ids = scene.keyframes.keyframe_id[np.flatnonzero(number >= 0)].tolist()
    return list(dict.fromkeys(key for one in ids for key in known.relative_of.get(one, ()) if key not in known.refused))


def in_place(steps: tuple[RelativePoses, ...], others: list[KeyframeFactors]) -> tuple[KeyframeFactors, ...]:
    """Return all factors, without the front-end's own turns and moves where others measured these between keyframes."""
    told = [kind for kind in others if isinstance(kind, RelativePoses)]
    if not told:
        return (*steps, *others)
    left = []
    for part, kind in enumerate(steps):
        pairs = set()
        for one in told:
            known = np.linalg.norm(one.root_information[:, :, 3 * part : 3 * part + 3], axis=(1, 2)) > _NOTHING
            pairs |= {tuple(sorted(ends)) for ends in one.keyframes[known].tolist()}
        keep = np.array([tuple(ends) not in pairs for ends in kind.keyframes.tolist()], bool)
        if keep.any():
            left.append(kind.take(keep, np.arange(1 + int(kind.keyframes.max()))))
    return (*left, *others)


def _gravity(scene: Scene, config: Config, number: IntArray, free: BoolArray) -> list[KeyframeFactors]:
    found = []
    for row in np.flatnonzero(number >= 0):
        measured = scene.constraints.gravity.get(int(scene.keyframes.keyframe_id[row]))
        if measured is not None and free[number[row]]:
            found.append((number[row], *measured))
    if not found:
        return []
    at, body, sigma_rad = (np.array(values) for values in zip(*found, strict=True))
    world = np.tile([0.0, 0.0, -1.0], (len(at), 1))
    return [Directions(at[:, None], world, body, sigma_rad, _LOSS, config.factors.loss_scale)]


def point_priors(scene: Scene, config: Config, landmarks: IntArray, origin: FloatArray) -> PointPriors | None:
    """Return the priors of points that stand in some rows of the scene, in a problem with this origin; None if none."""
    known = scene.constraints
    if not (config.factors.enabled and known.landmarks and known.map_from_world is not None):
        return None
    rotation, translation = known.map_from_world
    number = {row: i for i, row in enumerate(landmarks.tolist())}
    rows = scene.find_landmarks(np.fromiter(known.landmarks, np.uint64, len(known.landmarks))).tolist()
    found = [(number[row], *one) for row, one in zip(rows, known.landmarks.values(), strict=True) if row in number]
    if not found:
        return None
    point, position, covariance = (np.array(values) for values in zip(*found, strict=True))
    return PointPriors(point, position @ rotation.T + translation - origin, rotation @ covariance @ rotation.T)
