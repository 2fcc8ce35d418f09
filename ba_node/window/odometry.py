# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn the front-end's own steps into factors between consecutive keyframes of a window's problem.

A step is the relative pose of the front-end's poses of two keyframes, however far the map has been corrected since. Its
standard deviations grow with the path between them, of length l and turn a, over the keyframes that take no part too::

    sigma_translation = sigma_m + sigma_m_per_m l
    sigma_rotation    = sigma_rad + sigma_rad_per_m l + sigma_rad_per_rad a

They are those of good odometry. Where that of a recording is worse, keyframes that see much tell: with d the distances
between their refined steps and the front-end's, in standard deviations of three axes, all are multiplied by
``median(d) / 1.54`` (1.54 is that of a normal distribution), for translation and rotation apart. Where it is better
than images are, precision.py learns by what share; but the turns of keyframes that see little take that median below 1
too, as a dozen points hardly tell a turn from a shift. Where two cameras see little, refined steps lie between what
images and front-end say, in the middle if both are as good; so half of what they are off is not seen, and d counts
twice.

So images decide where they see enough. Where these see little (no tracks, no parallax, a camera that stands still or
turns on the spot), and for the scale of one camera, the steps do. The loss is Cauchy's: a step that contradicts the
images by far, as where the front-end has jumped, pulls at nothing. Once the standard deviations are known to be right
the loss is wider, for all steps that are not wild belong to that distribution, and keep tracks on moving objects from
carrying a keyframe along. So it is in windows of one camera of which most keyframes see little: a dozen points tell it
turns, but no lengths, and nobody is there to tell how precise the steps are. It is widest in a young map that sees
much: nothing but the steps tells there what moves.
Where much of what is seen moves, refined steps may follow it and tell nothing; there the standard deviations are those
stated, and the loss is the widest too, but where depths are measured. So it is where all that is seen is k times as far
off as ``sigma_px`` says (median of the residuals of refined keyframes over 1.18, 2.5 and more): what refined steps are
off the front-end's is the images', and the loss is k times the widest. Rotation and translation have a loss each, so
that a wrong one does not release the other.

Where images tell no lengths, steps v that err aside shorten the map: its steps u, of which images tell the direction,
fit them best at ``s = u.v / |u|^2 = |v| cos(u, v) / |u|``. Noise alike in all directions makes v longer by as much, but
not what turns it: stamps beside those of the images, a camera that is turned on the body. So with c the cosines, ``a =
mean(1 - c^2) - 2 var(|v| c / |u|)`` is what steps err more aside than noise along them explains, and they are made
longer by ``1 / sqrt(1 - a)``. Where a front-end moves in a plane its steps are those of the body less what leads out of
it, c times as long as well, and the factor is ``1 / (1 - a)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray, changed
from ba_node.config import OdometryConfig
from ba_node.core import geometry
from ba_node.core.factors import RelativePoses
from ba_node.core.problem import Problem
from ba_node.scene.scene import Scene
from ba_node.window.turns import Turns

_LOSS = "cauchy"
# A standard deviation of zero would be a condition, not a measurement (m, rad).
_SMALLEST_SIGMA = 1e-9
# Keyframes further apart than this many steps of the front-end are not tied to each other.
_MAX_GAP = 100
# Refined steps tell how good the front-end's are if there are so many, of keyframes with so many observations.
_LEAST_STEPS = 8
MANY_OBSERVATIONS = 50
# Steps that are off by so many times what is stated are far worse than it.
_FAR_WORSE = 8.0
# Steps of so many standard deviations tell a length; so large a share of them is nearly all.
_TELLING, _NEARLY_ALL = 10.0, 0.9
# Steps tell how far others err aside if the cosine of the angle between refined and given is larger, and lengths alike.
_ALIKE = 0.85
# Turns are not taken for more precise than this share of what is stated.
_LEAST_SHARE = 0.2
# What refined steps are off by counts so many times where keyframes see little.
_HALF_SEEN = 2.0
# How many times as wide as stated the loss is once they have told, or where most see little to one camera; and before,
# where all keyframes see much.
_WIDE = 5.0
_WIDEST = 20.0
# Images that are so many times as noisy as stated count less, if so many residuals say so; median of the length of two
# standard normal numbers.
_NOISIER, _RESIDUALS, _MEDIAN_LENGTH = 2.5, 200, 1.177
# More keyframes are no window: where loops bend a map the steps have to give way.
_WINDOW = 100
# Median of the norm of three standard normal numbers.
_MEDIAN_NORM = 1.538


