# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Images of one keyframe are not of one time, or show the scene otherwise than the rig says."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.core import geometry
from ba_node.measurements import FeatureTracks
from experiments.robustness.faults.recording import FloatArray, Recording, rows_of
from experiments.synthetic.world import Path


def second_late(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Expose the last camera some seconds after the others."""
    projector, last = recording.projector, len(recording.sound.rig) - 1
    stamps = recording.sound.truth.stamp_ns
    moved = dataclasses.replace(
        projector.path, **_later(projector.path, amount / (float(np.median(np.diff(stamps))) * 1e-9))
    )

    def change(image: FeatureTracks) -> FeatureTracks:
        if image.camera_index != last:
            return image
        points = projector.points(image.track_id)
        uv = image.uv + projector.uv(image, points, moved) - projector.uv(image, points)
        return rows_of(dataclasses.replace(image, uv=uv), np.isfinite(uv[:, 0]))

    return recording.changed(FeatureTracks, change)


def _later(path: Path, share: float) -> dict[str, FloatArray]:
    """Return positions and rotations of a path after a share of each step; the last keyframe goes on as before."""
    turn = geometry.so3_log(np.swapaxes(path.rotation[:-1], 1, 2) @ path.rotation[1:])
    move = np.diff(path.position, axis=0)
    turn, move = (np.append(part, part[-1:], axis=0) for part in (turn, move))
    return {"position": path.position + share * move, "rotation": path.rotation @ geometry.so3_exp(share * turn)}


def flipped(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Track in images that are mirrored (1: left and right, 2: top and bottom) or upside down (3)."""

    def change(image: FeatureTracks) -> FeatureTracks:
        last = recording.sound.rig.image_size[image.camera_index] - 1.0
        sides = [int(amount) & 1, int(amount) >> 1]
        return dataclasses.replace(image, uv=np.where(sides, last - image.uv, image.uv))

    return recording.changed(FeatureTracks, change)
