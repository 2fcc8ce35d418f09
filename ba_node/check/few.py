# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of a session that ends with few keyframes what the other tests need more of them for.

All tracks are adjusted at once, with free poses. Where other cameras leave clearly less of the residuals, in units of
what is stated of the pixels, the given ones are wrong; which parameter it is few keyframes hardly tell. Less is enough
where turns are then nearer to those of the front-end: what no model tells of a real lens turns them away.

Where the map explains the tracks far worse than free poses do, the front-end's steps speak against them: then a single
pair of images is enough to tell a known mistake by, if the steps are off by an absurd angle, and not once it is undone.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check import intrinsics, motion, relations
from ba_node.check.adjusted import Adjusted, Freed, Measure, placed, problem_of_all
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.tracks import Tracks
from ba_node.core import geometry, native_kernels
from ba_node.core.cameras import CX, FX
from ba_node.core.problem import State

# Keyframes of which tracks of two views are taken too, and observations that are adjusted.
_VERY_FEW, _OBSERVATIONS = 3, 4000
# What other cameras have to leave less, in all and of each observation: sound drives show 6 in all, and real lenses
# 0.013 of each, of which no model is exact. And where turns fit those of the front-end better, to this share of what
# they are off: real lenses, so adjusted, leave twice as much and more.
_SURE, _OF_EACH = 12.0, 0.02
_CONFIRMED, _OF_EACH_CONFIRMED, _CLOSER = 7.0, 0.005, 0.95
# A camera that is in fewer keyframes is not judged.
_LEAST_IMAGES = 2
# What is named is off by so much, and so many standard deviations.
_NAMED_FACTOR, _NAMED_SHIFT, _NAMED_SIGMAS = 0.1, 0.1, 4.0
# A residual counts as so much at most, sigmas; and by what factor those of the map are far larger than with free poses.
_BOUND, _FAR_LARGER = 5.0, 2.0
_K, _ROI = "k of camera_info in camera_rig", "roi in camera_info in camera_rig, or the principal point in k"


def check_few(tracks: Tracks, rotation: FloatArray, position: FloatArray) -> Diagnosis:
    """Return what a few keyframes tell of the set-up, beside refined poses (n_kf, 3, 3) and (n_kf, 3), m."""
    count = len(tracks)
    problem = problem_of_all(tracks, np.arange(count), _OBSERVATIONS, 2 if count <= _VERY_FEW else 3)
    if problem is None:
        return Diagnosis(untold=["too few tracks to judge the cameras"])
    given = Adjusted(problem, tracks.cameras.params)
    related = relations.in_motion(tracks)
    poses = geometry.inverse(rotation, position - position[0])
    by_map = State(*poses, given.state.points, given.state.intrinsics)
    ours, free = (
        native_kernels.residual_norms(at, at.start)
        for at in (placed(dataclasses.replace(problem, start=state)) for state in (by_map, given.state))
    )
    if np.minimum(ours, _BOUND).mean() > _FAR_LARGER * np.minimum(free, _BOUND).mean():
        found = motion.check_motion(tracks, related, doubted=True)
        if found.findings:
            return found
    images = {camera: sum(one == camera for _, one in tracks.images) for camera in range(len(tracks.cameras.model))}
    if min(images.values()) < _LEAST_IMAGES:
        return Diagnosis(untold=["too few images of a camera to judge it"])
    return _of_cameras(tracks, given, relations.median_share(related))


def _of_cameras(tracks: Tracks, given: Adjusted, share: float) -> Diagnosis:
    """Return what is wrong if other cameras explain the tracks better; fewer agree where objects move: then by far."""
    measure = Measure(given.norms, max(1.0, Measure(given.norms).noise))
    free, now, before = Freed(given), measure(given), given.state
    tried = [(model, measure(Adjusted(given.problem, model.params, model.lens))) for model in _lenses(tracks)]
    best = min([measure(free), *(left for _, left in tried)])
    closer = _off(tracks, free.state) < _CLOSER * _off(tracks, before)
    if _is_better(best, now, len(measure), share, closer):
        # Then the given ones get every chance.
        now = min(now, given.thorough(free.state, measure))
    if not _is_better(best, now, len(measure), share, closer):
        return Diagnosis(untold=["too few keyframes to judge the cameras by"])
    causes = _named(tracks, free)
    causes |= {model.cause: model.change for model, left in tried if left < 0.5 * (best + now)}
    if not causes:
        causes = {"focal length, principal point (region of interest, binning) or distortion wrong": f"{_K}, or d"}
    if len(tracks.cameras.model) > 1:
        causes["cameras that do not sit on the body as the rig says, or are not synchronised"] = "body_from_camera"
    causes["much of what is seen moves"] = "what the feature_tracks follow"
    evidence = f"other cameras leave {best / now:.0%} of the loss of {len(tracks)} keyframes, adjusted freely"
    return Diagnosis([Finding(tuple(causes), evidence, tuple(causes.values()))])


def _is_better(best: float, now: float, count: int, share: float, closer: bool) -> bool:
    left = 0.0 if share < relations.AGREED else intrinsics.LEFT if share < intrinsics.MOST_AGREE else 1.0
    limits = (_SURE, _OF_EACH), (_CONFIRMED, _OF_EACH_CONFIRMED)
    clear = any(count * (now - best) > sure and now - best > each for sure, each in limits[: 1 + closer])
    return clear and best < left * now


def _off(tracks: Tracks, state: State) -> float:
    """Return how far the turns of some poses are off those of the front-end, rad."""
    turns = state.rotation[:-1] @ np.swapaxes(state.rotation[1:], 1, 2)
    told = np.swapaxes(tracks.rotation[:-1], 1, 2) @ tracks.rotation[1:]
    return float(np.sqrt(np.mean(np.sum(geometry.so3_log(np.swapaxes(told, 1, 2) @ turns) ** 2, axis=1))))


def _lenses(tracks: Tracks) -> list[intrinsics.Model]:
    return [*intrinsics.other_lenses(tracks), *intrinsics.other_sizes(tracks)]


def _named(tracks: Tracks, free: Freed) -> dict[str, str]:
    """Return what the cameras that fit differ in by far, and what to change."""
    given, fits = tracks.cameras.params[0], free.params[0]
    factor, shift = float(given[FX] / fits[FX]), np.abs(fits[CX : CX + 2] - given[CX : CX + 2]) / given[FX]
    named = {}
    if abs(np.log(factor)) > max(_NAMED_FACTOR, _NAMED_SIGMAS * float(free.sigma[0])):
        named[f"focal length off by a factor of about {factor:.2f}"] = _K
    if (shift > np.maximum(_NAMED_SHIFT, _NAMED_SIGMAS * free.sigma[1:])).any():
        cause = f"region of interest not applied, or principal point wrong, by about {np.max(shift) * given[FX]:.0f} px"
        named[cause] = _ROI
    return named
