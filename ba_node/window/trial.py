# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare how well two sets of poses explain some tracks, wherever the points lie.

The points are triangulated anew, robustly, under each set of poses, so the frame and (for one camera) the scale of the
poses do not matter, nor what a solve made of the points. Which tracks are tried is a fixed choice by their ids; most of
them take no part in the solve.

Each track is tried with the views of all cameras, and once more with those of each camera alone: where cameras do not
sit on the body as the rig says, a solution is a compromise that each camera by itself explains worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node import native
from ba_node.arrays import FloatArray, IdArray, IntArray, ranges
from ba_node.core import native_kernels, triangulation
from ba_node.core.cameras import FX, FY, rays
from ba_node.core.problem import Observations, Problem, State

# One track in so many may sit a solve out: more would be missed by a small window.
_SHARE = 128
# Rays that meet at fewer standard deviations of a pixel than this tell no distance; those of a camera that stands still
# seem to meet at up to 4.1.
MIN_PARALLAX = 4.2
# A track with fewer views by fewer keyframes tells nothing: any poses explain it.
_MIN_VIEWS = 3
# Fewer residuals than this tell nothing.
_MIN_RESIDUALS = 50
# A residual, in sigmas, counts for no more than this.
_BOUND = 5.0
_BEHIND = 1e6
# Sigmas that the mean may grow in any case.
_SLACK = 0.05
_HASH = np.uint64(0x9E3779B97F4A7C15)


