# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Place the cameras on the body and decide, as a tracker would, which track sees which point when."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import cameras
from ba_node.core.geometry import matrix_from_quaternion, quaternion_from_matrix, so3_exp
from ba_node.measurements import CameraRig
from experiments.synthetic.options import SyntheticOptions
from experiments.synthetic.world import Path, World

# The camera looks along the body's x: its x (right) is -y of the body, its y (down) is -z (REP-103).
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_MOUNT = np.array([0.10, 0.0, 0.05])
_NEAREST_M = 0.3

# Coefficients as calibrated on lenses of the EuRoC and the TUM-VI cameras.
_LENSES = {
    "none": ("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "plumb_bob": ("plumb_bob", (-0.28340811, 0.07395907, 0.00019359, 0.0000176187, 0.0)),
    "equidistant": ("equidistant", (0.00348239, 0.00071503, -0.00205324, 0.00020294)),
}


def build_rig(options: SyntheticOptions) -> CameraRig:
    """Return one camera, or two side by side, mounted ahead of and above the body's origin."""
    count = 2 if options.baseline_m > 0.0 else 1
    model, coefficients = _LENSES[options.distortion]
    half_width, half_fov = 0.5 * options.width_px, math.radians(0.5 * options.fov_deg)
    focal = half_width / (half_fov if model == "equidistant" else math.tan(half_fov))
    intrinsics = [focal, focal, 0.5 * (options.width_px - 1), 0.5 * (options.height_px - 1)]
    rotation = so3_exp(np.array([0.0, 0.0, math.radians(options.look_deg)])) @ _OPTICAL
    sideways = (np.arange(count) - 0.5 * (count - 1)) * options.baseline_m
    return CameraRig(
        frame_id="base_link",
        names=("left_optical", "right_optical") if count == 2 else ("camera_optical",),
        models=(model,) * count,
        intrinsics=np.tile(intrinsics, (count, 1)),
        distortion=(np.array(coefficients),) * count,
        image_size=np.tile(np.array([options.width_px, options.height_px], dtype=np.int64), (count, 1)),
        position=_MOUNT + sideways[:, None] * rotation[:, 0],
        orientation=np.tile(quaternion_from_matrix(rotation), (count, 1)),
    )


@dataclass(frozen=True)
class Lens:
    """One camera of the rig, ready to project."""

    rotation: FloatArray  # (3, 3) body from camera optical frame
    position: FloatArray  # (3,) camera in the body, m
    model: cameras.Model  # see ``cameras.Model``
    params: FloatArray  # (12,) see ``cameras``
    image_size: FloatArray  # (2,) width and height, px

    def eye(self, path: Path, k: int) -> FloatArray:
        """Return where the camera is at keyframe ``k``, in the fixed frame: (3,) m."""
        eye: FloatArray = path.rotation[k] @ self.position + path.position[k]
        return eye

    def project(self, points: FloatArray, path: Path, k: int) -> tuple[FloatArray, FloatArray]:
        """Return uv (n, 2) px and depth (n,) m of points (n, 3) in the fixed frame; uv is NaN nearer than 0.3 m."""
        in_camera = (points - self.eye(path, k)) @ (path.rotation[k] @ self.rotation)
        depth = in_camera[:, 2]
        rows = np.flatnonzero(depth > _NEAREST_M)
        uv = np.full((len(points), 2), np.nan)
        model = np.full(len(rows), self.model, dtype=np.uint8)
        uv[rows] = cameras.project(in_camera[rows], model, np.tile(self.params, (len(rows), 1)))
        return uv, depth

    def in_image(self, uv: FloatArray, margin_px: float = 0.0) -> BoolArray:
        """Return which of uv (n, 2) fall into the image, with a margin inside its border."""
        inside: BoolArray = (uv >= margin_px) & (uv <= self.image_size - 1.0 - margin_px)
        return np.asarray(inside.all(axis=1))


def lenses(rig: CameraRig) -> tuple[Lens, ...]:
    """Return the cameras of a rig."""
    result = []
    for i in range(len(rig)):
        model, params = cameras.parameters(rig.models[i], rig.intrinsics[i], rig.distortion[i])
        rotation = matrix_from_quaternion(rig.orientation[i])
        result.append(Lens(rotation, rig.position[i], model, params, rig.image_size[i].astype(float)))
    return tuple(result)


class Tracker:
    """Follow points from keyframe to keyframe in the first camera.

    A track ends when its point leaves the image, turns away, is hidden, is lost by chance or is too old. The places
    that become free are filled with points in view: with ``reobserve`` those known from before first, which keep their
    track, then others at random.
    """

    def __init__(self, options: SyntheticOptions, world: World) -> None:
        n = len(world.points)
        self._options = options
        self._world = world
        self._followed = np.zeros(n, dtype=bool)
        self._track = np.full(n, -1, dtype=np.intp)
        self._age = np.zeros(n, dtype=np.intp)
        self._count = 0

    def in_view(self, lens: Lens, path: Path, k: int) -> BoolArray:
        """Return which points a camera can see at keyframe ``k``: (n_points,)."""
        seen = self._world.visible(lens.eye(path, k), self._options.max_range_m)
        rows = np.flatnonzero(seen)
        uv, _ = lens.project(self._world.points[rows], path, k)
        # Three sigma inside, so that noise seldom puts an observation outside of the image.
        seen[rows] = lens.in_image(uv, 1.0 + 3.0 * self._options.noise_px)
        return seen

    def step(self, seen: BoolArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
        """Return track number and point index of what is followed in the next keyframe, by track: two (m,)."""
        options, n = self._options, len(seen)
        if options.max_track_keyframes:
            expired = self._age >= options.max_track_keyframes
            self._track[expired], self._age[expired], self._followed[expired] = -1, 0, False
        kept = self._followed & seen & (rng.random(n) >= options.track_loss)

        rank = rng.random(n) + (options.reobserve & (self._track < 0))
        candidates = np.flatnonzero(seen & ~kept)
        room = max(0, options.tracks - int(kept.sum()))
        chosen = candidates[np.argsort(rank[candidates], kind="stable")[:room]]
        fresh = chosen[self._track[chosen] < 0] if options.reobserve else chosen
        self._track[fresh] = self._count + np.arange(len(fresh))
        self._count += len(fresh)

        self._age[fresh] = 0
        self._followed = kept
        self._followed[chosen] = True
        points = np.flatnonzero(self._followed)
        self._age[points] += 1
        points = points[np.argsort(self._track[points])]
        return self._track[points], points
