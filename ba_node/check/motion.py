# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the steps of a camera by its tracks with those that the front-end and the rig tell."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding, Row
from ba_node.check.mistakes import FLIPS, LAGS, Flip, Mistake, finding, in_motion
from ba_node.check.relations import Relation, agreed
from ba_node.check.tracks import Tracks
from ba_node.check.two_view import Pair, Pose
from ba_node.core import geometry

# Pairs of keyframes that are needed to judge poses, and the share of them that must prefer another hypothesis.
_PAIRS_NEEDED = 5
_VOTES = 0.8
# Fewer pairs, but so many, do where all of them are off by an absurd angle, and none by a doubtful one once a known
# mistake is undone.
_FEW_PAIRS = 3
# Usual angle beyond which poses are said to be wrong where a known mistake explains them, and where none does.
DOUBTFUL_DEG = 15.0
_ABSURD_DEG = 50.0
# Rotations by which a hypothesis must differ to be judged by them, and the steps for which it has to.
_DIFFERENT_DEG = 1.0
_TURNS = 4
# Hypotheses that leave no more than so many times the rotation of the best are named with it.
_ALIKE = 1.5
# Angle by which cameras must be turned for all steps to point where the front-end's do.
_BESIDE_DEG = 5.0
# A hypothesis takes the place of what was given if it halves the angle.
_BETTER = 0.5


def check_motion(tracks: Tracks, relations: list[Relation]) -> Diagnosis:
    """Compare the front-end's steps with those of a camera."""
    usable = [one for one in relations if one.has_direction]
    before = compare(tracks, usable)
    moving = before.length > 0.1 * np.median(before.length) if usable else np.zeros(0, bool)
    usable = [one for one, moves in zip(usable, moving, strict=True) if moves]
    test = "poses against tracks"
    now = compare(tracks, usable)
    few = len(usable) < _PAIRS_NEEDED
    if few and not (len(usable) >= _FEW_PAIRS and now.off.min() > _ABSURD_DEG):
        return _too_few(usable)
    rows = [now.row(test, "as given"), Row(test, "free", float(np.mean([one.share for one in usable])))]
    if np.median(now.off) > DOUBTFUL_DEG:
        tried = {one: compare(one.undo(tracks, 0), usable) for one in in_motion(tracks)}
        rows += [other.row(test, one.name) for one, other in tried.items()]
        best = min(float(np.median(other.off)) for other in tried.values())
        named = [one for one, it in tried.items() if np.median(it.off) <= 1.15 * best + 1.0 and now.loses_to(it)]
        if named:
            evidence = (
                f"as given the front-end's steps are {np.median(now.off):.0f} degrees off, {best:.0f} with that undone"
            )
            if not few or max(float(tried[one].off.max()) for one in named) < DOUBTFUL_DEG:
                return Diagnosis([finding(named, evidence)], rows=rows)
    if few:
        return _too_few(usable)
    return _by_turns(tracks, usable, now, rows) or _unnamed(tracks, usable, now, rows)


def _too_few(usable: list[Relation]) -> Diagnosis:
    return Diagnosis(untold=[f"too little parallax to compare poses with tracks ({len(usable)} pairs of keyframes)"])


def _by_turns(tracks: Tracks, usable: list[Relation], now: Steps, rows: list[Row]) -> Diagnosis | None:
    """Tell of mistakes that show where the camera turns; None if turns do not say so."""
    if np.count_nonzero(now.rotation > _DIFFERENT_DEG) < _TURNS:
        return None  # nothing can be so much nearer
    tried: dict[Mistake | Flip, Steps] = {one: compare(one.undo(tracks, 0), usable) for one in LAGS}
    for flip in FLIPS:
        tried[flip] = compare(tracks, flipped(usable, flip))
    off = {one: float(np.mean(it.rotation)) for one, it in tried.items() if now.turns_worse_than(it)}
    if not off:
        return None
    # Others may explain the turns as well.
    for one in in_motion(tracks):
        tried[one] = compare(one.undo(tracks, 0), usable)
        if now.turns_worse_than(tried[one]) and np.median(tried[one].off) < 1.15 * np.median(now.off) + 1.0:
            off[one] = float(np.mean(tried[one].rotation))
    rows += [it.row(rows[0].test, one.name) for one, it in tried.items()]
    least = min(off.values())
    evidence = f"turns of the front-end are {np.mean(now.rotation):.1f} degrees off, {least:.1f} with that undone"
    named = [one for one, by in off.items() if by < _ALIKE * least]
    return Diagnosis([finding(named, evidence)], rows=rows)


def _unnamed(tracks: Tracks, usable: list[Relation], now: Steps, rows: list[Row]) -> Diagnosis:
    """Tell of a camera that is turned against the body, or of poses that contradict the tracks."""
    if np.median(now.off) > DOUBTFUL_DEG and not agreed(usable):
        return Diagnosis(untold=["too many outliers to tell how the poses are off the tracks"], rows=rows)
    turned = _turned(tracks, usable, now, rows)
    if turned is not None:
        return turned
    if len(usable) >= 2 * _PAIRS_NEEDED and np.median(now.direction) > _ABSURD_DEG:
        evidence = f"the steps of the camera are {np.median(now.direction):.0f} degrees off the front-end's"
        return Diagnosis(
            [Finding(("the poses contradict the tracks",), evidence, ("the pose in the keyframes",))], rows=rows
        )
    tell = f"the poses fit the tracks (directions to {np.median(now.direction):.1f} degrees)"
    return Diagnosis(sound=[tell], rows=rows)


