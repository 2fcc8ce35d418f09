# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Give synthetic recordings wrongly, in every way that the check names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.check.tracks import Tracks, tracks_of
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.measurements import FeatureTracks, Measurement
from ba_node.scene.scene import Scene
from experiments.synthetic import SyntheticData, SyntheticOptions
from tests.generated import generated

FloatArray = NDArray[np.float64]
Wrong = Callable[[SyntheticData], SyntheticData]

_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_LENS = np.array([-0.28, 0.07, 0.0002, 0.00002, 0.0])


def recording(seed: int = 3, wrong: str = "", mode: str = "stereo", **options: Any) -> SyntheticData:
    """Return a recording of a mode (stereo, mono, rgbd) along a loop of 52 m, or a line of 40 m, given wrongly."""
    length = 40.0 if options.get("path") == "line" else 52.0
    depth = {"depth_share": 0.8} if mode == "rgbd" else {}
    if wrong in ("not rectified", "other signs of d"):
        options["distortion"] = "plumb_bob"
    if wrong == "plumb_bob given":
        options["distortion"] = "equidistant"
    chosen = {"baseline_m": 0.12 if mode == "stereo" else 0.0, "length_m": length, **depth, **options}
    data = generated(SyntheticOptions(seed=seed, **chosen))
    return WRONG[wrong](data) if wrong else data


def seen(data: SyntheticData, keyframes: int | None = None) -> Tracks:
    """Return the tracks of the first keyframes of a recording."""
    tracks = tracks_of(scene_of(data, keyframes))
    assert tracks is not None
    return tracks


def tracks_in(measurements: Iterable[Measurement]) -> Tracks:
    """Return the tracks of measurements as they come."""
    scene = Scene(Config().scene)
    for measurement in measurements:
        scene.add(measurement)
    tracks = tracks_of(scene)
    assert tracks is not None
    return tracks


def scene_of(data: SyntheticData, keyframes: int | None = None) -> Scene:
    """Return a scene that has been given the first keyframes of a recording."""
    scene = Scene(Config().scene)
    scene.add(data.rig)
    for keyframe, images in list(zip(data.keyframes, data.tracks, strict=True))[:keyframes]:
        scene.add(keyframe)
        for image in images:
            scene.add(image)
    return scene


def rig(change: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]) -> Wrong:
    """Return what gives rotation (n, 3, 3) and position (n, 3) of the cameras otherwise."""

    def go(data: SyntheticData) -> SyntheticData:
        rotation, position = change(geometry.matrix_from_quaternion(data.rig.orientation), data.rig.position.copy())
        other = dataclasses.replace(
            data.rig, orientation=geometry.quaternion_from_matrix(rotation), position=np.ascontiguousarray(position)
        )
        return dataclasses.replace(data, rig=other)

    return go


def poses(change: Callable[[FloatArray, FloatArray, SyntheticData], tuple[FloatArray, FloatArray]]) -> Wrong:
    """Return what gives rotation (n, 3, 3) and position (n, 3) of the keyframes otherwise."""

    def go(data: SyntheticData) -> SyntheticData:
        given = geometry.matrix_from_quaternion(np.array([one.orientation for one in data.keyframes]))
        rotation, position = change(given, np.array([one.position for one in data.keyframes]), data)
        rows = zip(data.keyframes, geometry.quaternion_from_matrix(rotation), position, strict=True)
        keyframes = tuple(dataclasses.replace(one, orientation=q, position=p) for one, q, p in rows)
        return dataclasses.replace(data, keyframes=keyframes)

    return go


def intrinsics(change: Callable[[FloatArray], FloatArray]) -> Wrong:
    """Return what gives fx fy cx cy (n, 4) otherwise."""
    return lambda data: dataclasses.replace(
        data, rig=dataclasses.replace(data.rig, intrinsics=change(data.rig.intrinsics.copy()))
    )


def distortion(coefficients: FloatArray) -> Wrong:
    """Return what gives the distortion of all cameras otherwise."""
    return lambda data: dataclasses.replace(
        data, rig=dataclasses.replace(data.rig, distortion=(coefficients,) * len(data.rig))
    )


def images(change: Callable[[FeatureTracks], FeatureTracks]) -> Wrong:
    """Return what gives each tracks message otherwise."""
    return lambda data: dataclasses.replace(data, tracks=tuple(tuple(map(change, both)) for both in data.tracks))