@dataclass(frozen=True)
class Steps:
    """Steps of the front-end between keyframes of a problem and the next ones."""

    first: IntArray  # (n,) the earlier keyframe of each
    rotation: FloatArray  # (n, 3, 3) body at the earlier one from body at the later one
    translation: FloatArray  # (n, 3) the same, m
    sigma_rad: FloatArray  # (n,) standard deviation about each axis
    sigma_m: FloatArray  # (n,) along each axis

    def factors(self, kept: BoolArray, loss_scale: float) -> tuple[RelativePoses, ...]:
        """Return the factors of some steps."""
        pairs = self.first[kept, None] + np.arange(2)
        root = np.zeros((2, len(pairs), 6, 6))
        # Three numbers each of a diagonal, that of turns before that of moves.
        root[0].reshape(-1, 36)[:, :15:7] = 1.0 / self.sigma_rad[kept, None]
        root[1].reshape(-1, 36)[:, 21::7] = 1.0 / self.sigma_m[kept, None]
        measured = self.rotation[kept], self.translation[kept]
        return tuple(RelativePoses(pairs, *measured, part, _LOSS, loss_scale) for part in root)


@dataclass(frozen=True)
class Doubt:
    """What keeps refined steps from telling how good the front-end's are."""

    much_moves: bool = False  # a large share of what is seen does
    noise: float = 1.0  # observations are so many times as far off as stated, see :func:`noise_of`


def noise_of(problem: Problem, refined: BoolArray, norms: FloatArray) -> float:
    """Return how many times as noisy as stated images are by what ``refined`` keyframes (n_kf,) see; 1 if by little.

    ``norms`` (n_obs,) are residuals, sigmas, NaN where there is none.
    """
    told = norms[refined.take(problem.observations.keyframe) & ~np.isnan(norms)]
    times = float(np.median(told)) / _MEDIAN_LENGTH if len(told) >= _RESIDUALS else 1.0
    return times if times > _NOISIER else 1.0


def ties(scene: Scene, config: OdometryConfig, keyframes: IntArray) -> BoolArray:
    """Return which keyframes of a problem, oldest first, are tied to the next one, (n_kf - 1,)."""
    place = scene.places()[keyframes]
    near = config.enabled & (place[1:] - place[:-1] <= _MAX_GAP)
    return np.asarray(near & (np.diff(scene.sessions_of(keyframes)) == 0) if scene.constraints.seams else near)


def factors(
    scene: Scene,
    config: OdometryConfig,
    problem: Problem,
    keyframes: IntArray,
    turned: Turns | None = None,
    doubt: Doubt = Doubt(),
    tied: BoolArray | None = None,
) -> tuple[RelativePoses, ...]:
    """Return the factors of consecutive keyframes of which one at least is free; none if they are off.

    ``keyframes`` are rows of the problem's keyframes, oldest first; ``turned`` is what is known of their rotations
    beside the front-end's; ``tied`` is :func:`ties` if known.
    """
    first = (ties(scene, config, keyframes) if tied is None else tied).nonzero()[0]
    free = ~(problem.fixed[first] & problem.fixed[first + 1])
    if not free.any():
        return ()
    many = np.bincount(problem.observations.keyframe, minlength=len(keyframes)) >= MANY_OBSERVATIONS
    stated = _front_end(scene, config, keyframes, first)
    depths, windowed = len(problem.observations.depth_m) > 0, len(keyframes) <= _WINDOW
    noisy, much_moves = doubt.noise > 1.0, doubt.much_moves and not depths
    learned_from = [(many, 1.0)]
    if problem.has_scale and not depths and windowed:
        learned_from.append((np.ones(len(many), bool), _HALF_SEEN))
    inflated = None if noisy or much_moves else _as_learned(scene, config, keyframes, learned_from, stated)
    steps = stated if inflated is None else inflated
    if not problem.has_scale:
        steps = _as_long(scene, keyframes, many, steps, stated.sigma_m)
    if turned is not None:
        rotation, sigma_rad = turned.between(keyframes, first, first + 1)
        known = ~np.isnan(sigma_rad)
        steps.rotation[known], steps.sigma_rad[known] = rotation[known], sigma_rad[known]
    few = not problem.has_scale and windowed and 2 * np.count_nonzero(many) < len(many)
    width = _WIDE if few or inflated is not None else 1.0
    if inflated is None and (noisy or much_moves or many.all()):
        width = _WIDEST * doubt.noise
    return steps.factors(free, width * config.loss_scale)


