# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find keyframes that differ from another by a rotation alone, as far as the images can tell, and measure it.

A camera that stands still or turns on the spot shows no parallax, and points cannot be placed. If the front-end's
orientations are off by more than the pixel noise, rays seem to meet all the same, anywhere. So before points are
placed: with unit rays ``a_i`` and ``b_i`` of the same tracks in two keyframes, in the body, the rotation is the R that
minimises ``sum w_i |a_i - R b_i|^2`` (Kabsch), the weights w being those of Cauchy's loss. Where it leaves no more than
noise, there is no parallax, and R is far better than the front-end's.

Only keyframes that see few points with a place are looked at: the others have better to go by. Each is compared with
the one before, and then with the first of its run, its anchor, so that slow motion is told from none once it has added
up. A camera that does not sit on the axis moves as the body turns, and near points take that for more of a turn: such
turns are left to the front-end.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import cameras, geometry
from ba_node.core.problem import Problem

# A keyframe that sees fewer points with a place than this is looked at.
_FEW_POINTS = 30
# So many tracks two keyframes must share, and that share of the later one's.
_LEAST_SHARED = 10
_LEAST_OVERLAP = 0.4
# A rotation explains a ray that it leaves within so many standard deviations, and two keyframes by that share of rays.
_WITHIN = 4.0
_LEAST_EXPLAINED = 0.6
_ROUNDS = 5
# A camera beside the axis moves as the body turns. With points this near that feigns a rotation, which must be noise.
_NEAR_M = 2.0
# A camera that turns on loses its anchor from sight: so many anchors may follow each other.
_MAX_ANCHORS = 4


