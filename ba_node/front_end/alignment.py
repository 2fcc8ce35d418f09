# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Learn how the second camera of a pair is turned against what the calibration says, from what it sees.

A turn of a tenth of a degree about the vertical axis shifts all disparities by a pixel, and the scale of what is far by
tens of per cent. The true disparity at (x, y), normalised, of what was measured is

    d = d_measured + yaw (1 + x^2) + roll y

(in px: f times the angle). Along rows it cannot be seen in one pair of images, but in how points move from one keyframe
to the next: parallax by motion is proportional to d, so points that are far tell the yaw from the scale. For each pair
of keyframes pose (6) and (yaw, roll) are solved for together, with what disparities are worth as in ``pose.py``; the
pose is eliminated, and what is left is summed up over pairs, older ones forgotten. Across rows it is seen at once: a
polynomial of second degree in x, y is fitted to how many rows what is found lies off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end.rectify import IdealRig

# What a calibration is trusted to, px: yaw and roll.
_PRIOR_PX = np.array([1.0, 1.0])
# Roll is seen across rows by those who calibrate, and is seldom off: of what is found, so many standard deviations are
# not trusted (the mode under Laplace's prior, which is 0 unless the data insist).
_DOUBT = 2.0
# Pairs of keyframes share points and errors of their place: each counts for less than its numbers say.
_WORTH = 0.05
# What remains of what older pairs said, at each new one.
_KEPT, _KEPT_ROWS = 0.97, 0.9
# Fewest points of a pair, and least median shift between the keyframes, px.
_LEAST_POINTS, _LEAST_SHIFT_PX = 60, 3.0
_STEPS, _SMALL_PX = 10, 0.01
# Keyframes at the start that rows are learned from, and how often later.
_FIRST, _EVERY = 10, 4
_FLOOR_PX = 0.1
# A turn is applied once it is this many standard deviations from none.
_SURE = 3.0


@dataclass(frozen=True)
class Pair:
    """Points that two keyframes share."""

    before: FloatArray  # (n, 2) px
    after: FloatArray  # (n, 2) px
    disparity: FloatArray  # (n,) in the first, corrected by what was known then, px
    disparity_sigma: FloatArray  # (n,) px
    sigma: FloatArray  # (n,) of ``after``, px


