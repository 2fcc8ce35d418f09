# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""List the ways in which poses, and cameras on a body that moves, are usually given wrongly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check.mistakes import (
    AXES,
    EXTRINSICS,
    INVERTED,
    OPENGL,
    OPTICAL,
    RIG_W_FIRST,
    Y_Z,
    Mistake,
    Rigid,
    cameras_as,
    turned_by,
    w_first,
)
from ba_node.check.tracks import Tracks
from ba_node.core import geometry

# Other signs and another order of axes.
_X_Y, _Y, _Z = (np.diag(signs) for signs in ([-1.0, -1, 1], [1.0, -1, 1], [1.0, 1, -1]))
_SAME, _SWAPPED = np.eye(3), np.eye(3)[[1, 0, 2]]
_LEFT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a quarter turn about z
_POSES = "pose in the keyframes"
_ORIENTATION, _POSITION = (
    f"the {part} of the {_POSES}: both in one right-handed frame" for part in ("orientation", "position")
)


def _poses(change: Callable[[Rigid], Rigid]) -> Callable[[Tracks, int], Tracks]:
    def undo(given: Tracks, _: int) -> Tracks:
        rotation, position = change((given.rotation, given.position))
        return replace(given, rotation=rotation, position=position)

    return undo


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


def _accumulated(poses: Rigid) -> Rigid:
    """Return the poses whose steps are given in their place, each from the keyframe before."""
    rotation, position = (part.copy() for part in poses)
    for k in range(1, len(rotation)):
        rotation[k], position[k] = geometry.compose(rotation[k - 1], position[k - 1], rotation[k], position[k])
    return rotation, position


def _axes(world: FloatArray, body: FloatArray, position: FloatArray) -> Callable[[Rigid], Rigid]:
    """Return what gives orientations in other axes of the fixed frame and of the body, and positions in others."""
    return lambda poses: (world @ poses[0] @ body, poses[1] @ position.T)


def _scaled(factor: float) -> Callable[[Tracks, int], Tracks]:
    return cameras_as(lambda placed, _: (placed[0], factor * placed[1]))


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
        cameras_as(lambda placed, _: _of_camera(placed)),
    ),
    Mistake(
        "poses inverted and of the camera: they hold camera-from-world, expected world-from-body",
        f"{_POSES}: send the inverse, and set frames.poses_of = camera",
        lambda given, _: _poses(lambda poses: geometry.inverse(*poses))(
            cameras_as(lambda placed, _: _of_camera(placed))(given, 0), 0
        ),
    ),
    INVERTED,
    *AXES,
    OPENGL,
    Mistake(
        "optical and body axes confused: the poses are of a body whose z looks forward",
        f"{_POSES}: send them of a body with x forward, or give {EXTRINSICS} to that body",
        _poses(turned_by(OPTICAL.T)),
    ),
    Mistake(
        "optical and body axes confused: the poses are of a body whose x looks forward, the rig is of one whose z does",
        f"{_POSES}, or {EXTRINSICS}",
        _poses(turned_by(OPTICAL)),
    ),
    Mistake("quaternions of the poses with w first", _POSES, _poses(w_first)),
    RIG_W_FIRST,
    *(
        Mistake(
            f"cameras look {where} body_from_camera says, or orientations of the poses count from another axis than"
            " their positions (as from north)",
            f"{EXTRINSICS}, or the orientation of the {_POSES}",
            cameras_as(lambda placed, _, turn=turn: (turn @ placed[0], placed[1])),  # type: ignore[misc]
        )
        for where, turn in (
            ("to the left of where", _LEFT),
            ("to the right of where", _LEFT.T),
            ("to the other side than", _X_Y),
        )
    ),
    Mistake(
        "poses are of a body with y to the right and z down (forward-right-down), or all cameras sit upside down",
        f"{_POSES}: send them of a body with y to the left and z up, or give {EXTRINSICS} to that body",
        _poses(_axes(_SAME, Y_Z, _SAME)),
    ),
    *(
        Mistake(f"poses are in left-handed axes: {what}", f"{_POSES}, expected in right-handed axes", _poses(undo))
        for what, undo in (
            ("y points to the right", _axes(_Y, _Y, _Y)),
            ("z points down", _axes(_Z, _Z, _Z)),
        )
    ),
    *(
        Mistake(name, change, _poses(undo))
        for name, change, undo in (
            ("orientations of the poses turn clockwise, their positions do not", _ORIENTATION, _axes(_Y, _Y, _SAME)),
            (
                "orientations of the poses are compass headings (clockwise from north), their positions are not",
                _ORIENTATION,
                _axes(_LEFT @ _Y, _Y, _SAME),
            ),
            (
                "orientations of the poses are in north-east-down, their positions in east-north-up",
                _ORIENTATION,
                _axes(_SWAPPED @ _Z, Y_Z, _SAME),
            ),
            (
                "x and y of the poses exchanged: their positions are north-east, their orientations are not",
                _POSITION,
                _axes(_SAME, _SAME, _SWAPPED),
            ),
            ("y of the poses has another sign in their positions", _POSITION, _axes(_SAME, _SAME, _Y)),
        )
    ),
    Mistake(
        "poses hold the step from the keyframe before, expected world-from-body",
        f"{_POSES}: send these steps put together",
        _poses(_accumulated),
    ),
)
# Cameras that swing about a body that hardly moves: how far they are from it tells which of the two lengths is wrong.
_LARGE_RIG = tuple(
    Mistake(f"positions of body_from_camera in {unit}", f"{EXTRINSICS}, expected metres", _scaled(factor))
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


# Keyframes by which tracks may be off their pose.
LAGS = tuple(
    Mistake(
        f"tracks are sent with the keyframe_id of the keyframe {where} theirs",
        "keyframe_id in the feature_tracks, or the pose in the keyframes: both of one image",
        _poses(_shifted(by)),
    )
    for where, by in (("after", 1), ("before", -1))
)
