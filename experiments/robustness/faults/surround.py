# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put drives of the same robot that look to several sides together: cameras of one rig that share no view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from experiments.robustness.faults.recording import Entry, Recording, rows_of
from experiments.synthetic.tracker import lenses

# Ids of tracks of one drive are below this.
_IDS = 1_000_000


def surround(drives: Sequence[Recording]) -> Recording:
    """Return a recording of all cameras of drives along one path, those of the first drive first."""
    rigs = [drive.sound.rig for drive in drives]
    count = sum(len(rig) for rig in rigs)
    rig = CameraRig(
        frame_id=rigs[0].frame_id,
        names=tuple(f"camera_{k}" for k in range(count)),
        models=tuple(model for rig in rigs for model in rig.models),
        intrinsics=np.concatenate([rig.intrinsics for rig in rigs]),
        distortion=tuple(lens for rig in rigs for lens in rig.distortion),
        image_size=np.concatenate([rig.image_size for rig in rigs]),
        position=np.concatenate([rig.position for rig in rigs]),
        orientation=np.concatenate([rig.orientation for rig in rigs]),
    )
    images: dict[int, list[Entry]] = {}
    camera = 0
    for number, drive in enumerate(drives):
        for topic, time_ns, one in drive.timeline:
            if isinstance(one, FeatureTracks):
                renamed = dataclasses.replace(
                    one,
                    camera_index=camera + one.camera_index,
                    track_id=one.track_id + np.uint64(_IDS * number),
                )
                images.setdefault(one.keyframe_id, []).append((topic, time_ns, renamed))
        camera += len(rigs[number])
    timeline: list[Entry] = []
    for topic, time_ns, one in drives[0].timeline:
        if isinstance(one, CameraRig):
            timeline.append((topic, time_ns, rig))
        elif isinstance(one, Keyframe):
            timeline += [(topic, time_ns, one), *images.get(one.keyframe_id, [])]
    return dataclasses.replace(drives[0], timeline=tuple(timeline))


def third(recording: Recording) -> Recording:
    """Return a recording with a third camera beside the two of its rig, as far from the second as that from the first.

    It sees what the first one does, with the noise of the second.
    """
    rig = recording.sound.rig
    sides = np.array([0, 1, 1])
    position = np.append(rig.position, 2.0 * rig.position[1:] - rig.position[:1], axis=0)
    wide = CameraRig(
        frame_id=rig.frame_id,
        names=tuple(f"camera_{k}" for k in range(3)),
        models=tuple(rig.models[k] for k in sides),
        intrinsics=rig.intrinsics[sides],
        distortion=tuple(rig.distortion[k] for k in sides),
        image_size=rig.image_size[sides],
        position=position,
        orientation=rig.orientation[sides],
    )
    lens, projector = lenses(wide)[2], recording.projector
    timeline: list[Entry] = []
    for topic, time_ns, one in recording.timeline:
        timeline.append((topic, time_ns, wide if isinstance(one, CameraRig) else one))
        if isinstance(one, FeatureTracks) and one.camera_index == 1:
            points = projector.points(one.track_id)
            uv, _ = lens.project(points, projector.path, projector.number[one.keyframe_id])
            uv = uv + one.uv - projector.uv(one, points)
            shown = lens.in_image(uv)
            image = rows_of(dataclasses.replace(one, camera_index=2, uv=np.where(shown[:, None], uv, 0.0)), shown)
            timeline.append((topic, time_ns, image))
    return dataclasses.replace(recording, timeline=tuple(timeline))


def focal_of_first(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Multiply the focal length of the first of three cameras in the rig message."""

    def change(rig: CameraRig) -> CameraRig:
        intrinsics = rig.intrinsics.copy()
        intrinsics[0, :2] *= amount
        return dataclasses.replace(rig, intrinsics=intrinsics)

    return third(recording).changed(CameraRig, change)
