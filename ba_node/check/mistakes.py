# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""List the ways in which cameras, poses and pixels are usually given wrongly, each as what undoes it.

The optical frame of a camera looks along z, a body along x (REP-103). Cameras are body_from_camera as in the rig, poses
are fixed frame from body.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check.diagnosis import Finding
from ba_node.check.tracks import Tracks
from ba_node.check.two_view import Pair, Pose
from ba_node.core import geometry
from ba_node.core.cameras import CX, CY, FX

# Rotations (n, 3, 3) and translations (n, 3).
Rigid = tuple[FloatArray, FloatArray]

# Body from optical frame: x right, y down, z forward are -y, -z, x of the body.
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# A half turn about x.
Y_Z = np.diag([1.0, -1.0, -1.0])
EXTRINSICS = "body_from_camera in camera_rig (or tf_static)"
_ONE = "body_from_camera of camera {camera} in camera_rig (or tf_static)"
_INDEX = "camera_index in the feature_tracks, or the order of the cameras in camera_rig"
_PIXELS = "u and v in the feature_tracks, or the images that they are tracked in"


@dataclass(frozen=True)
class Mistake:
    """A way to give a set-up wrongly."""

    name: str  # as a user would say it; ``{camera}`` is the camera in question
    change: str  # the field or parameter to change
    undo: Callable[[Tracks, int], Tracks]  # from what was given to what was meant; for cameras: of which one


def cameras_as(change: Callable[[Rigid, int], Rigid]) -> Callable[[Tracks, int], Tracks]:
    """Return what gives all cameras otherwise."""

    def undo(given: Tracks, camera: int) -> Tracks:
        placed = geometry.inverse(given.cameras.rotation, given.cameras.translation)
        rotation, translation = geometry.inverse(*change(placed, camera))
        return replace(given, cameras=replace(given.cameras, rotation=rotation, translation=translation))

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


def w_first(placed: Rigid) -> Rigid:
    """Read quaternions that were written w x y z into the fields x y z w."""
    written = geometry.quaternion_from_matrix(placed[0])
    return geometry.matrix_from_quaternion(written[:, [1, 2, 3, 0]]), placed[1]


def turned_by(rotation: FloatArray) -> Callable[[Rigid], Rigid]:
    """Return what turns frames about their own axes."""
    return lambda placed: (placed[0] @ rotation, placed[1])


INVERTED = Mistake(
    "extrinsics inverted: body_from_camera holds camera-from-body",
    EXTRINSICS,
    cameras_as(lambda placed, _: geometry.inverse(*placed)),
)
AXES = tuple(
    Mistake(
        f"optical and body axes confused: body_from_camera {what}",
        f"{EXTRINSICS}: give the pose of the optical frame (z forward){once}",
        cameras_as(lambda placed, _, rotation=rotation: turned_by(rotation)(placed)),  # type: ignore[misc]
    )
    for what, once, rotation in (
        ("is that of a frame that looks along x", "", OPTICAL),
        ("turns into the optical frame twice", " once", OPTICAL.T),
    )
)
OPENGL = Mistake(
    "optical axes confused: body_from_camera is that of a camera with y up that looks along -z, as in OpenGL",
    f"{EXTRINSICS}: give the pose of the optical frame (x right, y down, z forward)",
    cameras_as(lambda placed, _: turned_by(Y_Z)(placed)),
)
RIG_W_FIRST = Mistake(
    "quaternions of body_from_camera with w first", EXTRINSICS, cameras_as(lambda placed, _: w_first(placed))
)
# Mistakes that show between two cameras of a keyframe, beside those of pixels.
BETWEEN_CAMERAS = (
    *(
        Mistake(
            f"body_from_camera of camera {{camera}} is {what}: expected its pose on the body",
            _ONE,
            cameras_as(_one(undo)),
        )
        for what, undo in (
            ("its pose from camera 0", lambda placed, _: geometry.compose(placed[0][:1], placed[1][:1], *placed)),
            (
                "camera {camera} from camera 0 (as T_cn_cnm1 of Kalibr)",
                lambda placed, _: geometry.compose(placed[0][:1], placed[1][:1], *geometry.inverse(*placed)),
            ),
        )
    ),
    Mistake(
        "baseline of camera {camera} reversed: the tracks see it on the other side of camera 0",
        f"the position in {_ONE}",
        cameras_as(_one(lambda placed, _: (placed[0], 2.0 * placed[1][:1] - placed[1]))),
    ),
    Mistake(
        "cameras 0 and {camera} swapped",
        _INDEX,
        cameras_as(_swapped),
    ),
    INVERTED,
    Mistake(
        "extrinsics of camera {camera} inverted: body_from_camera holds camera-from-body",
        _ONE,
        cameras_as(_one(lambda placed, _: geometry.inverse(*placed))),
    ),
    Mistake(
        "rotation of camera {camera} inverted: body_from_camera holds the rotation of camera-from-body",
        f"the orientation in {_ONE}",
        cameras_as(_one(lambda placed, _: (np.swapaxes(placed[0], 1, 2), placed[1]))),
    ),
    *AXES,
    RIG_W_FIRST,
)
# Those of one camera alone, beside :func:`in_place_of`.
OF_ONE_CAMERA = tuple(
    Mistake(f"camera {{camera}}: {what}", _ONE, cameras_as(_one(change)))
    for what, change in (
        ("extrinsics inverted, body_from_camera holds camera-from-body", lambda placed, _: geometry.inverse(*placed)),
        (
            "optical and body axes confused, body_from_camera is that of a frame that looks along x",
            lambda placed, _: (placed[0] @ OPTICAL, placed[1]),
        ),
        ("quaternion of body_from_camera with w first", lambda placed, _: w_first(placed)),
    )
)