def _front_end(scene: Scene, config: OdometryConfig, keyframes: IntArray, first: IntArray) -> Steps:
    """Return the front-end's steps as the parameters have them."""
    table, place = scene.keyframes, scene.places()[keyframes]
    poses = table.input_rotation, table.input_position
    rotation, translation = geometry.steps_between(*poses, keyframes[first], keyframes[first + 1])
    gap = place[first + 1] - place[first]
    steps = (rotation, translation) if (gap == 1).all() else None
    length, turn = _travelled(scene, place[first], gap, steps)
    sigma_rad = config.sigma_rad + config.sigma_rad_per_m * length + config.sigma_rad_per_rad * turn
    sigma_m = config.sigma_m + config.sigma_m_per_m * length
    return Steps(
        first,
        rotation,
        translation,
        np.maximum(sigma_rad, _SMALLEST_SIGMA),
        np.maximum(sigma_m, _SMALLEST_SIGMA),
    )


def _as_long(scene: Scene, keyframes: IntArray, many: BoolArray, steps: Steps, stated_m: FloatArray) -> Steps:
    """Return steps made longer by the inverse cosine of the usual angle by which they err aside, see above.

    Told by keyframes that see ``many`` points, and by steps that are long for ``stated_m`` (n,), their deviations.
    """
    table, pairs = scene.keyframes, (steps.first, steps.first + 1)
    sure = many & table.refined[keyframes]
    _, refined = geometry.steps_between(table.rotation, table.position, *(keyframes[end] for end in pairs))
    length, given = (np.sqrt(np.sum(moves**2, axis=1)) for moves in (refined, steps.translation))
    told = sure[pairs[0]] & sure[pairs[1]] & (np.minimum(length, given) > _TELLING * stated_m)
    cosine = np.sum(refined * steps.translation, axis=1)[told] / (length * given)[told]
    ratio = (given / np.maximum(length, 1e-12))[told]
    alike = (cosine > _ALIKE) & (np.abs(np.log(ratio)) < 1.0 - _ALIKE)
    cosine, along = cosine[alike], (cosine * ratio)[alike]
    if len(cosine) < _LEAST_STEPS:
        return steps
    aside = float(np.mean(1.0 - cosine**2) - 2.0 * np.var(along / np.mean(along), ddof=1))
    power = 1.0 if geometry.is_planar(table.input_position[keyframes]) else 0.5
    return changed(steps, translation=steps.translation * (1.0 - max(aside, 0.0)) ** -power)


def stated(scene: Scene, config: OdometryConfig, keyframes: IntArray) -> Steps:
    """Return the front-end's steps between keyframes of a problem that are tied, as the parameters have them."""
    return _front_end(scene, config, keyframes, np.flatnonzero(ties(scene, config, keyframes)))


def as_stated(scene: Scene, config: OdometryConfig) -> bool:
    """Return True if many points are seen, and the front-end's steps are not far worse than is stated."""
    order, table = scene.order, scene.keyframes
    if len(scene.observations) < MANY_OBSERVATIONS * len(order):
        return False
    steps = stated(scene, config, order)
    refined = geometry.steps_between(table.rotation, table.position, order[steps.first], order[steps.first + 1])
    off = _medians_off(refined, (steps.rotation, steps.translation), (steps.sigma_rad, steps.sigma_m))
    return bool((off < _FAR_WORSE * _MEDIAN_NORM).all())


def tell_nothing(scene: Scene, config: OdometryConfig, keyframes: IntArray) -> BoolArray:
    """Return at which keyframes of a problem (n_kf,) no step of the front-end tells a length, if it is as stated."""
    steps = stated(scene, config, keyframes)
    short = np.linalg.norm(steps.translation, axis=1) < _TELLING * steps.sigma_m
    ends = np.concatenate([steps.first, steps.first + 1])
    told, all_steps = (np.bincount(ends, weight, len(keyframes)) for weight in (np.tile(~short, 2), None))
    return np.asarray((all_steps > 0) & (told == 0))


