# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the ways in which cameras and poses are usually given wrongly, each as another rig and other poses.

The optical frame of a camera looks along z, a body along x (REP-103). Cameras are body_from_camera as in the rig, poses
are fixed frame from body.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check.tracks import Image, Tracks
from ba_node.check.two_view import Pose
from ba_node.core import geometry

# Body from optical frame: x right, y down, z forward are -y, -z, x of the body.
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_EXTRINSICS = "body_from_camera in camera_rig (or tf_static)"
_ONE = "body_from_camera of camera {camera} in camera_rig (or tf_static)"
_POSES = "pose in the keyframes"


@dataclass(frozen=True)
class Placed:
    """Rigid transforms: rotation (n, 3, 3) and translation (n, 3)."""

    rotation: FloatArray
    translation: FloatArray

    def inverse(self) -> Placed:
        """Return the inverses."""
        return Placed(*geometry.inverse(self.rotation, self.translation))

    def after(self, other: Placed) -> Placed:
        """Return the transforms that apply others first, then these."""
        return Placed(*geometry.compose(self.rotation, self.translation, other.rotation, other.translation))

    def turned(self, rotation: FloatArray) -> Placed:
        """Return the transforms that turn first, then apply these."""
        return Placed(self.rotation @ rotation, self.translation)

    def only(self, row: int) -> Placed:
        """Return one of them, still with a first axis."""
        return Placed(self.rotation[row : row + 1], self.translation[row : row + 1])


@dataclass(frozen=True)
class SetUp:
    """Where everything is: cameras on the body (n_cam), and the body in the fixed frame (n_kf)."""

    cameras: Placed
    poses: Placed

    def between_cameras(self, a: int, b: int) -> Pose:
        """Return camera b from camera a."""
        step = self.cameras.only(b).inverse().after(self.cameras.only(a))
        return Pose(step.rotation[0], step.translation[0])

    def between_images(self, a: Image, b: Image) -> Pose:
        """Return image b from image a, both (keyframe, camera)."""
        (key_a, cam_a), (key_b, cam_b) = a, b
        from_a = self.poses.only(key_a).after(self.cameras.only(cam_a))
        step = self.poses.only(key_b).after(self.cameras.only(cam_b)).inverse().after(from_a)
        return Pose(step.rotation[0], step.translation[0])


@dataclass(frozen=True)
class Mistake:
    """A way to give a set-up wrongly."""

    name: str  # as a user would say it; ``{camera}`` is the camera in question
    change: str  # the field or parameter to change
    undo: Callable[[SetUp, int], SetUp]  # from the set-up as given to the one that was meant; for cameras: of which one


def as_given(tracks: Tracks) -> SetUp:
    """Return the set-up as it was given."""
    cameras = Placed(tracks.cameras.rotation, tracks.cameras.translation).inverse()
    return SetUp(cameras, Placed(tracks.rotation, tracks.position))


def _reversed(given: SetUp, camera: int) -> SetUp:
    """Put a camera on the other side of camera 0."""
    position = given.cameras.translation.copy()
    position[camera] = 2.0 * position[0] - position[camera]
    return SetUp(Placed(given.cameras.rotation, position), given.poses)


def _swapped(given: SetUp, camera: int) -> SetUp:
    order = np.arange(len(given.cameras.rotation))
    order[[0, camera]] = camera, 0
    return SetUp(Placed(given.cameras.rotation[order], given.cameras.translation[order]), given.poses)


def _rotation_only(given: SetUp, camera: int) -> SetUp:
    """Turn one camera about, which is what an inverse of its rotation alone does."""
    rotation = given.cameras.rotation.copy()
    rotation[camera] = rotation[camera].T
    return SetUp(Placed(rotation, given.cameras.translation), given.poses)


def _one_inverted(given: SetUp, camera: int) -> SetUp:
    rotation, translation = given.cameras.rotation.copy(), given.cameras.translation.copy()
    rotation[camera], translation[camera] = geometry.inverse(rotation[camera], translation[camera])
    return SetUp(Placed(rotation, translation), given.poses)


