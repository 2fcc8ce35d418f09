# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of each camera by itself whether it is turned against the body, or against the first one.

Between two keyframes a camera turns by w (rotation vector) and moves along u (unit vector), by its tracks, where it
should by w' and u'. If it is turned by T, then w = T w' and u = T u' for all of them (hand-eye calibration: Tsai and
Lenz, *A new technique for fully autonomous and efficient 3D robotics hand/eye calibration*, 1989, for known positions).
T has the least Cauchy sum of both residuals, each by its own spread: its standard errors are those of the noise.

The first camera is compared with the front-end's steps, whose errors are common to pairs of keyframes that overlap, so
that these count as fewer. Others are compared with the steps of the first, which are free of such errors. Cameras that
see the same points are compared by these (``placement.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.check.diagnosis import Diagnosis, Finding, angle
from ba_node.check.mistakes import OF_ONE_CAMERA, Mistake, finding, in_place_of
from ba_node.check.motion import DOUBTFUL_DEG, compare_steps
from ba_node.check.relations import Relation, agreed, in_motion, relate, shared_views
from ba_node.check.tracks import Image, Tracks
from ba_node.check.two_view import MIN_PAIRS, Pose
from ba_node.core import geometry

# Cameras that are looked at, and pairs of keyframes that are needed, of which so many do not overlap.
_MAX_CAMERAS, _PAIRS_NEEDED, _APART = 8, 10, 5.0
# Standard errors that an axis of the turn has to stand out by, and the least turn that is named, degrees: against the
# front-end's steps, and against those of another camera.
_ERRORS, _LEAST_DEG = 6.0, 2.0
_ERRORS_OF_CAMERAS, _LEAST_OF_CAMERAS_DEG = 4.0, 1.0
# Spreads of turns and directions are no less than this, and the turn itself is no more likely larger, degrees.
_SPREAD_DEG, _ASIDE_DEG, _LIKELY_DEG = 0.02, 0.5, 20.0
# Median lengths of normally distributed vectors with three and with two free components.
_MEDIAN_3, _MEDIAN_2 = 1.538, 1.177
# Residuals of so many spreads have half the weight.
_HALF = 2.0
_ITERATIONS = 15


@dataclass(frozen=True)
class Turn:
    """By how much a camera is turned."""

    along_deg: FloatArray  # (3,) about axes whose errors are independent, degrees
    errors: FloatArray  # (3,) the same in standard errors, as if all pairs of keyframes were independent

    def beyond(self, errors: float) -> float:
        """Return by how much it is turned about those axes that stand out by so many standard errors, degrees."""
        return float(np.linalg.norm(self.along_deg[self.errors > errors]))


def check_mounting(tracks: Tracks, relations: list[Relation]) -> Diagnosis:
    """Compare the turns and directions of every camera with what rig, front-end and first camera tell."""
    first = [one for one in relations if one.a[1] == one.b[1] == 0]
    if len(first) < _PAIRS_NEEDED or not agreed(first):
        return Diagnosis(untold=["too few turns or directions to tell how the cameras sit on the body"])
    beside = [k for k in range(1, min(len(tracks.cameras.model), _MAX_CAMERAS)) if shared_views(tracks, k) < MIN_PAIRS]
    outcome = _first_camera(tracks, first)
    known = {(one.a, one.b): one for one in first}
    for camera in beside:
        outcome.add(_other_camera(tracks, camera, known))
    return outcome


def _first_camera(tracks: Tracks, relations: list[Relation]) -> Diagnosis:
    overlap = _overlap(relations)
    if len(relations) < _APART * overlap:
        return Diagnosis(untold=["too short a way to tell how camera 0 is turned on the body"])
    turn = turned([tracks.between_images(one.a, one.b) for one in relations], relations)
    degrees = turn.beyond(_ERRORS * np.sqrt(overlap))
    if degrees < _LEAST_DEG:
        return Diagnosis(sound=["camera 0 is turned on the body as the rig says"])
    cause = f"camera 0 does not fit its place on the body by about {angle(degrees)}"
    errors = np.max(turn.errors) / np.sqrt(overlap)
    evidence = f"its turns and directions are off those of the front-end, by {errors:.0f} standard errors"
    change = (
        "body_from_camera in camera_rig (or tf_static), the principal point in camera_info (region of interest), or"
        " the pose in the keyframes if it is not that of the body"
    )
    return Diagnosis([Finding((cause,), evidence, (change,))])


def _other_camera(tracks: Tracks, camera: int, known: dict[tuple[Image, Image], Relation]) -> Diagnosis:
    """Compare a camera with the first one, whose steps between keyframes are known but for their length."""
    both = []
    for one in in_motion(tracks, camera):
        images = (one.a[0], 0), (one.b[0], 0)
        first = known.get(images) or relate(tracks, *images, tracks.match(*images))
        both += [(one, first)] if first is not None and first.has_direction else []
    relations = [one for one, _ in both]
    if len(both) < _PAIRS_NEEDED or not agreed(relations) or not agreed([first for _, first in both]):
        return Diagnosis(untold=[f"too few tracks of camera {camera} to tell how it is turned on the body"])
    test, steps = f"camera {camera} against the steps of camera 0", [_step(tracks, first) for _, first in both]
    placed = _placed(tracks.between_cameras(0, camera), steps)
    now = compare_steps(placed, relations)
    rows = [now.row(test, "as given")]
    if np.median(now.off) > DOUBTFUL_DEG:
        tried: dict[Mistake, float] = {}
        swapped = [in_place_of(k) for k in range(1, len(tracks.cameras.model)) if k != camera]
        for mistake in (*OF_ONE_CAMERA, *swapped):
            other = compare_steps(_placed(mistake.undo(tracks, camera).between_cameras(0, camera), steps), relations)
            rows.append(other.row(test, mistake.name.format(camera=camera)))
            if now.loses_to(other):
                tried[mistake] = float(np.median(other.off))
        named = [one for one, off in tried.items() if off <= 1.15 * min(tried.values()) + 1.0]
        if named:
            evidence = f"as given its steps are {np.median(now.off):.0f} degrees off those of camera 0"
            return Diagnosis([finding(named, evidence, camera)], rows=rows)
    turn = turned(placed, relations)
    degrees = turn.beyond(_ERRORS_OF_CAMERAS)
    if degrees < _LEAST_OF_CAMERAS_DEG:
        return Diagnosis(sound=[f"camera {camera} is turned on the body as the rig says"], rows=rows)
    cause = f"camera {camera} does not fit its place on the body by about {angle(degrees)}"
    evidence = f"its turns and directions are off those of camera 0, by {np.max(turn.errors):.0f} standard errors"
    change = f"body_from_camera of camera {camera} in camera_rig (or tf_static), or the principal point in camera_info"
    return Diagnosis([Finding((cause,), evidence, (change,))], rows=rows)


def _step(tracks: Tracks, first: Relation) -> Pose:
    """Return the step of the first camera by its tracks, as long as the front-end's."""
    length = float(np.linalg.norm(tracks.between_images(first.a, first.b).translation))
    return Pose(first.pose.rotation, length * first.pose.translation)


def _placed(to: Pose, steps: Sequence[Pose]) -> list[Pose]:
    """Return the steps of a camera that stands to the first one as ``to`` does."""
    back = geometry.inverse(to.rotation, to.translation)
    after = [geometry.compose(step.rotation, step.translation, *back) for step in steps]
    return [Pose(*geometry.compose(to.rotation, to.translation, *one)) for one in after]


def turned(given: Sequence[Pose], seen: Sequence[Relation]) -> Turn:
    """Return the rotation that brings the given steps of a camera nearest to what its tracks tell."""
    wanted, told, kind = [], [], []
    for step, one in zip(given, seen, strict=True):
        wanted.append(geometry.so3_log(step.rotation))
        told.append(geometry.so3_log(one.pose.rotation))
        kind.append(0)
        length = float(np.linalg.norm(step.translation))
        if one.has_direction and length > 0.0:
            wanted.append(step.translation / length)
            told.append(one.pose.translation)
            kind.append(1)
    of = np.array(kind)
    information, turn = _solved(np.array(wanted), np.array(told), of)
    values, axes = np.linalg.eigh(information)
    along = axes.T @ turn
    return Turn(np.degrees(along), np.sqrt(values) * np.abs(along))


def _solved(wanted: FloatArray, told: FloatArray, kind: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return information (3, 3) and rotation vector (3,) of the turn from vectors ``wanted`` (n, 3) to ``told``.

    ``kind`` (n,) is 0 for a rotation vector, rad, and 1 for a direction.
    """
    least = np.radians([_SPREAD_DEG, _ASIDE_DEG])
    prior = np.eye(3) / np.radians(_LIKELY_DEG) ** 2
    turn, information = np.eye(3), prior
    for _ in range(_ITERATIONS):
        at = wanted @ turn.T
        left = told - at
        length = np.linalg.norm(left, axis=1)
        middle = [np.median(length[kind == k]) if (kind == k).any() else 0.0 for k in (0, 1)]
        spread = np.maximum(np.array(middle) / [_MEDIAN_3, _MEDIAN_2], least)[kind]
        weight = 1.0 / (1.0 + (length / (_HALF * spread)) ** 2) / spread**2
        jacobian = geometry.hat(at)  # of ``left`` by a further turn
        information = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian) + prior
        slope = np.einsum("n,nij,ni->j", weight, jacobian, left) + prior @ geometry.so3_log(turn)
        turn = geometry.so3_exp(-np.linalg.solve(information, slope)) @ turn
    return information, geometry.so3_log(turn)


def _overlap(seen: Sequence[Relation]) -> float:
    """Return by how much fewer independent pairs of keyframes there are than pairs."""
    begin, end = np.array([(one.a[0], one.b[0]) for one in seen]).T
    return max(1.0, float(np.sum(end - begin)) / float(np.max(end) - np.min(begin)))