def tell_scale(scene: Scene, config: OdometryConfig) -> bool:
    """Return True if nearly all of the front-end's steps tell a length, if they are as stated."""
    steps = stated(scene, config, scene.order)
    told = np.linalg.norm(steps.translation, axis=1) >= _TELLING * steps.sigma_m
    return bool(np.count_nonzero(told) >= _NEARLY_ALL * len(told))


def _as_learned(
    scene: Scene, config: OdometryConfig, keyframes: IntArray, sources: list[tuple[BoolArray, float]], steps: Steps
) -> Steps | None:
    """Return steps with standard deviations as refined keyframes show them to be, times a factor.

    ``sources`` are such keyframes, (n_kf,), and their factors; the first of which there are enough tell. Smaller ones
    where precision.py has learned that. None where too few are known.
    """
    shares, many = scene.step_shares, sources[0][0]
    if shares != (1.0, 1.0):
        steps = changed(steps, sigma_rad=shares[0] * steps.sigma_rad, sigma_m=shares[1] * steps.sigma_m)
    table = scene.keyframes
    told = ((among & table.refined[keyframes], factor) for among, factor in sources)
    steps_of = (((sure[steps.first] & sure[steps.first + 1]).nonzero()[0], factor) for sure, factor in told)
    rows, factor = next((one for one in steps_of if len(one[0]) >= _LEAST_STEPS), (steps.first[:0], 0.0))
    if not len(rows):
        return None if shares == (1.0, 1.0) else steps
    first, last = keyframes[steps.first[rows]], keyframes[steps.first[rows] + 1]
    refined = geometry.steps_between(table.rotation, table.position, first, last)
    stated = steps.rotation[rows], steps.translation[rows]
    worse = factor * _medians_off(refined, stated, (steps.sigma_rad[rows], steps.sigma_m[rows]))
    worse = (worse / _MEDIAN_NORM).tolist()
    # Keyframes of before they were known to be precise are worse than they.
    most = config.max_inflation
    times = [1.0 if share < 1.0 else min(max(off, 1.0), most) for share, off in zip(shares, worse, strict=True)]
    # Where many see how well the front-end turns, few are not to know better.
    weak = ~(many[steps.first] & many[steps.first + 1]) & (shares[0] == 1.0)
    turns = np.where(weak, min(max(worse[0], _LEAST_SHARE), most), times[0])
    return changed(steps, sigma_rad=turns * steps.sigma_rad, sigma_m=times[1] * steps.sigma_m)


def _medians_off(
    steps: tuple[FloatArray, FloatArray], others: tuple[FloatArray, FloatArray], sigmas: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return the medians (2,) of how far steps are off others, of rotations and translations, in standard deviations.

    ``sigmas`` (n,) are those of rotations (rad) and translations (m).
    """
    if native.kernels is not None:
        return np.array(native.kernels.medians_off(steps, others, *sigmas))
    turned = geometry.so3_log(np.swapaxes(others[0], 1, 2) @ steps[0])
    off = np.stack([turned / sigmas[0][:, None], (steps[1] - others[1]) / sigmas[1][:, None]])
    return np.asarray(np.median(np.sqrt(np.sum(off * off, axis=2)), axis=1))


def _travelled(
    scene: Scene, place: IntArray, gap: IntArray, steps: tuple[FloatArray, FloatArray] | None
) -> tuple[FloatArray, FloatArray]:
    """Return how far (m) and by how much (rad) the front-end moves from some places in time over so many steps each.

    ``steps`` are these, rotations and translations, where they are single ones.
    """
    factor = None
    if steps is None:
        factor = np.repeat(np.arange(len(place)), gap)
        at = np.arange(len(factor)) + (place - (np.cumsum(gap) - gap))[factor]
        table, order = scene.keyframes, scene.order
        steps = geometry.steps_between(table.input_rotation, table.input_position, order[at], order[at + 1])
    rotation, translation = steps
    cosine = 0.5 * (rotation[:, 0, 0] + rotation[:, 1, 1] + rotation[:, 2, 2] - 1.0)
    turn = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
    length = np.sqrt(np.add.reduce(translation * translation, axis=1))
    if factor is None:
        return length, turn
    return np.bincount(factor, length, len(place)).astype(float), np.bincount(factor, turn, len(place)).astype(float)