def in_place_of(other: int) -> Mistake:
    """Return that a camera sits where the rig says that another one does."""
    return Mistake(
        f"cameras {other} and {{camera}} swapped",
        _INDEX,
        cameras_as(_one(lambda placed, _: (np.repeat(placed[0][other][None], len(placed[0]), 0), placed[1]))),
    )


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

    def rays(self, given: Pair) -> Pair:
        """Return the rays of two images as they were meant."""
        turn = self.turn[:2, :2].T
        return Pair(given.a @ turn, given.b @ turn, given.gate)

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
# Factors between the image that k is of and the one that is tracked, and how nearly the middle of its tracks shows one.
_SIZES, _NEARLY = (4.0, 2.0, 0.5, 0.25), 1.33


def swapped(given: Tracks, order: Sequence[int]) -> Tracks:
    """Return what is seen if every camera, its lens and its place, is the one that an order names for it."""
    rig, rows = given.cameras, list(order)
    placed = replace(rig, model=rig.model[rows], rotation=rig.rotation[rows], translation=rig.translation[rows])
    return replace(given, cameras=placed).seen(params=rig.params[rows])


def _exchanged(given: Tracks, camera: int) -> Tracks:
    order = np.arange(len(given.cameras.model))
    order[[0, camera]] = camera, 0
    return swapped(given, order.tolist())


def _seen(given: Tracks, _: int, uv: FloatArray | None = None, params: FloatArray | None = None) -> Tracks:
    return given.seen(uv, params)


def images_of_one(given: Tracks, camera: int) -> list[Mistake]:
    """Return the ways to give the images of a camera wrongly, or those of camera 0, which it is compared with."""
    rig, found = given.cameras, []
    if rig.model[0] != rig.model[camera] or not np.allclose(rig.params[0], rig.params[camera]):
        found.append(Mistake("cameras 0 and {camera} swapped, intrinsics and place", _INDEX, _exchanged))
    for one in (camera, 0):
        its = given.camera == one
        middle = 0.5 * np.percentile(given.uv[its], [0.2, 99.8], axis=0).sum(axis=0)
        times = float(np.median(given.cameras.params[one, CX : CY + 1] / np.maximum(middle, 1e-9)))
        for size in _SIZES:
            if 1.0 / _NEARLY < times / size < _NEARLY:
                much = f"{size:g} times as large" if size > 1.0 else f"{1.0 / size:g} times as small"
                cause = f"k of camera {one} is that of an image {much} as the one that it is tracked in"
                change = f"k, or binning_x and binning_y, in the camera_info of camera {one}"
                params = given.cameras.params.copy()
                params[one, FX : CY + 1] /= size
                undo = functools.partial(_seen, params=params)
                found.append(Mistake(cause, change, undo))
        for flip in FLIPS:
            uv = np.where(its[:, None], flip.undo(given).uv, given.uv)
            undo = functools.partial(_seen, uv=uv)
            upright = f", or {_ONE.format(camera=one)}" if np.linalg.det(flip.turn) > 0.0 else ""
            found.append(Mistake(f"{flip.name}, of camera {one} alone", f"{flip.change}{upright}", undo))
    return found


def finding(mistakes: Sequence[Mistake | Flip], evidence: str, camera: int = 0) -> Finding:
    """Return that it is one of some usual mistakes."""
    causes = tuple(one.name.format(camera=camera) for one in mistakes)
    return Finding(causes, evidence, tuple(one.change.format(camera=camera) for one in mistakes), usual=True)
