# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""List the ways in which cameras, poses and pixels are usually given wrongly, each as what undoes it.

The optical frame of a camera looks along z, a body along x (REP-103). Cameras are body_from_camera as in the rig, poses
are fixed frame from body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check.diagnosis import Finding
from ba_node.check.tracks import Tracks
from ba_node.check.two_view import Pose
from ba_node.core import geometry
from ba_node.core.cameras import CX, CY

# Rotations (n, 3, 3) and translations (n, 3).
Rigid = tuple[FloatArray, FloatArray]

# Body from optical frame: x right, y down, z forward are -y, -z, x of the body.
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_EXTRINSICS = "body_from_camera in camera_rig (or tf_static)"
_ONE = "body_from_camera of camera {camera} in camera_rig (or tf_static)"
_POSES = "pose in the keyframes"
_PIXELS = "u and v in the feature_tracks, or the images that they are tracked in"


@dataclass(frozen=True)
class Mistake:
    """A way to give a set-up wrongly."""

    name: str  # as a user would say it; ``{camera}`` is the camera in question
    change: str  # the field or parameter to change
    undo: Callable[[Tracks, int], Tracks]  # from what was given to what was meant; for cameras: of which one


def _cameras(change: Callable[[Rigid, int], Rigid]) -> Callable[[Tracks, int], Tracks]:
    def undo(given: Tracks, camera: int) -> Tracks:
        placed = geometry.inverse(given.cameras.rotation, given.cameras.translation)
        rotation, translation = geometry.inverse(*change(placed, camera))
        return replace(given, cameras=replace(given.cameras, rotation=rotation, translation=translation))

    return undo


def _poses(change: Callable[[Rigid], Rigid]) -> Callable[[Tracks, int], Tracks]:
    def undo(given: Tracks, _: int) -> Tracks:
        rotation, position = change((given.rotation, given.position))
        return replace(given, rotation=rotation, position=position)

    return undo


def _one(change: Callable[[Rigid, int], Rigid]) -> Callable[[Rigid, int], Rigid]:
    """Return what changes one camera alone, ``change`` giving all of them otherwise."""

    def of_one(placed: Rigid, camera: int) -> Rigid:
        rotation, translation = (part.copy() for part in placed)
        turned, moved = change(placed, camera)
        rotation[camera], translation[camera] = turned[camera], moved[camera]
        return rotation, translation

    return of_one


def _swapped(placed: Rigid, camera: int) -> Rigid:
    order = np.arange(len(placed[0]))
    order[[0, camera]] = camera, 0
    return placed[0][order], placed[1][order]


def _w_first(placed: Rigid) -> Rigid:
    """Read quaternions that were written w x y z into the fields x y z w."""
    written = geometry.quaternion_from_matrix(placed[0])
    return geometry.matrix_from_quaternion(written[:, [1, 2, 3, 0]]), placed[1]


def _of_camera(placed: Rigid) -> Rigid:
    """Let the first camera be the body."""
    first = geometry.inverse(placed[0][:1], placed[1][:1])
    return geometry.compose(*first, *placed)


def _shifted(by: int) -> Callable[[Rigid], Rigid]:
    """Return what gives each keyframe the pose of the one so many before, those at the ends their own."""

    def shift(poses: Rigid) -> Rigid:
        rows = np.clip(np.arange(len(poses[0])) - by, 0, len(poses[0]) - 1)
        return poses[0][rows], poses[1][rows]

    return shift


def _scaled(factor: float) -> Callable[[Tracks, int], Tracks]:
    return _cameras(lambda placed, _: (placed[0], factor * placed[1]))


def _turned(rotation: FloatArray) -> Callable[[Rigid], Rigid]:
    return lambda placed: (placed[0] @ rotation, placed[1])


