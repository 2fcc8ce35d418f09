# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the steps from keyframe to keyframe of a solution with those of the front-end.

A step is the pose of a keyframe in the body of the one before, which does not depend on where either map lies. What the
front-end's step is worth is a standard deviation for its length and one for its turn (``guard.step_*``, ``turn_*``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node import native
from ba_node.arrays import FloatArray, IntArray
from ba_node.config import GuardConfig
from ba_node.core.loss import NORMAL
from ba_node.window.trial import median

# Steps shorter, and turns smaller, than this many sigmas of the front-end say nothing of its scale.
_TELLING = 3.0
# Standard error of a median, in those of a mean.
_MEDIAN = 1.2533
# Fewer steps than this show no common factor; so few show no bias.
_FEW, _LEAST_BIASED = 5, 7
_LIMITS = _TELLING, NORMAL, _MEDIAN, _FEW


@dataclass(frozen=True)
class Steps:
    """Steps between keyframes: (n, 3, 3) turns and (n, 3) moves in the body of the first, m."""

    turn: FloatArray
    move: FloatArray

    @property
    def length(self) -> FloatArray:
        """Return the length of each, m."""
        return np.asarray(np.sqrt(np.sum(self.move**2, axis=1)))


def between(rotation: FloatArray, translation: FloatArray, first: IntArray, second: IntArray) -> Steps:
    """Return the steps from the keyframes ``first`` (n,) to ``second``; poses (n_kf, ...) are body from world, m."""
    if native.kernels is not None:
        return Steps(*native.kernels.inverse_steps_between(rotation, translation, first, second))
    turn = rotation[first] @ np.swapaxes(rotation[second], 1, 2)
    return Steps(turn, translation[first] - (turn @ translation[second][:, :, None])[..., 0])


def angle_of(turn: FloatArray) -> FloatArray:
    """Return the angle of rotations, (n,) rad."""
    off = np.sqrt(np.sum((turn - np.eye(3)) ** 2, axis=(1, 2)))
    return np.asarray(2.0 * np.arcsin(np.minimum(off / np.sqrt(8.0), 1.0)))


@dataclass(frozen=True)
class Comparison:
    """How far steps are off those of the front-end."""

    sigmas: FloatArray  # (n,) the larger of the error of the move and of the turn, each by its standard deviation
    move_m: FloatArray  # (n,) error of the move
    turn_rad: FloatArray  # (n,) error of the turn
    turned_rad: FloatArray  # (n,) angle of the front-end's turn
    sigma_m: FloatArray  # (n,) what the front-end's move is worth
    sigma_rad: FloatArray  # (n,) what its turn is worth


def compare(steps: Steps, measured: Steps, config: GuardConfig) -> Comparison:
    """Return how far steps are off measured ones."""
    if native.kernels is not None:
        return Comparison(*native.kernels.compare_steps(_both(steps), _both(measured), _worth(config)))
    length, turned = measured.length, angle_of(measured.turn)
    sigma_m = config.step_sigma_m + config.step_sigma_share * length
    sigma_rad = config.turn_sigma_rad + config.turn_sigma_share * turned + config.turn_sigma_rad_per_m * length
    move = np.sqrt(np.sum((steps.move - measured.move) ** 2, axis=1))
    turn = angle_of(np.swapaxes(measured.turn, 1, 2) @ steps.turn)
    return Comparison(np.maximum(move / sigma_m, turn / sigma_rad), move, turn, turned, sigma_m, sigma_rad)


@dataclass(frozen=True)
class Against:
    """The steps of a solution beside the front-end's."""

    solved: Steps
    measured: Steps  # the front-end's
    off: Comparison
    scale: float  # by what factor all are longer than the front-end's; 1 where that cannot be told from its errors
    turn: float  # by what factor all turns are larger, likewise


def against(
    solved: tuple[FloatArray, FloatArray],
    measured: tuple[FloatArray, FloatArray],
    first: IntArray,
    second: IntArray,
    config: GuardConfig,
) -> Against:
    """Return the steps of two sets of poses (body from world, as of :func:`between`) beside each other."""
    if native.kernels is not None:
        poses, pairs = (*solved, *measured), (first, second)
        ours, theirs, off, *factors = native.kernels.steps_against(poses, pairs, _worth(config), _LIMITS)
        return Against(Steps(*ours), Steps(*theirs), Comparison(*off), *factors)
    steps, others = between(*solved, first, second), between(*measured, first, second)
    found = compare(steps, others, config)
    scale = _common(steps.move, others.move, found.sigma_m)
    return Against(steps, others, found, scale, _turn_error(steps, others, found))


def _turn_error(steps: Steps, measured: Steps, found: Comparison) -> float:
    telling = found.turned_rad > found.sigma_rad
    if np.count_nonzero(telling) < _FEW:
        return 1.0
    turns, wanted = (_axes(one.turn[telling]) for one in (steps, measured))
    return _common(turns, wanted, found.sigma_rad[telling])


def bias(steps: Steps, measured: Steps) -> float:
    """Return how surely steps are off measured ones to one side: the sum of squares of six means, in standard errors.

    Errors of the front-end that are independent leave 6 on average (chi-square of six degrees of freedom, but for the
    tails); few steps leave 0.
    """
    n = len(steps.move)
    if n <= _LEAST_BIASED:
        return 0.0
    turned = _axes(np.swapaxes(measured.turn, 1, 2) @ steps.turn)
    off = np.hstack([steps.move - measured.move, turned])
    squared = np.mean(off, axis=0) ** 2 / np.maximum(np.var(off, axis=0, ddof=1) / n, 1e-24)
    # The square of a variable of Student's distribution with n - 1 degrees of freedom is (n - 1) / (n - 3) on average.
    return float(np.sum(squared)) * (n - 3) / (n - 1)


def _worth(config: GuardConfig) -> tuple[float, float, float, float, float]:
    of_turn = config.turn_sigma_rad, config.turn_sigma_share, config.turn_sigma_rad_per_m
    return config.step_sigma_m, config.step_sigma_share, *of_turn


def _both(steps: Steps) -> tuple[FloatArray, FloatArray]:
    return steps.turn, steps.move


def _axes(turn: FloatArray) -> FloatArray:
    """Return the axes of rotations times the sines of their angles, (n, 3)."""
    skew = 0.5 * (turn - np.swapaxes(turn, 1, 2))
    return np.asarray(skew[:, [2, 0, 1], [1, 2, 0]])


def _common(found: FloatArray, measured: FloatArray, sigma: FloatArray) -> float:
    """Return the median of the ratios of two lists of vectors where it stands out of the scatter, else 1.

    Both are measured along the mean of the two: errors across do not make one longer than the other, and large errors
    of either do not decide which vectors are looked at.

    Vectors are (n, 3); ``sigma`` (n,) is the standard deviation of those measured.
    """
    both = found + measured
    length = np.sqrt(np.sum(both**2, axis=1))
    ours, theirs = (np.sum(one * both, axis=1) / np.maximum(length, 1e-12) for one in (found, measured))
    telling = (0.5 * length > _TELLING * sigma) & (ours > 0.0) & (theirs > 0.0)
    n = int(np.count_nonzero(telling))
    if n < _FEW:
        return 1.0
    logs = np.log(ours[telling] / theirs[telling])
    middle = median(logs)
    scatter = _MEDIAN * NORMAL * median(np.abs(logs - middle)) / np.sqrt(n)
    expected = _MEDIAN * median(2.0 * sigma[telling] / length[telling]) / np.sqrt(n)
    return float(np.exp(middle)) if abs(middle) > max(3.0 * scatter, 2.0 * expected) else 1.0
