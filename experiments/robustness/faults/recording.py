# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A recording with its truth, and the ways to change it that the faults share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ba_node.core.geometry import matrix_from_quaternion
from ba_node.estimate import Poses
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from experiments.synthetic.generate import SyntheticData
from experiments.synthetic.tracker import lenses
from experiments.synthetic.world import Path

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]
Entry = tuple[str, int, Measurement]
M = TypeVar("M", CameraRig, Keyframe, FeatureTracks, LandmarkGuesses)


@dataclass(frozen=True)
class Recording:
    """What a front-end published, and what was true."""

    sound: SyntheticData  # the same recording without a fault
    # topic (base name), time of recording in ns, measurement. A keyframe's own stamp may differ.
    timeline: tuple[Entry, ...]
    # fields of CameraInfo that a measurement does not have, for every camera; those of ``roi`` as a mapping
    camera_info: Mapping[str, Any] = field(default_factory=dict)
    # ids of keyframes that the sound recording has under another, by their new ids
    renamed: Mapping[int, int] = field(default_factory=dict)

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """Return the measurements in order."""
        return tuple(measurement for _, _, measurement in self.timeline)

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """Return the keyframe messages in order."""
        return tuple(m for m in self.measurements if isinstance(m, Keyframe))

    @property
    def truth(self) -> Poses:
        """Return the true pose for every keyframe message, with the stamp that it was published with."""
        return self._poses(self.sound.truth.position[self._rows], self.sound.truth.orientation[self._rows])

    @property
    def odometry(self) -> Poses:
        """Return the published pose of every keyframe message."""
        return self._poses(
            np.array([keyframe.position for keyframe in self.keyframes]),
            np.array([keyframe.orientation for keyframe in self.keyframes]),
        )

    def changed(self, kind: type[M], change: Callable[[M], M | None]) -> Recording:
        """Return the recording with every measurement of a kind put through a function; None leaves it out."""
        timeline = []
        for topic, time_ns, measurement in self.timeline:
            new = change(measurement) if isinstance(measurement, kind) else measurement
            if new is not None:
                timeline.append((topic, time_ns, new))
        return dataclasses.replace(self, timeline=tuple(timeline))

    def number(self, keyframe_id: int) -> int:
        """Return which keyframe of the sound recording an id names, from 0."""
        return self.projector.number[self.renamed.get(keyframe_id, keyframe_id)]

    @cached_property
    def projector(self) -> Projector:
        """Return what tells where the truth lies in the images."""
        return Projector(self.sound)

    @property
    def _rows(self) -> IndexArray:
        return np.array([self.number(keyframe.keyframe_id) for keyframe in self.keyframes], dtype=np.intp)

    def _poses(self, position: FloatArray, orientation: FloatArray) -> Poses:
        ids = np.array([keyframe.keyframe_id for keyframe in self.keyframes], dtype=np.uint64)
        stamp_ns = np.array([keyframe.stamp_ns for keyframe in self.keyframes], dtype=np.int64)
        return Poses(ids, stamp_ns, position, orientation)


class Projector:
    """Where points lie in the images if poses and cameras are the true ones.

    Attributes:
        number: keyframe id -> which keyframe it is, from 0.
        path: true poses.
    """

    def __init__(self, sound: SyntheticData) -> None:
        truth = sound.truth
        self.number = {int(key): row for row, key in enumerate(truth.keyframe_id)}
        self.path = Path(truth.position, matrix_from_quaternion(truth.orientation), np.zeros(len(truth)))
        self._lenses = lenses(sound.rig)
        self._points = sound.landmarks
        self._order = np.argsort(sound.track_id)
        self._ids = sound.track_id[self._order]
        self._landmark = sound.track_landmark[self._order]

    def landmarks(self, track_id: NDArray[np.uint64]) -> IndexArray:
        """Return which point each track follows: (n,)."""
        return self._landmark[np.searchsorted(self._ids, track_id)]

    def points(self, track_id: NDArray[np.uint64]) -> FloatArray:
        """Return the point (n, 3) that each track follows, m."""
        return np.asarray(self._points[self.landmarks(track_id)])

    def uv(self, image: FeatureTracks, points: FloatArray, path: Path | None = None) -> FloatArray:
        """Return where points (n, 3) lie in an image, px; NaN where it does not show them, or would from a path."""
        lens = self._lenses[image.camera_index]
        uv, _ = lens.project(points, self.path if path is None else path, self.number[image.keyframe_id])
        return np.where(lens.in_image(uv)[:, None], uv, np.nan)

    def wrong(self, image: FeatureTracks, limit_px: float) -> NDArray[np.bool_]:
        """Return which observations are farther from the truth than a limit: (n,)."""
        error = image.uv - self.uv(image, self.points(image.track_id))
        # One that lies outside the image by its noise alone is not shown there, but it is not wrong either.
        return np.asarray(np.nan_to_num(np.hypot(*error.T)) > limit_px)


def rows_of(image: FeatureTracks, keep: NDArray[np.bool_] | IndexArray) -> FeatureTracks:
    """Return some rows of an image."""
    return dataclasses.replace(
        image,
        track_id=image.track_id[keep],
        uv=image.uv[keep],
        sigma_px=image.sigma_px[keep] if len(image.sigma_px) else image.sigma_px,
        depth_m=image.depth_m[keep] if len(image.depth_m) else image.depth_m,
    )


def without_outliers(recording: Recording, limit_px: float) -> Recording:
    """Return the recording without the observations that are farther from the truth than a limit."""
    projector = recording.projector
    return recording.changed(FeatureTracks, lambda image: rows_of(image, ~projector.wrong(image, limit_px)))