_INVERTED = Mistake(
    "extrinsics inverted: body_from_camera holds camera-from-body",
    _EXTRINSICS,
    _cameras(lambda placed, _: geometry.inverse(*placed)),
)
_AXES = tuple(
    Mistake(
        f"optical and body axes confused: body_from_camera {what}",
        f"{_EXTRINSICS}: give the pose of the optical frame (z forward){once}",
        _cameras(lambda placed, _, rotation=rotation: _turned(rotation)(placed)),  # type: ignore[misc]
    )
    for what, once, rotation in (
        ("is that of a frame that looks along x", "", _OPTICAL),
        ("turns into the optical frame twice", " once", _OPTICAL.T),
    )
)
_RIG_W_FIRST = Mistake(
    "quaternions of body_from_camera with w first", _EXTRINSICS, _cameras(lambda placed, _: _w_first(placed))
)
# Mistakes that show between two cameras of a keyframe, beside those of pixels.
BETWEEN_CAMERAS = (
    Mistake(
        "baseline of camera {camera} reversed: the tracks see it on the other side of camera 0",
        f"the position in {_ONE}",
        _cameras(_one(lambda placed, _: (placed[0], 2.0 * placed[1][:1] - placed[1]))),
    ),
    Mistake(
        "cameras 0 and {camera} swapped",
        "camera_index in the feature_tracks, or the order of the cameras in camera_rig",
        _cameras(_swapped),
    ),
    _INVERTED,
    Mistake(
        "extrinsics of camera {camera} inverted: body_from_camera holds camera-from-body",
        _ONE,
        _cameras(_one(lambda placed, _: geometry.inverse(*placed))),
    ),
    Mistake(
        "rotation of camera {camera} inverted: body_from_camera holds the rotation of camera-from-body",
        f"the orientation in {_ONE}",
        _cameras(_one(lambda placed, _: (np.swapaxes(placed[0], 1, 2), placed[1]))),
    ),
    *_AXES,
    _RIG_W_FIRST,
)
# Those of one camera alone, beside :func:`in_place_of`.
OF_ONE_CAMERA = tuple(
    Mistake(f"camera {{camera}}: {what}", _ONE, _cameras(_one(change)))
    for what, change in (
        ("extrinsics inverted, body_from_camera holds camera-from-body", lambda placed, _: geometry.inverse(*placed)),
        (
            "optical and body axes confused, body_from_camera is that of a frame that looks along x",
            lambda placed, _: (placed[0] @ _OPTICAL, placed[1]),
        ),
        ("quaternion of body_from_camera with w first", lambda placed, _: _w_first(placed)),
    )
)


def in_place_of(other: int) -> Mistake:
    """Return that a camera sits where the rig says that another one does."""
    return Mistake(
        f"cameras {other} and {{camera}} swapped",
        "camera_index in the feature_tracks, or the order of the cameras in camera_rig",
        _cameras(_one(lambda placed, _: (np.repeat(placed[0][other][None], len(placed[0]), 0), placed[1]))),
    )


