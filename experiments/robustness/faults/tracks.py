# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The front-end errs: ids, mismatches, a pose."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ba_node.measurements import FeatureTracks, Keyframe
from experiments.robustness.faults.recording import FloatArray, Recording, rows_of

IdArray = NDArray[np.uint64]

# How many tracks one moving object carries.
_OBJECT_TRACKS = 25


def ids_reused(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Number tracks by places in a list: a place that becomes free is taken by the next new track."""
    place: dict[int, int] = {}
    current = -1

    def change(image: FeatureTracks) -> FeatureTracks:
        nonlocal current
        ids = image.track_id.tolist()
        if image.camera_index == 0 and image.keyframe_id != current:
            current = image.keyframe_id
            for gone in place.keys() - set(ids):
                del place[gone]
            free = iter(sorted(set(range(len(ids) + len(place))) - set(place.values())))
            for new in ids:
                if new not in place:
                    place[new] = next(free)
        return dataclasses.replace(image, track_id=np.array([place[key] for key in ids], dtype=np.uint64))

    return recording.changed(FeatureTracks, change)


def wrong_ids(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Mix up the ids in some keyframes in a row, in all cameras alike."""
    n = len(recording.keyframes)
    first = int(rng.integers(n // 3, n // 2))
    ids = np.unique(np.concatenate([m.track_id for m in recording.measurements if isinstance(m, FeatureTracks)]))
    mixed = {k: rng.permutation(ids) for k in range(first, first + int(amount))}

    def change(image: FeatureTracks) -> FeatureTracks:
        other = mixed.get(recording.number(image.keyframe_id))
        if other is None:
            return image
        return dataclasses.replace(image, track_id=other[np.searchsorted(ids, image.track_id)])

    return recording.changed(FeatureTracks, change)


def outliers_uniform(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Move a share of the observations to anywhere in the image."""

    def change(image: FeatureTracks) -> FeatureTracks:
        wrong = rng.random(len(image.uv)) < amount
        anywhere = rng.random(image.uv.shape) * (recording.sound.rig.image_size[image.camera_index] - 1.0)
        return _with_pixels(image, wrong, anywhere)

    return recording.changed(FeatureTracks, change)


def outliers_jumping(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Let tracks jump to another point, which they follow from then on: about a share of the observations."""
    projector, sound = recording.projector, recording.sound
    ids = np.sort(sound.track_id)
    first, last = _life(recording, ids)
    # A track that jumps does so somewhere in its life, so half of its observations are wrong.
    jumps = rng.random(len(ids)) < 2.0 * amount
    at = np.where(jumps, np.ceil(first + rng.random(len(ids)) * (last - first)), np.inf)
    at = np.where(2.0 * amount * rng.random(len(ids)) > 1.0, first, at)
    other = _neighbours(recording, ids, rng)

    def change(image: FeatureTracks) -> FeatureTracks:
        rows = np.searchsorted(ids, image.track_id)
        uv = projector.uv(image, sound.landmarks[other[rows]])
        uv += _noise_px(image) * rng.normal(size=uv.shape)
        wrong = (recording.number(image.keyframe_id) >= at[rows]) & np.isfinite(uv[:, 0])
        return _with_pixels(image, wrong, uv)

    return recording.changed(FeatureTracks, change)


def outliers_moving(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Put a share of the tracks on objects that move: neighbouring points, each object with a velocity of its own."""
    projector, sound = recording.projector, recording.sound
    ids = np.sort(sound.track_id)
    place = sound.landmarks[projector.landmarks(ids)]
    first, _ = _life(recording, ids)
    velocity = np.zeros((len(ids), 3))
    free = np.ones(len(ids), dtype=bool)
    wanted = round(amount * len(ids))
    while (missing := wanted - np.count_nonzero(~free)) > 0:
        seed = rng.choice(np.flatnonzero(free))
        # Neighbours in space that begin at about the same time.
        distance = np.linalg.norm(place - place[seed], axis=1) + 0.1 * np.abs(first - first[seed])
        members = np.argsort(np.where(free, distance, np.inf))[: min(_OBJECT_TRACKS, missing)]
        velocity[members] = rng.normal(size=3) * [0.15, 0.15, 0.02]
        free[members] = False

    def change(image: FeatureTracks) -> FeatureTracks:
        rows = np.searchsorted(ids, image.track_id)
        moved = (recording.number(image.keyframe_id) - first[rows])[:, None] * velocity[rows]
        uv = projector.uv(image, place[rows] + moved)
        shown = free[rows] | np.isfinite(uv[:, 0])
        noisy = uv + _noise_px(image) * rng.normal(size=uv.shape)
        return rows_of(_with_pixels(image, ~free[rows], noisy), shown)

    return recording.changed(FeatureTracks, change)


def few_points(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Keep the oldest few tracks of every keyframe."""
    kept: dict[int, IdArray] = {}
    for image in recording.measurements:
        if isinstance(image, FeatureTracks) and image.camera_index == 0:
            kept[image.keyframe_id] = np.sort(image.track_id)[: int(amount)]
    return recording.changed(
        FeatureTracks, lambda image: rows_of(image, np.isin(image.track_id, kept[image.keyframe_id]))
    )


def one_keyframe_far(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Publish one keyframe some metres off; those after it are good."""
    n = len(recording.keyframes)
    at = int(rng.integers(n // 3, n // 2))
    direction = rng.normal(size=3)
    shift = amount * direction / np.linalg.norm(direction)

    def change(keyframe: Keyframe) -> Keyframe:
        if recording.number(keyframe.keyframe_id) != at:
            return keyframe
        return dataclasses.replace(keyframe, position=keyframe.position + shift)

    return recording.changed(Keyframe, change)


def _life(recording: Recording, ids: IdArray) -> tuple[FloatArray, FloatArray]:
    """Return the first and the last keyframe of each track (ids sorted): two (n,)."""
    first, last = np.full(len(ids), np.inf), np.full(len(ids), -1.0)
    for image in recording.measurements:
        if isinstance(image, FeatureTracks):
            rows, k = np.searchsorted(ids, image.track_id), recording.number(image.keyframe_id)
            first[rows] = np.minimum(first[rows], k)
            last[rows] = np.maximum(last[rows], k)
    return first, last


def _neighbours(recording: Recording, ids: IdArray, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return for each track a point near its own, 0.3 m or more away."""
    points, own = recording.sound.landmarks, recording.projector.landmarks(ids)
    result = np.empty(len(ids), dtype=np.intp)
    for i, landmark in enumerate(own):
        distance = np.linalg.norm(points - points[landmark], axis=1)
        near = np.argsort(np.where(distance < 0.3, np.inf, distance))[:10]
        result[i] = rng.choice(near)
    return result


def _noise_px(image: FeatureTracks) -> float:
    return float(image.sigma_px[0]) if len(image.sigma_px) else 0.0


def _with_pixels(image: FeatureTracks, wrong: NDArray[np.bool_], uv: FloatArray) -> FeatureTracks:
    moved = np.where(wrong[:, None], uv, image.uv)
    return dataclasses.replace(image, uv=moved.astype(np.float32).astype(np.float64))


def sigma_zero(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Say of a share of the observations that they are exact."""

    def change(image: FeatureTracks) -> FeatureTracks:
        exact = rng.random(len(image.uv)) < amount
        return dataclasses.replace(image, sigma_px=np.where(exact, 0.0, image.sigma_px))

    return recording.changed(FeatureTracks, change)


def huge_coordinate(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Give one observation of every image a coordinate of many pixels."""

    def change(image: FeatureTracks) -> FeatureTracks:
        uv = image.uv.copy()
        uv[: min(len(uv), 1)] = [amount, -amount]
        return dataclasses.replace(image, uv=uv)

    return recording.changed(FeatureTracks, change)
