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
from ba_node.check.mistakes import FLIPS, Flip, Mistake, finding
from ba_node.check.pose_mistakes import LAGS, in_motion
from ba_node.check.relations import AGREED, Relation, agreed, of_cameras
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
# Positions and orientations that are the same in so many keyframes, to this, m, are not filled in where tracks move.
_STAND_STILL, _NO_CHANGE = 15, 1e-9
# What two cameras see fits with an exchange in the images undone if it explains this share of what it does as given.
_FITS = 0.9
# Rounds of an estimate of that turn, and what no turn at all weighs against the steps.
_ROUNDS, _STAY = 8, 0.03
# A hypothesis takes the place of what was given if it halves the angle.
_BETTER = 0.5


def check_motion(tracks: Tracks, relations: list[Relation], *, doubted: bool = False) -> Diagnosis:
    """Compare the front-end's steps with those of a camera; one pair will do if they are ``doubted`` already."""
    usable = [one for one in relations if one.has_direction]
    same = _all_the_same(tracks, usable)
    if same is not None:
        return same
    before = compare(tracks, usable)
    moving = before.length > 0.1 * np.median(before.length) if usable else np.zeros(0, bool)
    usable = [one for one, moves in zip(usable, moving, strict=True) if moves]
    test = "poses against tracks"
    now = compare(tracks, usable)
    few, least = len(usable) < _PAIRS_NEEDED, np.median if doubted else np.min
    if few and not (len(usable) >= (1 if doubted else _FEW_PAIRS) and least(now.off) > _ABSURD_DEG):
        return _too_few(usable)
    rows = [now.row(test, "as given"), Row(test, "free", float(np.mean([one.share for one in usable])))]
    known = _by_known(tracks, usable, now, rows, doubted) if np.median(now.off) > DOUBTFUL_DEG else None
    if known is not None:
        return known
    if few:
        return _too_few(usable)
    return _by_turns(tracks, usable, now, rows) or _unnamed(tracks, usable, now, rows)


def _all_the_same(tracks: Tracks, usable: list[Relation]) -> Diagnosis | None:
    """Tell of positions or orientations that are not filled in; None if they change, or nothing else does."""
    turn_deg = [float(np.degrees(np.linalg.norm(geometry.so3_log(one.pose.rotation)))) for one in usable]
    turns = np.count_nonzero(np.array(turn_deg) > _DIFFERENT_DEG) >= _TURNS
    same = [
        (name, evidence)
        for name, evidence, values, moves in (
            ("position", "the camera moves", tracks.position, len(usable) > 0),
            ("orientation", f"it turns by {max(turn_deg, default=0.0):.0f} degrees", tracks.rotation, turns),
        )
        if moves and float(np.ptp(values, axis=0).max()) < _NO_CHANGE
    ]
    if not same:
        return None
    names, evidence = (" and ".join(part) for part in zip(*same, strict=True))
    verb = "are" if len(same) > 1 else "is"
    if len(tracks) < _STAND_STILL or len(usable) < 2 * _PAIRS_NEEDED or not agreed(usable):
        return Diagnosis(untold=[f"{names} of the poses {verb} the same in all keyframes"])
    cause = f"{names} of the poses {verb} not filled in: the same in all keyframes"
    return Diagnosis([Finding((cause,), f"by the tracks {evidence}", (f"the {names} in the keyframes",), usual=True)])


def _by_known(tracks: Tracks, usable: list[Relation], now: Steps, rows: list[Row], doubted: bool) -> Diagnosis | None:
    """Tell of mistakes that are made often, which bring steps nearer to the tracks; None if none does."""
    test, few = rows[0].test, len(usable) < _PAIRS_NEEDED
    tried: dict[Mistake | Flip, Steps] = {one: compare(one.undo(tracks, 0), usable) for one in in_motion(tracks)}
    tried |= {flip: compare(tracks, flipped(usable, flip)) for flip in _flips(tracks)}
    rows += [other.row(test, one.name) for one, other in tried.items()]
    best = min(float(np.median(other.off)) for other in tried.values())
    named = [one for one, it in tried.items() if np.median(it.off) <= 1.15 * best + 1.0 and now.loses_to(it)]
    most = np.median if doubted else np.max
    if not named or (few and max(float(most(tried[one].off)) for one in named) >= DOUBTFUL_DEG):
        return None
    if all(isinstance(one, Flip) for one in named):
        if len(usable) < 2 * _PAIRS_NEEDED:
            return None
        # On a way that is nearly straight cameras that are turned pass for mirrored images.
        turned = _turned(tracks, usable, now, rows)
        if turned is not None and np.median(compare(tracks, usable, _turn(tracks, usable)).off) < best:
            return turned
    evidence = f"as given the front-end's steps are {np.median(now.off):.0f} degrees off, {best:.0f} with that undone"
    # What leaves steps that point anywhere is a guess: images of another size may be behind it.
    found = finding(named, evidence)
    return Diagnosis([dataclasses.replace(found, usual=found.usual and best < _ABSURD_DEG)], rows=rows)