def _reversed(rotation: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    position[1] = 2.0 * position[0] - position[1]
    return rotation, position


def all_turned(degrees: float, axis: tuple[float, float, float]) -> Wrong:
    """Return what turns cameras that look alike by some degrees about an axis of the first."""
    turn = geometry.so3_exp(np.radians(degrees) * np.array(axis))
    return rig(lambda rotation, position: (rotation @ turn, position))


def turned(degrees: float, axis: tuple[float, float, float]) -> Wrong:
    """Return what turns the second camera about an axis of its own."""

    def change(rotation: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        turn = geometry.so3_exp(np.radians(degrees) * np.array(axis))
        return np.stack([rotation[0], rotation[1] @ turn]), position

    return rig(change)


def _second(factor: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)) -> Wrong:
    def change(k: FloatArray) -> FloatArray:
        k[1] = k[1] * [factor, factor, 1.0, 1.0] + [0.0, 0.0, *shift]
        return k

    return intrinsics(change)


def _camera_0(data: SyntheticData) -> tuple[FloatArray, FloatArray]:
    return geometry.matrix_from_quaternion(data.rig.orientation[0]), data.rig.position[0]


def _exchanged(data: SyntheticData) -> SyntheticData:
    tracks = tuple(
        (dataclasses.replace(right, camera_index=0), dataclasses.replace(left, camera_index=1))
        for left, right in data.tracks
    )
    return dataclasses.replace(data, tracks=tracks)


def _slots(data: SyntheticData) -> SyntheticData:
    """Number tracks by the first slot that is free, as some trackers do."""
    held: dict[int, int] = {}
    tracks = []
    for both in data.tracks:
        here = set(both[0].track_id.tolist())
        held = {track: slot for track, slot in held.items() if track in here}
        free = iter(sorted(set(range(2 * len(here) + 1)) - set(held.values())))
        held |= {track: next(free) for track in sorted(here - held.keys())}
        tracks.append(
            tuple(
                dataclasses.replace(one, track_id=np.array([held[t] for t in one.track_id.tolist()], np.uint64))
                for one in both
            )
        )
    return dataclasses.replace(data, tracks=tuple(tracks))


def _stamps(factor: float) -> Wrong:
    def go(data: SyntheticData) -> SyntheticData:
        first = data.keyframes[0].stamp_ns
        keyframes = tuple(
            dataclasses.replace(one, stamp_ns=round((one.stamp_ns - first) * factor)) for one in data.keyframes
        )
        return dataclasses.replace(data, keyframes=keyframes)

    return go


def _late(by: int) -> Wrong:
    """Return what sends tracks under the id of the keyframe so many later; those at the ends are lost."""

    def go(data: SyntheticData) -> SyntheticData:
        keep = range(max(by, 0), len(data.keyframes) + min(by, 0))
        tracks = tuple(
            tuple(dataclasses.replace(one, keyframe_id=data.keyframes[k].keyframe_id) for one in data.tracks[k - by])
            for k in keep
        )
        keyframes = tuple(data.keyframes[k] for k in keep)
        return dataclasses.replace(data, keyframes=keyframes, tracks=tracks)

    return go


def _steps(rotation: FloatArray, position: FloatArray, _: SyntheticData) -> tuple[FloatArray, FloatArray]:
    """Return the steps from the keyframe before, the first pose as it is."""
    back = geometry.inverse(rotation[:-1], position[:-1])
    steps = geometry.compose(*back, rotation[1:], position[1:])
    return np.concatenate([rotation[:1], steps[0]]), np.concatenate([position[:1], steps[1]])


def _against_first(rotation: FloatArray, position: FloatArray, inverted: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return the second camera against the first, as calibration tools give it."""
    found = geometry.compose(*geometry.inverse(rotation[:1], position[:1]), rotation[1:], position[1:])
    second = geometry.inverse(*found) if inverted else found
    return np.concatenate([rotation[:1], second[0]]), np.concatenate([position[:1], second[1]])


def _lens(model: str, change: Callable[[FloatArray], FloatArray]) -> Wrong:
    """Return what gives another distortion model, and coefficients otherwise."""

    def go(data: SyntheticData) -> SyntheticData:
        lens = tuple(change(one) for one in data.rig.distortion)
        return dataclasses.replace(
            data, rig=dataclasses.replace(data.rig, models=(model,) * len(data.rig), distortion=lens)
        )

    return go


def _along_rays(data: SyntheticData) -> SyntheticData:
    focal, centre = data.rig.intrinsics[0, :2], data.rig.intrinsics[0, 2:]

    def change(one: FeatureTracks) -> FeatureTracks:
        if not len(one.depth_m):
            return one
        length = np.sqrt(1.0 + (((one.uv - centre) / focal) ** 2).sum(axis=1))
        return dataclasses.replace(one, depth_m=length * one.depth_m)

    return images(change)(data)


def _of_camera(camera: int, change: Callable[[FloatArray], FloatArray]) -> Wrong:
    """Return what gives the pixels of one camera otherwise."""
    return images(lambda one: dataclasses.replace(one, uv=change(one.uv)) if one.camera_index == camera else one)


_Y, _Y_Z, _Z = (np.diag(signs) for signs in ([1.0, -1.0, 1.0], [1.0, -1.0, -1.0], [1.0, 1.0, -1.0]))
_SWAPPED, _LEFT = np.eye(3)[[1, 0, 2]], geometry.so3_exp(np.radians([0.0, 0.0, 90.0]))

WRONG: dict[str, Wrong] = {
    "baseline reversed": rig(_reversed),
    "rig swapped": rig(lambda r, p: (r[::-1], p[::-1])),
    "tracks swapped": _exchanged,
    "extrinsics inverted": rig(geometry.inverse),
    "axes missing": rig(lambda r, p: (r @ _OPTICAL.T, p)),
    "axes twice": rig(lambda r, p: (r @ _OPTICAL, p)),
    "extrinsics in mm": rig(lambda r, p: (r, 1000.0 * p)),
    "extrinsics in cm": rig(lambda r, p: (r, 100.0 * p)),
    "no baseline": rig(lambda r, p: (r, p[[0, 0]])),
    "poses inverted": poses(lambda r, p, _: geometry.inverse(r, p)),
    "poses of camera": poses(lambda r, p, data: geometry.compose(r, p, *_camera_0(data))),
    "camera from world": poses(lambda r, p, data: geometry.inverse(*geometry.compose(r, p, *_camera_0(data)))),
    "poses of optical body": poses(lambda r, p, _: (r @ _OPTICAL, p)),
    "poses in mm": poses(lambda r, p, _: (r, 1000.0 * p)),
    "poses in km": poses(lambda r, p, _: (r, 0.001 * p)),
    "poses in cm": poses(lambda r, p, _: (r, 100.0 * p)),
    "poses with w first": poses(
        lambda r, p, _: (
            geometry.matrix_from_quaternion(geometry.quaternion_from_matrix(r)[:, [3, 0, 1, 2]]),
            p,
        )
    ),
    "left-handed": poses(lambda r, p, _: (_Y @ r @ _Y, p @ _Y)),
    "left-handed, z": poses(lambda r, p, _: (_Z @ r @ _Z, p @ _Z)),
    "forward-right-down": poses(lambda r, p, _: (_Y_Z @ r @ _Y_Z, p @ _Y_Z)),
    "orientations clockwise": poses(lambda r, p, _: (_Y @ r @ _Y, p)),
    "compass headings": poses(lambda r, p, _: (_LEFT @ _Y @ r @ _Y, p)),
    "headings from north": poses(lambda r, p, _: (_LEFT @ r, p)),
    "orientations north-east-down": poses(lambda r, p, _: (_SWAPPED @ _Z @ r @ _Y_Z, p)),
    "positions north-east": poses(lambda r, p, _: (r, p @ _SWAPPED)),
    "positions with another y": poses(lambda r, p, _: (r, p @ _Y)),
    "poses as steps": poses(_steps),
    "no positions": poses(lambda r, p, _: (r, np.zeros_like(p))),
    "no orientations": poses(lambda r, p, _: (np.tile(np.eye(3), (len(r), 1, 1)), p)),
    "OpenGL cameras": rig(lambda r, p: (r @ _Y_Z, p)),
    "camera 1 against camera 0": rig(_against_first),
    "camera 1 from camera 0": rig(lambda r, p: _against_first(r, p, inverted=True)),
    "yaw 20 of the wrong sign": rig(lambda r, p: (geometry.so3_exp(np.radians([0.0, 0.0, -40.0])) @ r, p)),
    "looks to the other side": rig(lambda r, p: (_LEFT @ _LEFT @ r, p @ _LEFT @ _LEFT)),
    "camera 1 upside down": _of_camera(1, lambda uv: np.array([639.0, 479.0]) - uv),
    "camera 0 upside down": _of_camera(0, lambda uv: np.array([639.0, 479.0]) - uv),
    "camera 1 mirrored": _of_camera(1, lambda uv: np.array([639.0, 0.0]) + np.array([-1.0, 1.0]) * uv),
    "k of camera 1 halved": intrinsics(lambda k: k * np.array([[1.0], [0.5]])),
    "k of camera 0 doubled": intrinsics(lambda k: k * np.array([[2.0], [1.0]])),
    "turned 1 about y": turned(1.0, (0.0, 1.0, 0.0)),
    "turned 1 about x": turned(1.0, (1.0, 0.0, 0.0)),
    "turned 2 about z": turned(2.0, (0.0, 0.0, 1.0)),
    "turned 0.5 about x": turned(0.5, (1.0, 0.0, 0.0)),
    "all turned 5 about z": all_turned(5.0, (0.0, 0.0, 1.0)),
    "all turned 4 about x": all_turned(4.0, (1.0, 0.0, 0.0)),
    "focal 1.2": intrinsics(lambda k: k * [1.2, 1.2, 1.0, 1.0]),
    "focal 0.8": intrinsics(lambda k: k * [0.8, 0.8, 1.0, 1.0]),
    "focal 0.5": intrinsics(lambda k: k * [0.5, 0.5, 1.0, 1.0]),
    "fx alone": intrinsics(lambda k: k * [1.3, 1.0, 1.0, 1.0]),
    "focal of camera 1": _second(factor=1.2),
    "principal point of camera 1, v": _second(shift=(0.0, 20.0)),
    "principal point of camera 1, u": _second(shift=(30.0, 0.0)),
    "region": intrinsics(lambda k: k + np.array([0.0, 0.0, 320.0, 200.0])),
    "binning": intrinsics(lambda k: 2.0 * k),
    "k of a smaller image": intrinsics(lambda k: 0.5 * k),
    "not rectified": distortion(np.zeros(5)),
    "rectified": distortion(_LENS),
    "fisheye given": lambda data: dataclasses.replace(
        data,
        rig=dataclasses.replace(
            data.rig, models=("equidistant",) * len(data.rig), distortion=(np.zeros(4),) * len(data.rig)
        ),
    ),
    "plumb_bob given": _lens("plumb_bob", lambda d: np.append(d, 0.0)),
    "other signs of d": _lens("plumb_bob", lambda d: -d),
    "depth in mm": images(lambda one: dataclasses.replace(one, depth_m=1000.0 * one.depth_m)),
    "depth times 6": images(lambda one: dataclasses.replace(one, depth_m=6.0 * one.depth_m)),
    "poses over 6": poses(lambda r, p, _: (r, p / 6.0)),
    "depth in cm": images(lambda one: dataclasses.replace(one, depth_m=100.0 * one.depth_m)),
    "depth in km": images(lambda one: dataclasses.replace(one, depth_m=0.001 * one.depth_m)),
    "depth times 1.1": images(lambda one: dataclasses.replace(one, depth_m=1.1 * one.depth_m)),
    "depth along rays": _along_rays,
    "depth of other points": images(lambda one: dataclasses.replace(one, depth_m=one.depth_m[::-1].copy())),
    "inverse depth": images(lambda one: dataclasses.replace(one, depth_m=1.0 / one.depth_m)),
    "normalised": images(lambda one: dataclasses.replace(one, uv=(one.uv - [320.0, 240.0]) / 349.0)),
    "slots": _slots,
    "ids modulo 200": images(lambda one: dataclasses.replace(one, track_id=one.track_id % np.uint64(200))),
    "rows for ids": images(
        lambda one: dataclasses.replace(one, track_id=np.arange(len(one.track_id), dtype=np.uint64))
    ),
    "ids of each camera": images(
        lambda one: dataclasses.replace(one, track_id=one.track_id + np.uint64(37 * one.camera_index))
    ),
    "other ids of each camera": images(
        lambda one: dataclasses.replace(one, track_id=one.track_id + np.uint64(10**6 * one.camera_index))
    ),
    "mirrored": images(
        lambda one: dataclasses.replace(one, uv=np.array([639.0, 0.0]) + np.array([-1.0, 1.0]) * one.uv)
    ),
    "upside down": images(lambda one: dataclasses.replace(one, uv=np.array([639.0, 479.0]) - one.uv)),
    "u and v swapped": images(lambda one: dataclasses.replace(one, uv=one.uv[:, ::-1].copy())),
    "tracks a keyframe late": _late(1),
    "tracks a keyframe early": _late(-1),
    "principal point 10 px": intrinsics(lambda k: k + np.array([0.0, 0.0, 10.0, 5.0])),
    "focal 1.05": intrinsics(lambda k: k * [1.05, 1.05, 1.0, 1.0]),
    "sigma times 100": images(lambda one: dataclasses.replace(one, sigma_px=100.0 * one.sigma_px)),
    "sigma over 100": images(lambda one: dataclasses.replace(one, sigma_px=0.01 * one.sigma_px)),
    "stamps in us": _stamps(1e-3),
    "stamps in ms": _stamps(1e-6),
}