def choose(track_id: IdArray, point: IntArray, wanted: int) -> tuple[IntArray, IntArray]:
    """Return the points to try poses on, ``wanted`` of them, and those that are to sit the solve out.

    ``track_id`` is (n_pt,), ``point`` that of each usable observation.
    """
    if native.kernels is not None:
        tried: IntArray = native.kernels.tracks_to_try(track_id, point, wanted, _MIN_VIEWS, int(_HASH))
        return tried, tried[: len(track_id) // _SHARE]
    views = np.bincount(point, minlength=len(track_id))
    candidates = np.flatnonzero(views > _MIN_VIEWS)
    if len(candidates) < wanted:
        candidates = np.flatnonzero(views > 1)
    if wanted <= 0 or not len(candidates):
        return candidates[:0], candidates[:0]
    with np.errstate(over="ignore"):
        key = track_id[candidates] * _HASH
    if wanted < len(key):
        few = np.argpartition(key, wanted)[:wanted]
        candidates, key = candidates[few], key[few]
    tried = candidates[np.argsort(key, kind="stable")]
    return tried, tried[: len(track_id) // _SHARE]


@dataclass(frozen=True)
class Explained:
    """How well two sets of poses explain the tracks: of all cameras together, then of each alone."""

    held_out: FloatArray  # (2,) median of the residuals of the tracks that took no part, sigmas; 0 without parallax
    mean: FloatArray  # (2, 1 + n_cam) of the residuals of all, each bounded, sigmas; NaN where there are too few
    parallax_rad: float  # median over the tracks of the largest angle between two rays, by the second set of poses
    points: FloatArray  # (n_out, 3) those that took no part, by the second set of poses, m

    def worse(self, share: float) -> IntArray:
        """Return which residuals the second set raises by more than a share: 0 for all cameras, 1 + camera."""
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(self.mean[1] > (1.0 + share) * self.mean[0] + _SLACK)


# Rotation (n_kf, 3, 3) and translation (n_kf, 3) m of body from world.
Poses = tuple[FloatArray, FloatArray]


def explained(
    problem: Problem, tracks: tuple[IntArray, int], before: Poses, after: Poses, kernels: str = "auto"
) -> Explained:
    """Return how well two sets of poses explain some tracks of a problem, by their points.

    ``tracks`` are these points, and how many of them, the first ones, took no part in the solve.
    """
    tried, n_out = tracks
    rows, track = _views_of(tried, problem.observations.point)
    if kernels == "numpy" or native.kernels is None:
        return _Trial(problem, rows, track, (len(tried), n_out)).explained(before, after)
    limits = MIN_PARALLAX, _BOUND, _BEHIND, _MIN_VIEWS, _MIN_RESIDUALS
    others = (len(tried), n_out), (*before, *after), limits
    found = native.kernels.explained(problem, (rows, track, np.empty(0)), *others)
    found = found or native.kernels.explained(
        problem, (rows, track, triangulation.rays_in_cameras(problem, rows)), *others
    )
    return Explained(*found)


def _views_of(tried: IntArray, point: IntArray) -> tuple[IntArray, IntArray]:
    """Return the observations of some points, point by point, and which of these each is of; ``point`` ascends."""
    if native.kernels is not None:
        rows, track = native.kernels.rows_of_points(point, tried)
        return rows, track
    begin, end = (np.searchsorted(point, tried, side) for side in ("left", "right"))
    return ranges(begin, end), np.repeat(np.arange(len(tried)), end - begin)


class _Trial:
    """Some tracks of a problem, to be tried with two sets of poses at once: each view stands in all arrays twice."""

    def __init__(self, problem: Problem, rows: IntArray, track: IntArray, sizes: tuple[int, int]) -> None:
        """Take the views ``rows`` out of a problem, each of a ``track``; see :func:`explained`."""
        self._problem = problem
        self._n_cam, (self._n_tried, self._n_out) = len(problem.cameras.model), sizes
        self._rays(problem.observations, rows, track)

    def _rays(self, obs: Observations, rows: IntArray, group: IntArray) -> None:
        """Keep the rays of some observations, in the body, and to which track each belongs."""
        cams, n_kf = self._problem.cameras, self._problem.n_keyframes
        camera = obs.camera.take(rows)
        ray = rays(obs.uv.take(rows, axis=0), cams.model.take(camera), cams.params.take(camera, axis=0))
        good = np.isfinite(ray[:, 2])
        if not good.all():
            rows, group, camera, ray = rows[good], group[good], camera[good], ray[good]
        turn = np.swapaxes(cams.rotation, 1, 2)
        self._direction = np.tile(np.einsum("nij,nj->ni", turn.take(camera, axis=0), ray), (2, 1))
        self._centres = -(turn @ cams.translation[:, :, None])[..., 0]
        self._keyframe = _twice(obs.keyframe.take(rows), n_kf)
        order, n_groups = np.arange(len(rows)), self._n_tried
        if self._n_cam > 1:
            # All views of each track, and then those of each camera.
            alone = group * self._n_cam + camera
            by_camera = np.argsort(alone, kind="stable")
            group = np.concatenate([group, alone.take(by_camera) + self._n_tried])
            order = np.concatenate([order, by_camera])
            n_groups *= 1 + self._n_cam
        self._order = _twice(order, len(rows))
        self._views(obs, rows[order], group, n_groups)

    def _views(self, obs: Observations, rows: IntArray, group: IntArray, n_groups: int) -> None:
        """Keep the views by group, and which groups count."""
        cams, n_kf = self._problem.cameras, self._problem.n_keyframes
        keyframe, camera, sigma_px = obs.keyframe.take(rows), obs.camera.take(rows), obs.sigma_px.take(rows)
        # Views by different keyframes; a track of fewer is explained by any poses.
        key = group * n_kf + keyframe
        distinct = np.ones(len(key), bool)
        distinct[1:] = key[1:] != key[:-1]
        self._group, self._n_groups = group, n_groups
        self._counts = np.bincount(group[distinct], minlength=n_groups) >= _MIN_VIEWS
        # 0 for all cameras together, then each alone; one camera is both.
        self._of = np.where(group < self._n_tried, 0, 1 + camera)
        uv, none = np.tile(obs.uv.take(rows, axis=0), (2, 1)), np.empty(0)
        self._obs = Observations(
            _twice(keyframe, n_kf), np.tile(camera, 2), _twice(group, n_groups), uv, np.tile(sigma_px, 2), none, none
        )
        px_per_rad = np.sqrt(cams.params[:, FX] * cams.params[:, FY]).take(camera) / sigma_px
        self._noise_rad = 1.0 / median(px_per_rad) if len(rows) else 0.0
        self._px_per_rad = np.tile(px_per_rad, 2)
        self._image = _twice(keyframe * self._n_cam + camera, n_kf * self._n_cam)

    def explained(self, before: Poses, after: Poses) -> Explained:
        """Return how well two sets of poses explain the tracks."""
        points, parallax, norms = self._tried(*(np.concatenate(pair) for pair in zip(before, after, strict=True)))
        # Rays that are parallel by either set meet anywhere.
        wide = (parallax > MIN_PARALLAX * self._noise_rad).all(axis=0)
        rows = np.flatnonzero((self._counts & wide).take(self._group))
        n = 1 + self._n_cam
        count = np.bincount(self._of[rows], minlength=n)
        sums = [np.bincount(self._of[rows], np.minimum(norm[rows], _BOUND), n) for norm in norms]
        mean = np.where(count >= _MIN_RESIDUALS, np.array(sums) / np.maximum(count, 1), np.nan)
        out = rows[self._group[rows] < self._n_out]
        return Explained(
            np.array([min(median(norm[out]), _BEHIND) if len(out) else 0.0 for norm in norms]),
            mean,
            median(parallax[1, : self._n_tried]) if self._n_tried else 0.0,
            points[1, : self._n_out],
        )

    def _tried(self, rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points (2, n_groups, 3) m, their parallax (2, n_groups) rad, and residuals (2, n_obs) sigmas."""
        back = np.swapaxes(rotation, 1, 2)
        centres = (back[:, None] @ (self._centres - translation[:, None, :])[..., None]).reshape(-1, 3)
        directions = np.einsum("nij,nj->ni", back.take(self._keyframe, axis=0), self._direction)
        nan = np.full(len(self._order), np.nan)
        seen = triangulation.Rays(
            self._obs.point,
            centres.take(self._image, axis=0),
            directions.take(self._order, axis=0),
            self._px_per_rad,
            nan,
            nan,
        )
        found = triangulation.triangulate(seen, 2 * self._n_groups, "numpy")
        state = State(rotation, translation, np.nan_to_num(found.points), np.empty((0, 3)))
        problem = Problem(state, np.zeros(len(rotation), bool), self._problem.cameras, self._obs)
        norms = native_kernels.residual_norms(problem, state, "numpy")
        return found.points.reshape(2, -1, 3), found.parallax_rad.reshape(2, -1), norms.reshape(2, -1)


def _twice(index: IntArray, n: int) -> IntArray:
    """Return indices into a list of n, and once more into another list after it."""
    return np.concatenate([index, index + n])


def median(values: FloatArray) -> float:
    """Return the (upper) median of some values: numpy's takes ten times as long for as few."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