@dataclass(frozen=True)
class Turns:
    """What was found, by keyframe of a problem."""

    anchor: IntArray  # (n_kf,) row in the scene of the keyframe that it differs from by a rotation alone, -1 for none
    rotation: FloatArray  # (n_kf, 3, 3) body of the anchor from body
    sigma_rad: FloatArray  # (n_kf,) standard deviation of the rotation about each axis: that of one ray

    def take(self, keyframes: BoolArray) -> Turns:
        """Return what was found of some keyframes."""
        return Turns(self.anchor[keyframes], self.rotation[keyframes], self.sigma_rad[keyframes])

    def between(self, rows: IntArray, first: IntArray, second: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return rotations (n, 3, 3), first body from second, and their standard deviations, NaN where not found.

        ``rows`` (n_kf,) are the keyframes in the scene, ``first`` and ``second`` (n,) numbers of keyframes.
        """
        of_anchor = self.anchor[second] == rows[first]
        same = (self.anchor[second] >= 0) & (self.anchor[second] == self.anchor[first])
        through = np.swapaxes(self.rotation[first], 1, 2) @ self.rotation[second]
        rotation = np.where(of_anchor[:, None, None], self.rotation[second], through)
        return rotation, np.where(of_anchor | same, self.sigma_rad[second], np.nan)

    def applied(self, problem: Problem, rows: IntArray, free: BoolArray) -> Problem:
        """Return a problem that begins with these rotations.

        Each keyframe keeps its place as seen from the one before.

        ``rows`` (n_kf,) are its keyframes in the scene, oldest first; ``free`` (n_kf,) may be turned.
        """
        first = np.arange(len(rows) - 1)
        measured, sigma = self.between(rows, first, first + 1)
        before = problem.start.rotation, problem.start.translation
        rotation, translation = before[0].copy(), before[1].copy()
        turned = False
        for k in np.flatnonzero(free[1:]) + 1:
            known = not np.isnan(sigma[k - 1])
            turned |= known
            if not turned:
                continue
            back = geometry.inverse(before[0][k], before[1][k])
            step_rotation, step = geometry.compose(before[0][k - 1], before[1][k - 1], *back)
            if known:
                step_rotation = measured[k - 1]
            back = geometry.inverse(step_rotation, step)
            rotation[k], translation[k] = geometry.compose(*back, rotation[k - 1], translation[k - 1])
        start = dataclasses.replace(problem.start, rotation=rotation, translation=translation)
        return dataclasses.replace(problem, start=start)


@dataclass(frozen=True)
class _Rays:
    """Rays of a problem, sorted by keyframe and track."""

    key: IntArray  # (n,) camera and point
    keyframe: IntArray  # (n,)
    direction: FloatArray  # (n, 3) unit vector in the body
    sigma_rad: FloatArray  # (n,) standard deviation across it
    n_keys: int  # keys are below this


def find(problem: Problem, rows: IntArray, used: BoolArray, placed: BoolArray) -> Turns | None:
    """Return the keyframes that differ from an earlier one by a rotation alone; None if there is none.

    Keyframes are oldest first, ``rows`` (n_kf,) in the scene; ``used`` (n_obs,) observations are looked at, ``placed``
    (n_pt,) points have a place. The problem's start is not looked at.
    """
    obs, n = problem.observations, problem.n_keyframes
    if native.kernels is not None:
        every, well = native.kernels.seen_by_keyframe(obs, used, placed, n)
    else:
        every = np.bincount(obs.keyframe[used], minlength=n)
        well = np.bincount(obs.keyframe[used & placed.take(obs.point)], minlength=n)
    weak = (well < _FEW_POINTS) & (every >= _LEAST_SHARED)
    weak[:1] = False
    if not weak.any():
        return None
    rays = _rays(problem, used)
    anchor = np.where(weak, np.arange(n) - 1, -1)
    rotation, found, _ = _compare(rays, anchor)
    if not found.any():
        return None
    sigma = np.zeros(n)
    np.maximum.at(sigma, rays.keyframe, rays.sigma_rad)
    sigma *= np.sqrt(2.0)
    done, before, chain = np.zeros(n, bool), found, np.full(n, -1)
    for _ in range(_MAX_ANCHORS):
        # The first of each run of keyframes that are still to be compared.
        left = before & ~done
        begins = left & ~np.append(False, left[:-1])
        wanted = np.where(left, np.maximum.accumulate(np.where(begins, np.arange(n) - 1, -1)), -1)
        turned, explained, shared = _compare(rays, wanted)
        explained &= _swing(problem, turned) <= _NEAR_M * sigma
        chain[explained], rotation[explained] = wanted[explained], turned[explained]
        done |= explained
        # Parallax has added up: from there on it is no rotation alone.
        before &= ~((wanted >= 0) & shared & ~explained)
        if not (before & ~done).any():
            break
    return Turns(np.where(done, rows[chain], -1), rotation, sigma)


def _swing(problem: Problem, turned: FloatArray) -> FloatArray:
    """Return how far rotations of the body move the camera that they move most, (n_kf,) m."""
    rig = problem.cameras
    centre = -(np.swapaxes(rig.rotation, 1, 2) @ rig.translation[:, :, None])[..., 0]
    return np.asarray(np.linalg.norm((turned - np.eye(3)) @ centre.T, axis=1).max(axis=1))


def _rays(problem: Problem, used: BoolArray) -> _Rays:
    obs, rig = problem.observations, problem.cameras
    n_cam = len(rig.model)
    rows = np.flatnonzero(used)
    key = obs.point[rows] * n_cam + obs.camera[rows]
    n_keys = problem.n_points * n_cam
    params = rig.params[obs.camera[rows]]
    ray = np.ones((len(rows), 3))
    ray[:, :2] = cameras.normalise(obs.uv[rows], rig.model[obs.camera[rows]], params)
    ray /= np.sqrt(np.sum(ray * ray, axis=1, keepdims=True))
    direction = (np.swapaxes(rig.rotation, 1, 2)[obs.camera[rows]] @ ray[:, :, None])[..., 0]
    sigma = obs.sigma_px[rows] / np.sqrt(params[:, cameras.FX] * params[:, cameras.FY])
    good = np.flatnonzero(np.isfinite(ray[:, 0]))
    order = good[np.argsort(obs.keyframe[rows[good]] * n_keys + key[good], kind="stable")]
    return _Rays(key[order], obs.keyframe[rows[order]], direction[order], sigma[order], n_keys)


def _compare(rays: _Rays, anchor: IntArray) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Compare each keyframe with its anchor, (n_kf,) or -1 for none.

    Returns:
        (n_kf, 3, 3) rotations, anchor from keyframe; (n_kf,) where these explain the views; (n_kf,) where both share
        enough tracks for that to be told.
    """
    n = len(anchor)
    rotation = np.tile(np.eye(3), (n, 1, 1))
    all_keys = rays.keyframe * rays.n_keys + rays.key
    rows = np.flatnonzero(anchor[rays.keyframe] >= 0)
    wanted = anchor[rays.keyframe[rows]] * rays.n_keys + rays.key[rows]
    at = np.minimum(np.searchsorted(all_keys, wanted), max(len(all_keys) - 1, 0))
    met = all_keys[at] == wanted
    rows, at = rows[met], at[met]
    pair = rays.keyframe[rows]
    count = np.bincount(pair, minlength=n)
    enough = (count >= _LEAST_SHARED) & (count >= _LEAST_OVERLAP * np.bincount(rays.keyframe, minlength=n))
    kept = enough[pair]
    rows, at, pair = rows[kept], at[kept], pair[kept]
    if not len(rows):
        return rotation, np.zeros(n, bool), enough
    a, b = rays.direction[at], rays.direction[rows]
    sigma = np.hypot(rays.sigma_rad[at], rays.sigma_rad[rows])
    starts = np.flatnonzero(np.diff(pair, prepend=-1))
    which, length = pair[starts], np.diff(starts, append=len(pair))
    weight, off = np.ones(len(pair)), np.zeros(len(pair))
    for _ in range(_ROUNDS):
        products = ((weight[:, None] * a)[:, :, None] * b[:, None, :]).reshape(-1, 9)
        turn = geometry.nearest_rotation(np.add.reduceat(products, starts).reshape(-1, 3, 3))
        left = a - (np.repeat(turn, length, axis=0) @ b[:, :, None])[..., 0]
        off = np.sqrt(np.sum(left * left, axis=1)) / sigma
        scale = np.maximum(_medians(off, starts, length), 1.0)
        weight = 1.0 / (sigma * sigma * (1.0 + (off / np.repeat(scale, length)) ** 2))
        weight /= np.repeat(np.maximum.reduceat(weight, starts), length)
    rotation[which] = turn
    share = np.add.reduceat((off <= _WITHIN).astype(float), starts) / length
    explained = np.zeros(n, bool)
    explained[which] = share >= _LEAST_EXPLAINED
    return rotation, explained, enough


def _medians(values: FloatArray, starts: IntArray, length: IntArray) -> FloatArray:
    """Return the (upper) median of each run."""
    run = np.repeat(np.arange(len(starts)), length)
    return np.asarray(values[np.lexsort((values, run))][starts + length // 2])
