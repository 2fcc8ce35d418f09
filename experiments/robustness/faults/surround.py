# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put drives of the same robot that look to several sides together: cameras of one rig that share no view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from experiments.robustness.faults.recording import Entry, Recording

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
