# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find images that come again and again while the front-end moves: a camera or a tracker that is stuck.

Noise moves what is tracked by some hundredths of a pixel at least. Where nearly all coordinates are those of an earlier
image, to the last digit, it is that image once more. A robot that stands may well see the same; one that has moved
since cannot, and its poses would be drawn to where it was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node import native
from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.measurements import FeatureTracks

# Tracks that two images have to share, and the share of these whose coordinates are the same.
_LEAST, _SAME = 10, 0.9
# A body that has moved or turned by less may see the same, m and rad.
_MOVED_M, _TURNED_RAD = 0.1, 0.03


@dataclass(frozen=True)
class _Picture:
    tracks: FeatureTracks  # as it first came
    rotation: FloatArray  # (3, 3) and (3,) m: where the front-end had the body then
    position: FloatArray


class StillImages:
    """The newest different image of each camera."""

    def __init__(self) -> None:
        self._newest: dict[int, _Picture] = {}

    def why(self, tracks: FeatureTracks, rotation: FloatArray, position: FloatArray) -> str:
        """Return in words why an image is none, as it is an earlier one once more; empty if it is new.

        Args:
            tracks: clean tracks of one camera.
            rotation: (3, 3) where the front-end has the body.
            position: (3,) the same, m.
        """
        before = self._newest.get(tracks.camera_index)
        if before is None or not _is_same(tracks, before.tracks):
            self._newest[tracks.camera_index] = _Picture(tracks, rotation.copy(), position.copy())
            return ""
        moved = float(np.linalg.norm(position - before.position))
        turned = float(np.linalg.norm(geometry.so3_log(before.rotation.T @ rotation)))
        if moved < _MOVED_M and turned < _TURNED_RAD:
            return ""
        return (
            f"camera {tracks.camera_index} in keyframe {tracks.keyframe_id} sees exactly what it saw in keyframe"
            f" {before.tracks.keyframe_id}, while the front-end has moved by {moved:.2g} m and"
            f" {np.degrees(turned):.2g} deg: its image, or its tracker, stands still"
        )


def _is_same(tracks: FeatureTracks, before: FeatureTracks) -> bool:
    shared, same = _shared(tracks, before)
    return shared >= _LEAST and same >= _SAME * shared


def _shared(tracks: FeatureTracks, before: FeatureTracks) -> tuple[int, int]:
    """Return how many tracks two images share, and how many of these are where they were."""
    if native.kernels is not None:
        found: tuple[int, int] | None = native.kernels.shared_pixels(
            (tracks.track_id, before.track_id), (tracks.uv, before.uv)
        )
        if found is not None:  # ids rise, as those of most front-ends do
            return found
    _, now, then = np.intersect1d(tracks.track_id, before.track_id, assume_unique=True, return_indices=True)
    return len(now), int(np.count_nonzero((tracks.uv[now] == before.uv[then]).all(axis=1)))
