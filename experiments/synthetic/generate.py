# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Record the world: poses with drift, observations with noise and outliers, in the order of a front-end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray, IdArray, IntArray
from ba_node.core.geometry import compose, inverse, quaternion_from_matrix, so3_exp
from ba_node.estimate import Poses
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from experiments.synthetic.options import SyntheticOptions
from experiments.synthetic.tracker import Lens, Tracker, build_rig, lenses
from experiments.synthetic.world import Path, World, build

START_NS = 1_700_000_000_000_000_000
FIXED_FRAME = "odom"
_OUTLIER_PX = (10.0, 60.0)


@dataclass(frozen=True)
class SyntheticData:
    """A recording and the truth about it."""

    rig: CameraRig  # the cameras
    keyframes: tuple[Keyframe, ...]  # with the drifted poses, by time
    tracks: tuple[tuple[FeatureTracks, ...], ...]  # of each keyframe, one entry a camera
    # of each keyframe, for the tracks that begin there; None when there are none
    guesses: tuple[LandmarkGuesses | None, ...]
    truth: Poses  # true poses of the keyframes; the first is also the first published one
    landmarks: FloatArray  # (n, 3) all points of the world in the fixed frame, m
    track_id: IdArray  # (n_tracks,) ids of the published tracks, in order of appearance
    track_landmark: IntArray  # (n_tracks,) which point each of them follows

    @property
    def odometry(self) -> Poses:
        """Return the published, drifted poses."""
        return Poses.of(self.keyframes)

    def timeline(self) -> Iterator[tuple[str, int, Measurement]]:
        """Yield topic (base name), stamp in ns and measurement, in the order a front-end publishes them."""
        yield "camera_rig", self.keyframes[0].stamp_ns, self.rig
        for keyframe, guesses, tracks in zip(self.keyframes, self.guesses, self.tracks, strict=True):
            yield "keyframes", keyframe.stamp_ns, keyframe
            if guesses is not None:
                yield "landmark_guesses", keyframe.stamp_ns, guesses
            for image in tracks:
                yield "feature_tracks", keyframe.stamp_ns, image


def generate(
    options: SyntheticOptions, change: Callable[[World, Path], tuple[World, Path]] | None = None
) -> SyntheticData:
    """Make a recording; the same options give the same numbers.

    ``change`` puts another world or another motion in the place of those that the options ask for.
    """
    # One stream a purpose: a change of the noise must not move the points.
    world_rng, track_rng, drift_rng, noise_rng, id_rng = np.random.default_rng(options.seed).spawn(5)
    world, path = build(options, world_rng)
    if change is not None:
        world, path = change(world, path)
    rig = build_rig(options)
    recorder = _Recorder(options, world, path, lenses(rig), noise_rng)

    followed, landmark = _follow(options, world, path, recorder.lenses[0], track_rng)
    track_id = _ids(options, len(landmark), id_rng)
    poses = _poses(options, path, _ids(options, options.keyframes, id_rng))
    published = _drift(options, path, drift_rng)
    keyframes = tuple(_keyframe(poses, published, k) for k in range(options.keyframes))
    tracks = tuple(
        recorder.images(k, keyframes[k].keyframe_id, track_id[rows], landmark[rows]) for k, rows in enumerate(followed)
    )
    guesses = _guesses(options, recorder, published, followed, (track_id, landmark))
    return SyntheticData(rig, keyframes, tracks, guesses, poses, world.points, track_id, landmark)


def _follow(
    options: SyntheticOptions, world: World, path: Path, lens: Lens, rng: np.random.Generator
) -> tuple[list[IntArray], IntArray]:
    """Return the tracks (numbered by appearance) of each keyframe, and the point of each track."""
    tracker = Tracker(options, world)
    steps = [tracker.step(tracker.in_view(lens, path, k), rng) for k in range(options.keyframes)]
    track = np.concatenate([step[0] for step in steps])
    views = np.bincount(track)
    published = views >= options.min_track_keyframes
    number = np.cumsum(published) - 1
    landmark = np.zeros(len(views), dtype=np.intp)
    landmark[track] = np.concatenate([step[1] for step in steps])
    return [number[step[0][published[step[0]]]] for step in steps], landmark[published]


