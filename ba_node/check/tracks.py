# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Look at the tracks of a scene as rays, image by image, and match images by them.

Rays are in normalised coordinates (X/Z, Y/Z), so that nothing behind this module knows a camera model.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray, IntArray
from ba_node.check.two_view import Pose
from ba_node.core import cameras as camera_models
from ba_node.core.problem import Cameras
from ba_node.kept import kept_property
from ba_node.scene.scene import Scene

Image = tuple[int, int]

# Beyond 80 degrees from the axis a small error in the pixel is a large one in X/Z.
_MAX_RAY = 5.67
# A camera with this share of the tracks of the busiest one may stand for the keyframe.
_MAIN_SHARE = 0.7
_NOTHING = np.empty(0, np.intp)


@dataclass(frozen=True)
class Tracks:
    """What the front-end has delivered; keyframes oldest first."""

    stamp_ns: NDArray[np.int64]  # (n_kf,)
    rotation: FloatArray  # (n_kf, 3, 3) fixed frame from body, as given
    position: FloatArray  # (n_kf, 3) as given, m
    cameras: Cameras  # the rig, as given
    keyframe: IntArray  # (n_obs,) index of the keyframe
    camera: IntArray  # (n_obs,) index of the camera
    track: IntArray  # (n_obs,) number of the track
    uv: FloatArray  # (n_obs, 2) px
    sigma_px: FloatArray  # (n_obs,)
    depth_m: FloatArray  # (n_obs,) NaN for none
    image_size: IntArray | None = None  # (n_cam, 2) px, as given; 0 or None for unknown

    def __len__(self) -> int:
        return len(self.position)

    @kept_property
    def ray(self) -> FloatArray:
        """Return X/Z and Y/Z, (n_obs, 2); NaN where there is none."""
        ray = camera_models.normalise(self.uv, self.cameras.model[self.camera], self.cameras.params[self.camera])
        with np.errstate(invalid="ignore"):
            usable = np.asarray((ray * ray).sum(axis=1) <= _MAX_RAY**2)
        return np.where(usable[:, None], ray, np.nan)

    @kept_property
    def images(self) -> dict[Image, IntArray]:
        """Return the rows of each image (keyframe, camera) that have a ray, by track."""
        rows = np.flatnonzero(np.isfinite(self.ray[:, 0]))
        rows = rows[np.lexsort((self.track[rows], self.camera[rows], self.keyframe[rows]))]
        ends = np.flatnonzero((np.diff(self.keyframe[rows]) != 0) | (np.diff(self.camera[rows]) != 0)) + 1
        parts = np.split(rows, ends)
        return {(int(self.keyframe[part[0]]), int(self.camera[part[0]])): part for part in parts if len(part)}

    def match(self, a: Image, b: Image) -> tuple[IntArray, IntArray]:
        """Return the rows of the tracks that two images share, in the same order: two (n,)."""
        rows_a, rows_b = self.images.get(a, _NOTHING), self.images.get(b, _NOTHING)
        if not len(rows_a) or not len(rows_b):
            return _NOTHING, _NOTHING
        track = self.track[rows_b]
        at = np.minimum(np.searchsorted(track, self.track[rows_a]), len(track) - 1)
        same = track[at] == self.track[rows_a]
        return rows_a[same], rows_b[at[same]]

    def main_camera(self, keyframe: int) -> int | None:
        """Return the camera that stands for a keyframe: the first with about as many tracks as the busiest."""
        counts = [len(self.images.get((keyframe, camera), _NOTHING)) for camera in range(len(self.cameras.model))]
        if not max(counts):
            return None
        return next(camera for camera, count in enumerate(counts) if count >= _MAIN_SHARE * max(counts))

    def sigma(self, rows: IntArray) -> float:
        """Return the usual standard deviation of some rays."""
        return float(np.median(self.sigma_px[rows] / _focal(self.cameras)[self.camera[rows]])) if len(rows) else 0.0

    def px(self, rows: IntArray) -> float:
        """Return the length of a pixel in the rays of some rows."""
        return float(np.median(1.0 / _focal(self.cameras)[self.camera[rows]])) if len(rows) else 0.0

    def seen(
        self,
        uv: FloatArray | None = None,
        params: FloatArray | None = None,
        lens: camera_models.Model | None = None,
    ) -> Tracks:
        """Return the same with other pixels (n_obs, 2), or seen by other intrinsics (n_cam, 12) or another lens."""
        cameras = self.cameras if params is None else dataclasses.replace(self.cameras, params=params)
        if lens is not None:
            cameras = dataclasses.replace(cameras, model=np.full_like(cameras.model, lens))
        return dataclasses.replace(self, cameras=cameras, uv=self.uv if uv is None else uv)

    def between_cameras(self, a: int, b: int) -> Pose:
        """Return camera b from camera a, as given."""
        rig = self.cameras
        rotation = rig.rotation[b] @ rig.rotation[a].T
        return Pose(rotation, rig.translation[b] - rotation @ rig.translation[a])

    def between_images(self, a: Image, b: Image) -> Pose:
        """Return image b from image a, as given."""
        (rotation_a, at_a), (rotation_b, at_b) = (self._world_from(image) for image in (a, b))
        return Pose(rotation_b.T @ rotation_a, rotation_b.T @ (at_a - at_b))

    def _world_from(self, image: Image) -> tuple[FloatArray, FloatArray]:
        keyframe, camera = image
        rotation = self.rotation[keyframe] @ self.cameras.rotation[camera].T
        return rotation, self.position[keyframe] - rotation @ self.cameras.translation[camera]


def tracks_of(scene: Scene, newest: int | None = None) -> Tracks | None:
    """Return a copy of what a scene has been given; None before the first tracks or without a rig.

    ``newest`` keyframes are looked at; None for all.
    """
    table, cameras = scene.observations, scene.cameras
    order = scene.order if newest is None else scene.order[-newest:]
    place = np.full(len(scene.keyframes), -1)
    place[order] = np.arange(len(order))
    rows = np.flatnonzero(place[table.keyframe] >= 0)
    if cameras is None or not len(rows):
        return None
    return Tracks(
        scene.keyframes.stamp_ns[order],
        scene.keyframes.input_rotation[order],
        scene.keyframes.input_position[order],
        cameras,
        place[table.keyframe[rows]],
        table.camera[rows].astype(np.intp),
        table.landmark[rows].astype(np.intp),
        table.uv[rows].astype(float),
        table.sigma_px[rows].astype(float),
        table.depth_m[rows].astype(float),
        scene.image_size,
    )


def _focal(cameras: Cameras) -> FloatArray:
    return np.asarray(np.sqrt(cameras.params[:, camera_models.FX] * cameras.params[:, camera_models.FY]))