def _flips(tracks: Tracks) -> list[Flip]:
    """Return the exchanges in the images of all cameras that two cameras of a keyframe do not exclude."""
    both = of_cameras(tracks, 1) if len(tracks.cameras.model) > 1 else None
    if both is None:
        return list(FLIPS)
    given = tracks.between_cameras(0, 1)
    fits = two_view.share(both.pair, given)
    if fits < max(_FITS * both.share, AGREED):
        return list(FLIPS)
    pairs = {flip: flip.rays(both.pair) for flip in FLIPS}
    return [flip for flip, pair in pairs.items() if two_view.share(pair, given) >= _FITS * fits]


def _too_few(usable: list[Relation]) -> Diagnosis:
    return Diagnosis(untold=[f"too little parallax to compare poses with tracks ({len(usable)} pairs of keyframes)"])


def _by_turns(tracks: Tracks, usable: list[Relation], now: Steps, rows: list[Row]) -> Diagnosis | None:
    """Tell of mistakes that show where the camera turns; None if turns do not say so."""
    if np.count_nonzero(now.rotation > _DIFFERENT_DEG) < _TURNS:
        return None  # nothing can be so much nearer
    # A keyframe's step is a little thing: outliers tell it of turns too.
    lags = LAGS if agreed(usable) else ()
    tried: dict[Mistake | Flip, Steps] = {one: compare(one.undo(tracks, 0), usable) for one in lags}
    tried |= {flip: compare(tracks, flipped(usable, flip)) for flip in _flips(tracks)}
    off = {one: float(np.mean(it.rotation)) for one, it in tried.items() if now.turns_worse_than(it)}
    for one in in_motion(tracks):
        tried[one] = compare(one.undo(tracks, 0), usable)
        if now.turns_worse_than(tried[one]) and np.median(tried[one].off) < min(
            1.15 * np.median(now.off) + 1.0, DOUBTFUL_DEG
        ):
            off[one] = float(np.mean(tried[one].rotation))
    if not off:
        return None
    rows += [it.row(rows[0].test, one.name) for one, it in tried.items()]
    least = min(off.values())
    evidence = f"turns of the front-end are {np.mean(now.rotation):.1f} degrees off, {least:.1f} with that undone"
    named = [one for one, by in off.items() if by < _ALIKE * least]
    # Cameras that are a little off their places have directions off too, and turns about one axis pass for another's.
    turned = compare(tracks, usable, _turn(tracks, usable))
    if np.median(turned.off) < _BETTER * min(np.median(tried[one].off) for one in named):
        return None
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
    """Return the rotation of the cameras that brings the given steps nearest to those of the tracks (Kabsch).

    Of two images of a plane the tracks may tell the other relation: what is far off the rest counts little (Cauchy).
    """
    steps = [given.between_images(one.a, one.b) for one in relations]
    told = np.array([step.translation / np.linalg.norm(step.translation) for step in steps])
    seen = np.array([one.pose.translation for one in relations])
    turns = np.array(
        [
            (geometry.so3_log(one.pose.rotation), geometry.so3_log(step.rotation))
            for one, step in zip(relations, steps, strict=True)
        ]
    )
    weight, turn = np.ones(len(steps)), np.eye(3)
    for _ in range(_ROUNDS):
        total = _STAY * weight.sum() * np.eye(3) + (seen.T * weight) @ told + (turns[:, 0].T * weight) @ turns[:, 1]
        turn = geometry.nearest_rotation(total)
        off = np.linalg.norm(seen - told @ turn.T, axis=1) + np.linalg.norm(turns[:, 0] - turns[:, 1] @ turn.T, axis=1)
        weight = 1.0 / (1.0 + (off / max(float(np.median(off)), 1e-9)) ** 2)
    return turn