# Mistakes that show as a camera moves, beside those of pixels.
_IN_MOTION = (
    Mistake(
        "poses inverted: they hold body-from-world, expected world-from-body",
        f"{_POSES}: send the inverse",
        _poses(lambda poses: geometry.inverse(*poses)),
    ),
    Mistake(
        "orientations of the poses inverted: they turn from world to body, expected from body to world",
        f"the orientation of the {_POSES}",
        _poses(lambda poses: (np.swapaxes(poses[0], 1, 2), poses[1])),
    ),
    Mistake(
        "poses are of the camera, given as of the body",
        "frames.poses_of = camera",
        _cameras(lambda placed, _: _of_camera(placed)),
    ),
    Mistake(
        "poses inverted and of the camera: they hold camera-from-world, expected world-from-body",
        f"{_POSES}: send the inverse, and set frames.poses_of = camera",
        lambda given, _: _poses(lambda poses: geometry.inverse(*poses))(
            _cameras(lambda placed, _: _of_camera(placed))(given, 0), 0
        ),
    ),
    _INVERTED,
    *_AXES,
    Mistake(
        "optical and body axes confused: the poses are of a body whose z looks forward",
        f"{_POSES}: send them of a body with x forward, or give {_EXTRINSICS} to that body",
        _poses(_turned(_OPTICAL.T)),
    ),
    Mistake(
        "optical and body axes confused: the poses are of a body whose x looks forward, the rig is of one whose z does",
        f"{_POSES}, or {_EXTRINSICS}",
        _poses(_turned(_OPTICAL)),
    ),
    Mistake("quaternions of the poses with w first", _POSES, _poses(_w_first)),
    _RIG_W_FIRST,
)
# Cameras that swing about a body that hardly moves: how far they are from it tells which of the two lengths is wrong.
_LARGE_RIG = tuple(
    Mistake(f"positions of body_from_camera in {unit}", f"{_EXTRINSICS}, expected metres", _scaled(factor))
    for unit, factor in (("millimetres", 0.001), ("centimetres", 0.01))
)
_SMALL_STEPS = (
    Mistake(
        "positions of the poses in kilometres, or in another unit far larger than metres",
        "the position in the keyframes, expected metres",
        _poses(lambda poses: (poses[0], 1000.0 * poses[1])),
    ),
)
# Rigs that are no larger are not given in too small a unit, larger ones are no rigs, m.
_SMALLEST_M, _LARGEST_M = 2.0, 10.0


def in_motion(given: Tracks) -> tuple[Mistake, ...]:
    """Return the mistakes that show as a camera moves."""
    lever_m = float(np.linalg.norm(given.cameras.translation, axis=1).max())
    large, small = (lever_m > _SMALLEST_M) * _LARGE_RIG, (lever_m < _LARGEST_M) * _SMALL_STEPS
    return (*_IN_MOTION, *large, *small)


@dataclass(frozen=True, eq=False)
class Flip:
    """A way to give the image coordinates of all cameras wrongly."""

    name: str
    change: str
    turn: FloatArray  # (3, 3) orthogonal: rays as they were meant from those given

    def undo(self, given: Tracks) -> Tracks:
        """Return what was meant, about the principal point."""
        centre = given.cameras.params[given.camera, CX : CY + 1]
        uv = given.uv[:, ::-1] if self.turn[0, 1] else centre + (given.uv - centre) * np.diagonal(self.turn)[:2]
        return given.seen(uv)

    def relation(self, found: Pose) -> Pose:
        """Return how two images stand to each other, from what their tracks as given tell."""
        return Pose(self.turn @ found.rotation @ self.turn.T, self.turn @ found.translation)


FLIPS = (
    Flip("images mirrored: left and right are exchanged", _PIXELS, np.diag([-1.0, 1.0, 1.0])),
    Flip("images mirrored: top and bottom are exchanged", _PIXELS, np.diag([1.0, -1.0, 1.0])),
    Flip(
        "images upside down: turned by 180 degrees against the camera of the rig", _PIXELS, np.diag([-1.0, -1.0, 1.0])
    ),
    Flip("u and v swapped", "u and v in the feature_tracks: u is the column, v the row", np.eye(3)[[1, 0, 2]]),
)
# Keyframes by which tracks may be off their pose.
LAGS = tuple(
    Mistake(
        f"tracks are sent with the keyframe_id of the keyframe {where} theirs",
        "keyframe_id in the feature_tracks, or the pose in the keyframes: both of one image",
        _poses(_shifted(by)),
    )
    for where, by in (("after", 1), ("before", -1))
)


def finding(mistakes: Sequence[Mistake | Flip], evidence: str, camera: int = 0) -> Finding:
    """Return that it is one of some usual mistakes."""
    causes = tuple(one.name.format(camera=camera) for one in mistakes)
    return Finding(causes, evidence, tuple(one.change.format(camera=camera) for one in mistakes), usual=True)
