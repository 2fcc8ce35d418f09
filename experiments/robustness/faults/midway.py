# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A recording that begins well and goes wrong on the way: what was right at first no longer is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from ba_node.core import geometry
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from experiments.robustness.faults import setup
from experiments.robustness.faults.recording import Entry, Recording, rows_of

Edit = Callable[[Recording, float, np.random.Generator], Recording]
# Keyframes that a new id is given to lie so far behind those of the sound recording.
_NEW_IDS = 10**6


def from_midway(edit: Edit) -> Edit:
    """Return a fault that befalls the second half of a recording alone."""

    def edited(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
        half = len(recording.keyframes) // 2
        spoiled = edit(recording, amount, rng)
        timeline: list[Entry] = []
        for before, after in zip(recording.timeline, spoiled.timeline, strict=True):
            of = before[2]
            later = isinstance(of, Keyframe | FeatureTracks) and recording.number(of.keyframe_id) >= half
            timeline.append(after if later else before)
        return dataclasses.replace(recording, timeline=tuple(timeline))

    return edited


def smaller(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Track in images that are smaller by a factor."""
    return recording.changed(FeatureTracks, lambda image: dataclasses.replace(image, uv=image.uv / amount))


def zoomed(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Multiply the focal length of the images, not that of the rig; what falls outside is not tracked."""

    def change(image: FeatureTracks) -> FeatureTracks:
        last = recording.sound.rig.image_size[image.camera_index] - 1.0
        uv = 0.5 * last + amount * (image.uv - 0.5 * last)
        return rows_of(dataclasses.replace(image, uv=uv), ((uv >= 0.0) & (uv <= last)).all(axis=1))

    return recording.changed(FeatureTracks, change)


def mirrored(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Exchange left and right in the images of the last camera."""
    last = len(recording.sound.rig) - 1

    def change(image: FeatureTracks) -> FeatureTracks:
        if image.camera_index != last:
            return image
        width = recording.sound.rig.image_size[last, 0]
        return dataclasses.replace(image, uv=[width - 1.0, 0.0] + image.uv * [-1.0, 1.0])

    return recording.changed(FeatureTracks, change)


def ids_shifted(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Count track ids from another number on, so that those of before stand for other points."""

    def change(image: FeatureTracks) -> FeatureTracks:
        return dataclasses.replace(image, track_id=image.track_id + np.uint64(amount))

    return recording.changed(FeatureTracks, change)


def other_index(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Lose the tracks of camera 0 in the middle, and send those of camera 1 in their place."""
    half = len(recording.keyframes) // 2

    def change(image: FeatureTracks) -> FeatureTracks | None:
        if recording.number(image.keyframe_id) < half:
            return image
        return dataclasses.replace(image, camera_index=0) if image.camera_index == 1 else None

    return recording.changed(FeatureTracks, change)


def falls_silent(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Lose the tracks of a camera from the middle on."""
    half = len(recording.keyframes) // 2

    def change(image: FeatureTracks) -> FeatureTracks | None:
        lost = image.camera_index == int(amount) and recording.number(image.keyframe_id) >= half
        return None if lost else image

    return recording.changed(FeatureTracks, change)


def rig_changes(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Send another rig in the middle, whose focal lengths are others; the images stay."""
    half = len(recording.keyframes) // 2
    rig = next(m for m in setup.focal_off(recording, amount, rng).measurements if isinstance(m, CameraRig))
    timeline: list[Entry] = []
    for topic, time_ns, measurement in recording.timeline:
        if isinstance(measurement, Keyframe) and recording.number(measurement.keyframe_id) == half:
            timeline.append(("camera_rig", time_ns, rig))
        timeline.append((topic, time_ns, measurement))
    return dataclasses.replace(recording, timeline=tuple(timeline))


def odometry_freezes(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Let the front-end's pose stand for some keyframes, and go on from there."""
    keyframes = recording.keyframes
    first = len(keyframes) // 3
    last = first + int(amount)
    poses = [(geometry.matrix_from_quaternion(one.orientation), one.position) for one in keyframes]
    # What is left out of the way: the pose at its beginning from that at its end.
    lost = geometry.compose(*poses[first], *geometry.inverse(*poses[last]))

    def change(keyframe: Keyframe) -> Keyframe:
        number = recording.number(keyframe.keyframe_id)
        if number <= first:
            return keyframe
        rotation, position = poses[first] if number <= last else geometry.compose(*lost, *poses[number])
        return dataclasses.replace(keyframe, position=position, orientation=geometry.quaternion_from_matrix(rotation))

    return recording.changed(Keyframe, change)


def restarts(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Let a front-end begin anew in the middle under the same session: at its origin, its ids higher by an amount."""
    half = recording.keyframes[len(recording.keyframes) // 2]
    origin = geometry.inverse(geometry.matrix_from_quaternion(half.orientation), half.position)

    def change(keyframe: Keyframe) -> Keyframe:
        pose = geometry.matrix_from_quaternion(keyframe.orientation), keyframe.position
        rotation, position = geometry.compose(*origin, *pose)
        return dataclasses.replace(keyframe, position=position, orientation=geometry.quaternion_from_matrix(rotation))

    def anew(whole: Recording, amount: float, rng: np.random.Generator) -> Recording:
        return ids_shifted(whole.changed(Keyframe, change), amount, rng)

    return from_midway(anew)(recording, amount, rng)


def new_ids_twice(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Send every seventh keyframe and its tracks once more under a new id, some seconds later by its stamp."""
    timeline: list[Entry] = []
    renamed: dict[int, int] = {}
    waiting: list[Entry] = []
    for topic, time_ns, measurement in recording.timeline:
        if isinstance(measurement, Keyframe):
            timeline += waiting
            waiting = []
        timeline.append((topic, time_ns, measurement))
        if isinstance(measurement, Keyframe | FeatureTracks) and recording.number(measurement.keyframe_id) % 7 == 6:
            new = _NEW_IDS + measurement.keyframe_id
            renamed[new] = measurement.keyframe_id
            again = dataclasses.replace(measurement, keyframe_id=new)
            if isinstance(again, Keyframe):
                again = dataclasses.replace(again, stamp_ns=again.stamp_ns + round(amount * 1e9))
            waiting.append((topic, time_ns, again))
    return dataclasses.replace(recording, timeline=tuple(timeline + waiting), renamed=renamed)


def numbered_anew(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Begin to count keyframes anew in the middle, from some id on, without another session."""
    half = len(recording.keyframes) // 2
    ids = [one.keyframe_id for one in recording.keyframes]
    new = {old: int(amount) + i for i, old in enumerate(ids[half:])}
    back = {number: old for old, number in new.items()}

    def keyframe(one: Keyframe) -> Keyframe:
        return dataclasses.replace(one, keyframe_id=new.get(one.keyframe_id, one.keyframe_id))

    def tracks(one: FeatureTracks) -> FeatureTracks:
        return dataclasses.replace(one, keyframe_id=new.get(one.keyframe_id, one.keyframe_id))

    changed = recording.changed(Keyframe, keyframe).changed(FeatureTracks, tracks)
    return dataclasses.replace(changed, renamed=back)
