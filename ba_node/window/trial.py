# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Try poses on some tracks: how well do they explain them, wherever the points lie?

The points are triangulated anew, robustly, under each set of poses, so the frame and (for one camera) the scale of the
poses do not matter, nor what a solve made of the points. Which tracks are tried is a fixed choice by their ids; most of
them take no part in the solve.

Each track is tried with the views of all cameras, and once more with those of each camera alone: where cameras do not
sit on the body as the rig says, a solution is a compromise that each camera by itself explains worse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ba_node.core import native_kernels, triangulation
from ba_node.core.cameras import FX, FY, normalise
from ba_node.core.problem import Observations, Problem, State

if TYPE_CHECKING:
    from ba_node.scene.tables import FloatArray, IdArray, IntArray

# One track in so many may sit a solve out: more would be missed by a small window.
_SHARE = 64
# Rays that meet at fewer standard deviations of a pixel than this tell no distance.
MIN_PARALLAX = 4.0
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
    """Return the points to try poses on, and those of them that are to sit the solve out.

    Args:
        track_id: (n_pt,) uint64.
        point: of each usable observation.
        wanted: points to try.
    """
    views = np.bincount(point, minlength=len(track_id))
    candidates = np.flatnonzero(views > _MIN_VIEWS)
    if len(candidates) < wanted:
        candidates = np.flatnonzero(views > 1)
    if wanted <= 0 or not len(candidates):
        return candidates[:0], candidates[:0]
    with np.errstate(over="ignore"):
        key = track_id[candidates] * _HASH
    tried = candidates[np.argsort(key, kind="stable")[:wanted]]
    return tried, tried[: len(track_id) // _SHARE]


@dataclass(frozen=True)
class Explained:
    """How well two sets of poses explain the tracks: of all cameras together, then of each alone.

    Attributes:
        held_out: (2,) median of the residuals of the tracks that took no part, sigmas; 0 without any.
        mean: (2, 1 + n_cam) of the residuals of all, each bounded, sigmas; NaN where there are too few.
        parallax_rad: median over the tracks of the largest angle between two rays, by the second set of poses.
    """

    held_out: FloatArray
    mean: FloatArray
    parallax_rad: float

    def worse(self, share: float) -> IntArray:
        """Return which residuals the second set raises by more than a share: 0 for all cameras, 1 + camera."""
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(self.mean[1] > (1.0 + share) * self.mean[0] + _SLACK)


class Trial:
    """Some tracks of a problem."""

    def __init__(self, problem: Problem, tried: IntArray, n_out: int, backend: str = "auto") -> None:
        """Take the views of the tracks ``tried`` out of a problem; the first ``n_out`` of them took no part."""
        self._problem, self._backend, self._n_out = problem, backend, n_out
        self._n_cam = len(problem.cameras.model)
        obs, n = problem.observations, len(tried)
        number = np.full(problem.n_points, -1)
        number[tried] = np.arange(n)
        rows = np.flatnonzero(number.take(obs.point) >= 0)
        group = number.take(obs.point.take(rows))
        rows = rows.take(np.argsort(group, kind="stable"))
        if self._n_cam > 1:
            alone = number.take(obs.point.take(rows)) * self._n_cam + obs.camera.take(rows) + n
            order = np.argsort(alone, kind="stable")
            group = np.concatenate([number.take(obs.point.take(rows)), alone.take(order)])
            rows = np.concatenate([rows, rows.take(order)])
            self.n_groups = n * (1 + self._n_cam)
        else:
            group = number.take(obs.point.take(rows))
            self.n_groups = n
        self._n_tried = n
        self._prepare(obs, rows, group)

    def _prepare(self, obs: Observations, rows: IntArray, group: IntArray) -> None:
        cams = self._problem.cameras
        camera = obs.camera.take(rows)
        self._obs = Observations(
            obs.keyframe.take(rows),
            camera,
            group,
            obs.uv.take(rows, axis=0),
            obs.sigma_px.take(rows),
            np.empty(0),
            np.empty(0),
        )
        ray = np.ones((len(rows), 3))
        ray[:, :2] = normalise(self._obs.uv, cams.model[camera], cams.params[camera])
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        turn = np.swapaxes(cams.rotation, 1, 2)
        self._direction = (turn[camera] @ ray[:, :, None])[..., 0]
        self._centre = (-(turn @ cams.translation[:, :, None])[..., 0])[camera]
        focal = np.sqrt(cams.params[:, FX] * cams.params[:, FY])
        self._px_per_rad = focal[camera] / self._obs.sigma_px
        self._noise_rad = 1.0 / float(np.median(self._px_per_rad)) if len(rows) else 0.0
        self._good = np.isfinite(ray[:, 0])
        # Views by different keyframes; a track of fewer is explained by any poses.
        key = group * self._problem.n_keyframes + self._obs.keyframe
        distinct = np.ones(len(key), bool)
        distinct[1:] = key[1:] != key[:-1]
        views = np.bincount(group[self._good & distinct], minlength=self.n_groups)
        self._counts = self._good & (views >= _MIN_VIEWS).take(group)
        # 0 for all cameras together, then each alone; one camera is both.
        self._of = np.where(group < self._n_tried, 0, 1 + camera)

    def explained(self, *poses: tuple[FloatArray, FloatArray]) -> Explained:
        """Return how well two sets of poses explain the tracks.

        Args:
            poses: (n_kf, 3, 3) and (n_kf, 3) body from world, m, of each.
        """
        norms, parallax = zip(*(self._norms(*one) for one in poses), strict=True)
        # Rays that are parallel by either set meet anywhere.
        counts = self._counts & (np.minimum(*parallax) > MIN_PARALLAX * self._noise_rad).take(self._obs.point)
        mean, held_out = np.full((2, 1 + self._n_cam), np.nan), np.zeros(2)
        for i, found in enumerate(norms):
            for k in range(1 + self._n_cam if self._n_cam > 1 else 1):
                own = found[counts & (self._of == k)]
                if len(own) >= _MIN_RESIDUALS:
                    mean[i, k] = np.mean(np.minimum(own, _BOUND))
            out = found[self._counts & (self._obs.point < self._n_out)]
            held_out[i] = min(float(np.median(out)), _BEHIND) if len(out) else 0.0
        joint = parallax[1][: self._n_tried]
        return Explained(held_out, mean, float(np.median(joint)) if len(joint) else 0.0)

    def _norms(self, rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray]:
        turn = np.swapaxes(rotation, 1, 2).take(self._obs.keyframe, axis=0)
        from_body = self._centre - translation.take(self._obs.keyframe, axis=0)
        good, nan = self._good, np.full(int(np.count_nonzero(self._good)), np.nan)
        rays = triangulation.Rays(
            self._obs.point[good],
            (turn @ from_body[:, :, None])[good, :, 0],
            (turn @ self._direction[:, :, None])[good, :, 0],
            self._px_per_rad[good],
            nan,
            nan,
        )
        found = triangulation.triangulate(rays, self.n_groups, self._backend)
        state = State(rotation, translation, np.nan_to_num(found.points), np.empty((0, 3)))
        problem = Problem(state, self._problem.fixed, self._problem.cameras, self._obs)
        return native_kernels.residual_norms(problem, state, self._backend), found.parallax_rad
