# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A drive without an end: one recording again and again, with new ids, later stamps and, now and then, sessions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement
from experiments.robustness.faults.motion import stands_still
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

# Between keyframes: the default of SyntheticOptions.keyframe_rate_hz.
_STEP_NS = 250_000_000


@dataclass(frozen=True)
class Drive:
    """What is driven.

    Attributes:
        length: keyframes of a round; it ends where it began.
        tracks: that an image shows.
        session_rounds: rounds of a session; 0: one session for all.
        still: stand at the first pose all the time, and see the same points.
    """

    length: int = 50
    tracks: int = 40
    session_rounds: int = 4
    still: bool = False

    @cached_property
    def data(self) -> SyntheticData:
        """Return one round."""
        options = SyntheticOptions(
            seed=1,
            keyframes=self.length,
            length_m=0.5 * self.length,
            tracks=self.tracks,
            track_loss=0.0 if self.still else 0.2,
            drift_rotation_deg=0.05,
            drift_translation=0.002,
        )
        return generate(options, (lambda world, path: stands_still(world, path, self.length)) if self.still else None)

    @property
    def rig(self) -> CameraRig:
        """Return the cameras."""
        return self.data.rig

    def frames(self) -> Iterator[tuple[Measurement, ...]]:
        """Yield a keyframe and its tracks, without an end."""
        turn = 0
        while True:
            for keyframe, images in zip(self.data.keyframes, self.data.tracks, strict=True):
                yield (self._keyframe(keyframe, turn), *(self._image(image, turn) for image in images))
            turn += 1

    def _session(self, turn: int) -> int:
        return turn // self.session_rounds if self.session_rounds else 0

    def _keyframe(self, keyframe: Keyframe, turn: int) -> Keyframe:
        first = turn * self.length
        return dataclasses.replace(
            keyframe,
            session_id=self._session(turn),
            keyframe_id=first + keyframe.keyframe_id,
            stamp_ns=keyframe.stamp_ns + first * _STEP_NS,
        )

    def _image(self, image: FeatureTracks, turn: int) -> FeatureTracks:
        return dataclasses.replace(
            image,
            session_id=self._session(turn),
            keyframe_id=turn * self.length + image.keyframe_id,
            track_id=image.track_id + np.uint64(0 if self.still else turn * 10**6),
        )
