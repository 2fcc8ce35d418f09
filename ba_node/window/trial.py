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

from dataclasses import dataclass, replace

import numpy as np

from ba_node import native
from ba_node.arrays import FloatArray, IdArray, IntArray, ranges
from ba_node.core import native_kernels, triangulation
from ba_node.core.problem import Problem, State

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

    def worse(self, share: float) -> list[int]:
        """Return which residuals the second set raises by more than a share: 0 for all cameras, 1 + camera."""
        before, after = self.mean.tolist()
        return [k for k, mean in enumerate(after) if mean > (1.0 + share) * before[k] + _SLACK]


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
        return _explained(problem, (rows, track), (len(tried), n_out), (before, after))
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


def _explained(
    problem: Problem, views: tuple[IntArray, IntArray], sizes: tuple[int, int], poses: tuple[Poses, Poses]
) -> Explained:
    """Return the same of observations, each of a track; ``sizes`` are numbers of tracks, and of those held out."""
    (rows, track), (n_tried, n_out), n_cam = views, sizes, len(problem.cameras.model)
    good = np.isfinite(triangulation.rays_in_cameras(problem, rows)[:, 2])
    none = np.empty(0)
    seen = replace(problem.observations.take(rows[good]), point=track[good], depth_m=none, depth_sigma_m=none)
    held_out, mean = np.zeros(2), np.full((2, 1 + n_cam), np.nan)
    # Views of all cameras, and of each alone; one camera is both. All go at once, by either poses: each such part has
    # points of its own, and the poses have keyframes of their own.
    kinds = [np.arange(len(seen)), *(np.flatnonzero(seen.camera == c) for c in range(n_cam if n_cam > 1 else 0))]
    parts, n_kinds = [*kinds, *kinds], len(kinds)
    every, part = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(own) for own in parts])
    at = replace(
        seen.take(every),
        point=seen.point[every] + n_tried * part,
        keyframe=seen.keyframe[every] + problem.n_keyframes * (part // n_kinds),
    )
    rotation, translation = (np.concatenate(of_both) for of_both in zip(*poses, strict=True))
    state = State(rotation, translation, np.zeros((n_tried * len(parts), 3)), np.empty((0, 3)))
    fit = Problem(state, np.zeros(len(rotation), bool), problem.cameras, at)
    rays = triangulation.rays_of(fit, "numpy")
    found = triangulation.triangulate(rays, fit.n_points, "numpy")
    state = replace(state, points=np.nan_to_num(found.points))
    norms = np.split(native_kernels.residual_norms(fit, state, "numpy"), np.cumsum([len(own) for own in parts[:-1]]))
    parallax_rad = found.parallax_rad.reshape(2, n_kinds, n_tried)
    noise_rad = 1.0 / median(rays.px_per_rad[: len(seen)]) if len(seen) else 0.0
    for kind, own in enumerate(kinds):
        point = seen.point[own]
        # Views by different keyframes; a track of fewer is explained by any poses.
        by_keyframe = np.unique(point * problem.n_keyframes + seen.keyframe[own])
        counts = np.bincount(by_keyframe // problem.n_keyframes, minlength=n_tried) >= _MIN_VIEWS
        # Rays that are parallel by either set meet anywhere.
        counts &= (parallax_rad[:, kind] > MIN_PARALLAX * noise_rad).all(axis=0)
        counted, is_out = counts[point], point < n_out
        for i, of_views in enumerate(norms[kind::n_kinds]):
            if np.count_nonzero(counted) >= _MIN_RESIDUALS:
                mean[i, kind] = np.minimum(of_views[counted], _BOUND).mean()
            if kind == 0 and (counted & is_out).any():
                held_out[i] = min(median(of_views[counted & is_out]), _BEHIND)
    points = found.points[n_kinds * n_tried :][:n_out]
    return Explained(held_out, mean, median(parallax_rad[1, 0]) if n_tried else 0.0, points)


def median(values: FloatArray) -> float:
    """Return the (upper) median of some values: numpy's takes ten times as long for as few."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
