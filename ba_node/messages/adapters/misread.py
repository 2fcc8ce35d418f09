# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold the points that a source tells against where it saw them, and name what its poses seem to be where they differ.

A source tells where a point is and in which pixel it saw it: both are of one estimate, and fit to a degree or so,
whatever it has drifted by. If they do not, and do with quaternions or poses read in another way, that is what they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import cameras, geometry
from ba_node.measurements import CameraRig
from ba_node.messages.adapters.sources import Features, Pose

# Points and pixels that are farther apart (median) do not fit; another reading fits if it leaves so little, and no more
# than this share of it. Radians.
_APART, _FITS, _LEFT = 0.35, 0.09, 0.25
_FEWEST = 8
# Rotation (n, 3, 3) and translation (n, 3).
_Rigid = tuple[FloatArray, FloatArray]


def _w_first(at: _Rigid) -> _Rigid:
    written = geometry.quaternion_from_matrix(at[0])
    return geometry.matrix_from_quaternion(written[:, [1, 2, 3, 0]]), at[1]


_READINGS: Mapping[str, Callable[[_Rigid], _Rigid]] = {
    "": lambda at: at,
    "have quaternions with w first: put x, y, z, w into them": _w_first,
    "have inverted orientations": lambda at: (np.swapaxes(at[0], 1, 2), at[1]),
    "are inverted": lambda at: geometry.inverse(*at),
}
_POSE, _CAMERA = "poses (fixed frame from body)", "extrinsics (body from camera)"


def misread(pose: Pose, features: Features, rig: CameraRig) -> str:
    """Return in words what poses or extrinsics seem to be, empty if points and pixels fit, or nothing explains it."""
    told = np.isfinite(features.point).all(axis=1)
    ray = _rays(features, rig)
    rows = np.flatnonzero(told & np.isfinite(ray).all(axis=1))
    if len(rows) < _FEWEST:
        return ""
    ray, point, camera = ray[rows], features.point[rows], features.camera[rows]
    at = geometry.matrix_from_quaternion(pose.orientation[None]), pose.position[None]
    placed = geometry.matrix_from_quaternion(rig.orientation), rig.position

    def apart(of_pose: str, of_camera: str) -> float:
        body = point
        if not features.point_in_body:
            body = _transformed(geometry.inverse(*_READINGS[of_pose](at)), point)
        turn, move = geometry.inverse(*_READINGS[of_camera](placed))
        return _angle(_transformed((turn[camera], move[camera]), body), ray)

    given = apart("", "")
    if given <= _APART:
        return ""
    poses = ("",) if features.point_in_body else tuple(_READINGS)
    tried = [(bool(a) + bool(b), apart(a, b), a, b) for a in poses for b in _READINGS if a or b]
    fitting = [one for one in tried if one[1] < min(_FITS, _LEFT * given)]
    if not fitting:
        return ""
    _, left, of_pose, of_camera = min(fitting)
    what = " and ".join(f"the {name} {how}" for name, how in ((_POSE, of_pose), (_CAMERA, of_camera)) if how)
    return (
        f"points are seen {np.degrees(given):.0f} degrees from where they are told to be (median), and"
        f" {np.degrees(left):.1f} if {what}"
    )


def _transformed(by: _Rigid, point: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nij,nj->ni", np.broadcast_to(by[0], (len(point), 3, 3)), point) + by[1])


def _angle(a: FloatArray, b: FloatArray) -> float:
    """Return the median angle between vectors (n, 3), rad."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return float(np.median(np.arccos((np.sum(a * b, axis=1) / lengths.clip(min=1e-12)).clip(-1.0, 1.0))))


def _rays(features: Features, rig: CameraRig) -> FloatArray:
    """Return where features are seen, in their cameras: (n, 3); as the source says it, else by the rig."""
    flat = features.normalised
    if not np.isfinite(flat).all():
        lenses = [cameras.parameters(*of) for of in zip(rig.models, rig.intrinsics, rig.distortion, strict=True)]
        model = np.array([int(model) for model, _ in lenses], np.uint8)[features.camera]
        flat = cameras.normalise(features.uv, model, np.array([params for _, params in lenses])[features.camera])
    return np.column_stack([flat, np.ones(len(flat))])