def _turned(tracks: Tracks, usable: list[Relation], now: Steps, rows: list[Row]) -> Diagnosis | None:
    """Tell of a camera that is turned against the body, or its principal point off; None if steps do not say so."""
    turn = _turn(tracks, usable)
    degrees = float(np.degrees(np.linalg.norm(geometry.so3_log(turn))))
    least = _BESIDE_DEG if agreed(usable) else DOUBTFUL_DEG
    if len(usable) < 2 * _PAIRS_NEEDED or degrees < least:
        return None
    turned = compare(tracks, usable, turn)
    if not now.loses_to(turned):
        return None
    rows.append(turned.row(rows[0].test, f"cameras turned by {degrees:.0f} degrees"))
    cause = f"camera 0 does not fit its place on the body by about {degrees:.0f} degrees"
    evidence = f"its steps are {np.median(now.off):.0f} degrees off the front-end's, turned {np.median(turned.off):.0f}"
    change = "body_from_camera in camera_rig (or tf_static), or the principal point in camera_info (region of interest)"
    return Diagnosis([Finding((cause,), evidence, (change,))], rows=rows)


@dataclass(frozen=True)
class Steps:
    """How far a set-up is off the tracks, a row a pair of images."""

    steps: list[tuple[Pair, Pose]]  # rays, and the step of the set-up
    rotation: FloatArray  # (n,) degrees
    direction: FloatArray  # (n,) the same
    length: FloatArray  # (n,) of the step, m

    @property
    def off(self) -> FloatArray:
        """Return one angle for both: a rotation is known better than a direction."""
        return np.asarray(np.nan_to_num(self.direction, nan=90.0) + 2.0 * self.rotation)

    def loses_to(self, other: Steps) -> bool:
        """Return True if another set-up is clearly nearer to the tracks."""
        prefers = np.mean(other.off < self.off)
        return bool(np.median(other.off) < _BETTER * np.median(self.off) and prefers >= _VOTES)

    def turns_worse_than(self, other: Steps) -> bool:
        """Return True if another set-up is clearly nearer in rotation, by the steps for which that differs."""
        differ = np.abs(other.rotation - self.rotation) > _DIFFERENT_DEG
        if np.count_nonzero(differ) < _TURNS:
            return False
        prefers = np.mean(other.rotation[differ] < self.rotation[differ])
        return bool(prefers >= _VOTES and np.sum(other.rotation[differ]) < _BETTER * np.sum(self.rotation[differ]))

    def row(self, test: str, name: str) -> Row:
        """Return it for the table."""
        share = float(np.mean([two_view.share(*step) for step in self.steps]))
        return Row(test, name, share, float(np.median(self.rotation)), float(np.median(self.direction)))


def compare(given: Tracks, relations: list[Relation], turn: FloatArray | None = None) -> Steps:
    """Return how far a set-up is off the tracks, with its cameras turned by a rotation (3, 3) if there is one."""
    told = [given.between_images(one.a, one.b) for one in relations]
    if turn is not None:
        told = [Pose(turn @ step.rotation @ turn.T, turn @ step.translation) for step in told]
    return compare_steps(told, relations)


def compare_steps(told: Sequence[Pose], relations: Sequence[Relation]) -> Steps:
    """Return how far steps (n) are off those by the tracks."""
    rows, steps = [], []
    for step, one in zip(told, relations, strict=True):
        rows.append((step.turned_from(one.pose), step.direction_from(one.pose), np.linalg.norm(step.translation)))
        steps.append((one.pair, step))
    return Steps(steps, *np.array(rows).reshape(-1, 3).T)


def flipped(relations: list[Relation], flip: Flip) -> list[Relation]:
    """Return relations as they are with an exchange in the images undone; the rays stay."""
    return [dataclasses.replace(one, pose=flip.relation(one.pose)) for one in relations]


def contradicts(tracks: Tracks, relations: list[Relation], flip: Flip) -> bool:
    """Return True if the steps of the front-end fit the tracks as given, and not with an exchange undone."""
    usable = [one for one in relations if one.has_direction]
    return compare(tracks, flipped(usable, flip)).turns_worse_than(compare(tracks, usable))


def _turn(given: Tracks, relations: list[Relation]) -> FloatArray:
    """Return the rotation of the cameras that brings the given steps nearest to those of the tracks (Kabsch)."""
    total = 0.1 * len(relations) * np.eye(3)
    for one in relations:
        step = given.between_images(one.a, one.b)
        length = np.linalg.norm(step.translation)
        total += np.outer(one.pose.translation, step.translation / length)
        total += np.outer(geometry.so3_log(one.pose.rotation), geometry.so3_log(step.rotation))
    return geometry.nearest_rotation(total)