def _w_first(placed: Placed) -> Placed:
    """Read quaternions that were written w x y z into the fields x y z w."""
    written = geometry.quaternion_from_matrix(placed.rotation)
    return Placed(geometry.matrix_from_quaternion(written[:, [1, 2, 3, 0]]), placed.translation)


def _cameras(change: Callable[[Placed], Placed]) -> Callable[[SetUp, int], SetUp]:
    return lambda given, _: SetUp(change(given.cameras), given.poses)


def _poses(change: Callable[[Placed], Placed]) -> Callable[[SetUp, int], SetUp]:
    return lambda given, _: SetUp(given.cameras, change(given.poses))


def _of_camera(given: Placed) -> Placed:
    return given.only(0).inverse().after(given)


_INVERTED = Mistake(
    "extrinsics inverted: body_from_camera holds camera-from-body", _EXTRINSICS, _cameras(Placed.inverse)
)
_AXES = (
    Mistake(
        "optical and body axes confused: body_from_camera is that of a frame that looks along x",
        f"{_EXTRINSICS}: give the pose of the optical frame (z forward)",
        _cameras(lambda placed: placed.turned(_OPTICAL)),
    ),
    Mistake(
        "optical and body axes confused: body_from_camera turns into the optical frame twice",
        f"{_EXTRINSICS}: give the pose of the optical frame (z forward) once",
        _cameras(lambda placed: placed.turned(_OPTICAL.T)),
    ),
)
# Mistakes that show between two cameras of a keyframe.
BETWEEN_CAMERAS = (
    Mistake(
        "baseline of camera {camera} reversed: the tracks see it on the other side of camera 0",
        f"the position in {_ONE}",
        _reversed,
    ),
    Mistake(
        "cameras 0 and {camera} swapped",
        "camera_index in the feature_tracks, or the order of the cameras in camera_rig",
        _swapped,
    ),
    _INVERTED,
    Mistake(
        "extrinsics of camera {camera} inverted: body_from_camera holds camera-from-body",
        _ONE,
        _one_inverted,
    ),
    Mistake(
        "rotation of camera {camera} inverted: body_from_camera holds the rotation of camera-from-body",
        f"the orientation in {_ONE}",
        _rotation_only,
    ),
    *_AXES,
    Mistake("quaternions of body_from_camera with w first", _EXTRINSICS, _cameras(_w_first)),
)
# Mistakes that show as a camera moves.
IN_MOTION = (
    Mistake(
        "poses inverted: they hold body-from-world, expected world-from-body",
        f"{_POSES}: send the inverse",
        _poses(Placed.inverse),
    ),
    Mistake(
        "poses are of the camera, given as of the body",
        "frames.poses_of = camera",
        _cameras(_of_camera),
    ),
    Mistake(
        "poses inverted and of the camera: they hold camera-from-world, expected world-from-body",
        f"{_POSES}: send the inverse, and set frames.poses_of = camera",
        lambda given, _: SetUp(_of_camera(given.cameras), given.poses.inverse()),
    ),
    _INVERTED,
    *_AXES,
    Mistake(
        "optical and body axes confused: the poses are of a body whose z looks forward",
        f"{_POSES}: send them of a body with x forward, or give {_EXTRINSICS} to that body",
        _poses(lambda placed: placed.turned(_OPTICAL.T)),
    ),
    Mistake(
        "optical and body axes confused: the poses are of a body whose x looks forward, the rig is of one whose z does",
        f"{_POSES}, or {_EXTRINSICS}",
        _poses(lambda placed: placed.turned(_OPTICAL)),
    ),
    Mistake(
        "positions of body_from_camera in millimetres",
        f"{_EXTRINSICS}, expected metres",
        _cameras(lambda placed: Placed(placed.rotation, 0.001 * placed.translation)),
    ),
    Mistake(
        "positions of body_from_camera in centimetres",
        f"{_EXTRINSICS}, expected metres",
        _cameras(lambda placed: Placed(placed.rotation, 0.01 * placed.translation)),
    ),
    Mistake("quaternions of the poses with w first", _POSES, _poses(_w_first)),
    Mistake("quaternions of body_from_camera with w first", _EXTRINSICS, _cameras(_w_first)),
)