def _ids(options: SyntheticOptions, count: int, rng: np.random.Generator) -> IdArray:
    """Return distinct ids: counted, or spread over uint64 with both of its ends among the first two."""
    if options.ids == "sequential":
        return np.arange(count, dtype=np.uint64)
    # Steps below 2^64 / count keep sorted draws apart; the order is then shuffled.
    gap = np.uint64(2**64 // (count + 1))
    ids = np.arange(count, dtype=np.uint64) * gap + rng.integers(1, int(gap), count, dtype=np.uint64)
    rng.shuffle(ids)
    ends = np.array([2**64 - 1, 0], dtype=np.uint64)[:count]
    ids[: len(ends)] = ends
    return ids


def _poses(options: SyntheticOptions, path: Path, keyframe_id: IdArray) -> Poses:
    step_ns = round(1e9 / options.keyframe_rate_hz)
    stamp_ns = START_NS + step_ns * np.arange(options.keyframes, dtype=np.int64)
    return Poses(keyframe_id, stamp_ns, path.position, quaternion_from_matrix(path.rotation))


def _drift(options: SyntheticOptions, path: Path, rng: np.random.Generator) -> Path:
    """Return the path as dead reckoning has it: each true step with a random error, chained from the true start."""
    spread = np.sqrt(np.diff(path.distance))[:, None]
    turn = so3_exp(rng.normal(size=(len(spread), 3)) * np.radians(options.drift_rotation_deg) * spread)
    shift = rng.normal(size=(len(spread), 3)) * options.drift_translation * spread
    back = inverse(path.rotation[:-1], path.position[:-1])
    step_rotation, step_translation = compose(*back, path.rotation[1:], path.position[1:])
    rotation, position = path.rotation.copy(), path.position.copy()
    for k in range(len(spread)):
        rotation[k + 1], position[k + 1] = compose(
            rotation[k], position[k], step_rotation[k] @ turn[k], step_translation[k] + shift[k]
        )
    return Path(position, rotation, path.distance)


def _keyframe(poses: Poses, published: Path, k: int) -> Keyframe:
    return Keyframe(
        session_id=0,
        keyframe_id=int(poses.keyframe_id[k]),
        stamp_ns=int(poses.stamp_ns[k]),
        frame_id=FIXED_FRAME,
        position=published.position[k],
        orientation=quaternion_from_matrix(published.rotation[k]),
    )


@dataclass(frozen=True)
class _Recorder:
    """Turn what is followed into images."""

    options: SyntheticOptions
    world: World
    path: Path
    lenses: tuple[Lens, ...]
    rng: np.random.Generator

    def images(self, k: int, keyframe_id: int, track_id: IdArray, landmark: IntArray) -> tuple[FeatureTracks, ...]:
        """Return what every camera saw of the followed points at keyframe ``k``."""
        return tuple(self._image(k, camera, keyframe_id, (track_id, landmark)) for camera in range(len(self.lenses)))

    def _image(self, k: int, camera: int, keyframe_id: int, followed: tuple[IdArray, IntArray]) -> FeatureTracks:
        lens, options = self.lenses[camera], self.options
        track_id, landmark = followed
        uv, depth = lens.project(self.world.points[landmark], self.path, k)
        if camera > 0:
            seen = self.world.visible(lens.eye(self.path, k), options.max_range_m)[landmark] & lens.in_image(uv)
            track_id, uv, depth = track_id[seen], uv[seen], depth[seen]
        return FeatureTracks(
            session_id=0,
            keyframe_id=keyframe_id,
            camera_index=camera,
            track_id=track_id,
            uv=_as_sent(self._disturbed(uv, lens)),
            sigma_px=self._sigma(len(uv)),
            depth_m=self._depth(depth) if camera == 0 and options.depth_share > 0.0 else np.empty(0),
        )

    def _disturbed(self, uv: FloatArray, lens: Lens) -> FloatArray:
        """Add noise, and displace the outliers."""
        noisy = uv + self.options.noise_px * self.rng.normal(size=uv.shape)
        angle, length = self.rng.uniform([[0.0]] * 2, [[2.0 * np.pi], [1.0]], size=(2, len(uv)))
        low, high = _OUTLIER_PX
        jump = (low + (high - low) * length)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # A matcher finds its mismatch inside the image too.
        outside = (noisy + jump < 0.0) | (noisy + jump > lens.image_size - 1.0)
        jump = np.where(outside, -jump, jump)
        outlier = self.rng.random(len(uv)) < self.options.outlier_share
        return np.where(outlier[:, None], noisy + jump, noisy)

    def _sigma(self, count: int) -> FloatArray:
        if not self.options.send_sigma or self.options.noise_px == 0.0:
            return np.empty(0)
        return _as_sent(np.full(count, self.options.noise_px))

    def _depth(self, depth: FloatArray) -> FloatArray:
        measured = depth * (1.0 + self.options.depth_noise * self.rng.normal(size=len(depth)))
        has_depth = self.rng.random(len(depth)) < self.options.depth_share
        return _as_sent(np.where(has_depth, np.maximum(measured, 1e-3), np.nan))


def _as_sent(values: FloatArray) -> FloatArray:
    """Round to float32, which is what the messages carry."""
    return values.astype(np.float32).astype(np.float64)


def _guesses(
    options: SyntheticOptions,
    recorder: _Recorder,
    published: Path,
    followed: list[IntArray],
    tracks: tuple[IdArray, IntArray],
) -> tuple[LandmarkGuesses | None, ...]:
    """Return, for each keyframe, positions of the tracks that begin there, carried along by the drifted pose."""
    if not options.guesses:
        return (None,) * options.keyframes
    track_id, landmark = tracks
    result: list[LandmarkGuesses | None] = []
    known = 0
    for k, rows in enumerate(followed):
        new = rows[rows >= known]
        known += len(new)
        points = recorder.world.points[landmark[new]] - recorder.path.position[k]
        spread = options.guess_noise * np.linalg.norm(points, axis=1, keepdims=True)
        in_body = (points + spread * recorder.rng.normal(size=points.shape)) @ recorder.path.rotation[k]
        position = in_body @ published.rotation[k].T + published.position[k]
        result.append(LandmarkGuesses(0, track_id[new], position) if len(new) else None)
    return tuple(result)