class StereoAlignment:
    """Corrections of the second camera of a pair, in the frame of the ideal cameras."""

    def __init__(self, rig: IdealRig, yaw_px: float = 0.0, roll_px: float = 0.0) -> None:
        self._rig = rig
        self.turn: FloatArray = np.array([yaw_px, roll_px])  # applied, px
        self._information = np.diag(1.0 / _PRIOR_PX**2)
        self._prior = self._information.copy()
        self._vector = self._information @ self.turn
        self._rows_information = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
        self._rows_vector = np.zeros(6)
        self._images = 0
        self._rows: FloatArray = np.zeros(6)

    @property
    def sigma(self) -> FloatArray:
        """Return the standard deviations of yaw and roll, (2,) px."""
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(self._information))))

    def _flat(self, uv: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y = ((uv - self._rig.centre) / self._rig.focal).T
        return x, y

    def basis(self, uv: FloatArray) -> FloatArray:
        """Return the change of disparities (n, 2) by yaw and roll at uv (n, 2)."""
        x, y = self._flat(uv)
        return np.column_stack([1.0 + x * x, y])

    def disparity(self, uv: FloatArray) -> FloatArray:
        """Return what is to be added to measured disparities, (n,) px."""
        return np.asarray(self.basis(uv) @ self.turn)

    def rows_off(self, uv: FloatArray) -> FloatArray:
        """Return how many rows below its own a point is in the second image, (n,) px."""
        return np.asarray(self._powers(uv) @ self._rows)

    @property
    def wants_rows(self) -> bool:
        """Return whether rows are to be learned from the next image: of the first ones, then now and then."""
        self._images += 1
        return self._images <= _FIRST or self._images % _EVERY == 0

    def _powers(self, uv: FloatArray) -> FloatArray:
        x, y = self._flat(uv)
        return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])

    def learn_rows(self, uv: FloatArray, off: FloatArray, sigma: FloatArray) -> None:
        """Take in how far points were found from their rows, px."""
        powers = self._powers(uv)
        error = np.abs(off - powers @ self._rows) / np.maximum(sigma, _FLOOR_PX)
        weight = _WORTH / np.maximum(sigma, _FLOOR_PX) ** 2 / (1.0 + error * error)
        self._rows_information = _KEPT_ROWS * self._rows_information + (powers.T * weight) @ powers
        self._rows_vector = _KEPT_ROWS * self._rows_vector + (powers.T * weight) @ off
        self._rows = np.asarray(
            np.linalg.solve(self._rows_information + 1e-3 * np.eye(6), self._rows_vector), np.float64
        )

    def learn_turn(self, pair: Pair, after_from_before: Transform) -> FloatArray:
        """Take in a pair of keyframes; return the change of the turn that is applied, (2,) px."""
        change = np.zeros(2)
        if len(pair.before) < _LEAST_POINTS:
            return change
        shift = np.median(np.linalg.norm(pair.after - self._turned(pair.before, after_from_before), axis=1))
        if shift < _LEAST_SHIFT_PX:
            return change
        found = self._solve(pair, after_from_before)
        if found is None:
            return change
        information, step = found
        information = _WORTH * information
        self._information = _KEPT * self._information + (1.0 - _KEPT) * self._prior + information
        self._vector = _KEPT * self._vector + information @ (self.turn + step)
        covariance = np.linalg.inv(self._information)
        told = covariance @ self._vector
        doubt = np.clip(told[1], *(np.array([-_DOUBT, _DOUBT]) * np.sqrt(covariance[1, 1])))
        told = told - covariance[:, 1] / covariance[1, 1] * doubt
        if (np.abs(told) > _SURE * self.sigma).any() or self.turn.any():
            change = told - self.turn
            self.turn = told
        return change

    def _turned(self, uv: FloatArray, motion: Transform) -> FloatArray:
        return self._rig.pixels(self._rig.rays(uv) @ motion.rotation.T)

    def _solve(self, pair: Pair, motion: Transform) -> tuple[FloatArray, FloatArray] | None:
        """Return information (2, 2) on yaw and roll by one pair, and how far both are from what is applied, px."""
        f, fb = self._rig.focal, self._rig.focal * self._rig.baseline
        ray, basis = self._rig.rays(pair.before).T, self.basis(pair.before).T
        sigma_d = np.hypot(pair.disparity_sigma, _FLOOR_PX)
        sigma = np.hypot(pair.sigma, _FLOOR_PX)
        turn, d = np.zeros(2), pair.disparity.copy()
        J = np.zeros((8, 2, len(d)))  # columns, as numpy's products of many small matrices take ten times as long
        for _ in range(_STEPS):
            # At the disparities that both images make likely: at those measured, whose errors would look like parallax
            # where there is none, the scale comes out too small and the yaw too large.
            w = d / fb
            x, y, depth = motion.rotation @ ray + motion.translation[:, None] * w
            z = np.maximum(depth, 1e-2)
            a, flat, t = f / z, np.stack([x, y]) / z, motion.translation[:, None]
            by_d = a * (t[:2] - flat * t[2]) / fb
            off = pair.disparity + turn @ basis - d
            error = pair.after.T - (f * flat + self._rig.centre[:, None]) - by_d * off
            # C = sigma^2 + m m':  sigma^2 C^-1 = 1 - m m' / (sigma^2 + m' m)
            smear = by_d * sigma_d
            total = sigma * sigma + (smear * smear).sum(axis=0)
            along = (smear * error).sum(axis=0) / total
            likely = d + off + sigma_d * along
            squared = ((error * error).sum(axis=0) - along * along * total) / (sigma * sigma)
            (u, v), none = flat, np.zeros(len(d))
            J[:6, 0] = a * (-u * y, depth + u * x, -y, w, none, -u * w)
            J[:6, 1] = a * (-depth - v * y, v * x, x, none, w, -v * w)
            J[6:] = basis[:, None] * by_d
            weighted = J - smear * ((smear * J).sum(axis=1) / total)[:, None]
            weighted /= sigma * sigma * (1.0 + squared / 4.0)
            H = J.reshape(8, -1) @ weighted.reshape(8, -1).T
            H[6:, 6:] += 0.01 * self._prior
            b = weighted.reshape(8, -1) @ error.reshape(-1)
            b[6:] -= 0.01 * self._prior @ (self.turn + turn)
            step = np.linalg.solve(H + 1e-12 * np.eye(8) * np.trace(H), b)
            rotation = geometry.so3_exp(step[:3])
            motion = Transform(rotation @ motion.rotation, rotation @ motion.translation + step[3:6])
            turn, d = turn + step[6:], likely
            if np.abs(step[6:]).max() < _SMALL_PX:
                break
        if np.abs(turn).max() > 5.0 * _PRIOR_PX.max():
            return None
        information = H[6:, 6:] - H[6:, :6] @ np.linalg.solve(H[:6, :6], H[:6, 6:])
        return information, turn
