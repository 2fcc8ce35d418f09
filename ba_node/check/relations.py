# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare relative poses of images by their tracks with those by the rig and the poses.

First the relation is estimated from the tracks alone. Only where the given one explains clearly fewer of them are the
usual mistakes tried, and the nearest is named.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding, Row, angle
from ba_node.check.placement import BETWEEN_CAMERAS, IN_MOTION, Mistake, SetUp, as_given
from ba_node.check.tracks import Image, Tracks
from ba_node.check.two_view import MIN_PAIRS, Pair, Pose
from ba_node.core import geometry

# Keyframes that are looked at, and rays of two cameras.
_KEYFRAMES = 20
_MAX_RAYS = 800
# Keyframes from which on it is measured by how much a camera is off.
_KEYFRAMES_TO_MEASURE = 10
# Cameras beyond the first that are tested.
_MAX_CAMERAS = 8
# The given relation fits if it explains this share of what the best does.
_FITS = 0.9
# Where the best relation explains less than this, the tracks of two images contradict each other.
_CONTRADICT = 0.2
# Another relation is named if it explains this share.
_NAMED = 0.95
# Angles below which nothing is named, whatever the residuals: calibration is no better.
_MISFIT_DEG = 0.25
# A relation that is turned further against the estimate does not explain it.
_TURNED_DEG = 0.5
# A usual mistake is not one of a few degrees.
_SAME_DEG = 10.0
# Factors by which the focal length of one camera may be wrong.
_ZOOMS = tuple(float(factor) for factor in np.geomspace(0.5, 2.0, 41))
# Keyframes between the images of one camera that are tried, widest first.
_GAPS = (8, 5, 3, 2, 1)
# Pairs of keyframes that are needed to judge poses, and the share of them that must prefer another hypothesis.
_PAIRS_NEEDED = 5
_VOTES = 0.8
# Usual angle beyond which poses are said to be wrong where a known mistake explains them, and where none does.
_DOUBTFUL_DEG = 15.0
_ABSURD_DEG = 50.0
# Angle by which cameras must be turned for all steps to point where the front-end's do.
_BESIDE_DEG = 5.0
# A hypothesis takes the place of what was given if it halves the angle.
_BETTER = 0.5
# Share of the tracks of two images that must agree with their best relation; where fewer do, outliers pull at whatever
# is estimated, and nothing but the usual mistakes of placement is told.
AGREED = 0.7
# ... unless the given relation of two cameras explains less than this share of what the best does.
_CLEAR = 0.5


@dataclass(frozen=True)
class Relation:
    """Two images, the rays they share, and their relation by the tracks."""

    a: Image  # image (keyframe, camera)
    b: Image  # image
    rows_a: IntArray  # (n,) rows of the tracks
    rows_b: IntArray  # (n,)
    pair: Pair  # the rays
    pose: Pose  # b from a, direction of the translation only
    share: float  # of the rays that agree with it
    parallax: float  # usual parallax of these, in units of the gate

    def at(self, pose: Pose) -> Relation:
        """Return the same with another pose."""
        return dataclasses.replace(self, pose=pose, share=two_view.share(self.pair, pose))

    @property
    def has_direction(self) -> bool:
        """Return True if there is parallax enough to tell where the translation points."""
        return self.parallax > 2.0


def relate(tracks: Tracks, a: Image, b: Image, rows: tuple[IntArray, IntArray]) -> Relation | None:
    """Return the relation of two images (of two cameras: of all keyframes that the rows are of)."""
    pair = rays(tracks, rows)
    pose = two_view.estimate(pair)
    if pose is None:
        return None
    good = two_view.explained(pair, pose)
    parallax = float(np.median(two_view.depths(pair, pose)[2][good]) / pair.gate)
    return Relation(a, b, *rows, pair, pose, float(good.mean()), parallax)


def rays(tracks: Tracks, rows: tuple[IntArray, IntArray]) -> Pair:
    """Return the rays of some matches; the gate is three sigma, but one pixel at least."""
    gate = max(max(tracks.px(part), 3.0 * tracks.sigma(part)) for part in rows)
    return Pair(tracks.ray[rows[0]], tracks.ray[rows[1]], gate)


def of_cameras(tracks: Tracks, camera: int) -> Relation | None:
    """Return how a camera stands to camera 0 by what both see in the same keyframes."""
    found = [tracks.match((k, 0), (k, camera)) for k in spread(len(tracks), _KEYFRAMES)]
    rows_a, rows_b = (np.concatenate(part) for part in zip(*found, strict=True))
    pick = spread(len(rows_a), _MAX_RAYS)
    return relate(tracks, (-1, 0), (-1, camera), (rows_a[pick], rows_b[pick]))


def in_motion(tracks: Tracks) -> list[Relation]:
    """Return how images of one camera stand to each other, over the recording."""
    main = [tracks.main_camera(k) for k in range(len(tracks))]
    found = []
    for k in spread(len(tracks) - 1, _KEYFRAMES):
        camera = main[k]
        if camera is None:
            continue
        own = len(tracks.images[k, camera])
        for gap in _GAPS:
            other = main[k + gap] if k + gap < len(tracks) else None
            if other is None:
                continue
            rows = tracks.match((k, camera), (k + gap, other))
            if len(rows[0]) >= max(MIN_PAIRS, (0.5 if gap > 1 else 0.1) * own):
                relation = relate(tracks, (int(k), camera), (int(k + gap), other), rows)
                found += [relation] if relation is not None and relation.share > 0.3 else []
                break
    return found


def median_share(relations: list[Relation]) -> float:
    """Return the usual share of the tracks that agree with what is best for two images; 1 if there are none."""
    return float(np.median([one.share for one in relations])) if relations else 1.0


def agreed(relations: list[Relation]) -> bool:
    """Return True if so many tracks agree that little things can be told."""
    return median_share(relations) >= AGREED


def spread(count: int, wanted: int) -> IntArray:
    """Return at most so many indices of a row of things, evenly spread."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, wanted)).astype(np.intp)) if count > 0 else np.empty(0, np.intp)
    )


def check_cameras(tracks: Tracks) -> Diagnosis:
    """Compare the cameras of the rig with each other."""
    outcome, given = Diagnosis(), as_given(tracks)
    for camera in range(1, min(len(given.cameras.rotation), 1 + _MAX_CAMERAS)):
        relation = of_cameras(tracks, camera)
        if relation is None:
            shared = sum(len(tracks.match((k, 0), (k, camera))[0]) for k in spread(len(tracks), _KEYFRAMES))
            if shared:
                outcome.untold.append(f"cameras 0 and {camera} share too few tracks ({shared})")
            continue
        found = _check_camera(given, camera, relation)
        if (best := max(row.share for row in found.rows)) < _CONTRADICT and _agree_alone(tracks, camera):
            found = Diagnosis([_ids_differ(camera, best)], rows=found.rows)
        unclear = relation.share < AGREED and found.rows[0].share > _CLEAR * relation.share
        why = "too many outliers" if unclear else "too few keyframes"
        if (len(tracks) < _KEYFRAMES_TO_MEASURE or unclear) and not found.usual:
            found = Diagnosis(untold=[f"{why} to measure how camera {camera} is off its place"], rows=found.rows)
        outcome.add(found)
    return outcome


def _check_camera(given: SetUp, camera: int, relation: Relation) -> Diagnosis:
    test, pair = f"camera {camera} against camera 0", relation.pair

    def row(name: str, pose: Pose) -> Row:
        off = pose.direction_from(relation.pose) if relation.has_direction else float("nan")
        return Row(test, name, two_view.share(pair, pose), pose.turned_from(relation.pose), off)

    now = given.between_cameras(0, camera)
    rows = [row("as given", now), row("free", relation.pose)]
    if not np.linalg.norm(now.translation) > 0.0:
        return _same_place(camera, relation, rows)
    if rows[0].share >= max(_FITS * rows[1].share, _CONTRADICT):
        return Diagnosis(sound=[f"camera {camera} is where the rig says"], rows=rows)
    others = {one: one.undo(given, camera).between_cameras(0, camera) for one in BETWEEN_CAMERAS}
    # Where points are far, consensus finds one of many relations; a usual mistake may be the way to a better one.
    relation = max(
        (relation, *(relation.at(two_view.refined(pair, pose)) for pose in others.values())), key=lambda one: one.share
    )
    rows = [row("as given", now), row("free", relation.pose)]
    if relation.share < _CONTRADICT:
        return Diagnosis(untold=[f"the tracks of cameras 0 and {camera} contradict each other"], rows=rows)
    tried = {one: row(one.name.format(camera=camera), pose) for one, pose in others.items()}
    rows += tried.values()
    best = max(one.share for one in tried.values())
    named = [
        mistake
        for mistake, one in tried.items()
        if one.share >= max(0.97 * best, _NAMED * rows[1].share)
        and one.rotation_deg < _TURNED_DEG
        and not one.direction_deg > rows[0].direction_deg
        and _differ(now, others[mistake])
    ]
    if not named:
        return _misfit(camera, relation, now, rows)
    evidence = (
        f"of the tracks of cameras 0 and {camera}, {rows[0].share:.0%} meet in front as given,"
        f" {best:.0%} with that undone"
    )
    return Diagnosis([_finding(named, evidence, camera)], rows=rows)


def _agree_alone(tracks: Tracks, camera: int) -> bool:
    """Return True if the tracks of each of two cameras agree with those of its next images."""
    found = []
    for own in (0, camera):
        for k in spread(len(tracks) - 1, _PAIRS_NEEDED):
            a, b = (int(k), own), (int(k) + 1, own)
            found.append(relate(tracks, a, b, tracks.match(a, b)))
    return len(found) >= 2 * _PAIRS_NEEDED and all(one is not None and one.share > AGREED for one in found)


def _ids_differ(camera: int, share: float) -> Finding:
    cause = f"track ids of cameras 0 and {camera} do not name the same points"
    evidence = f"{share:.0%} of those that both see agree, although the tracks of each camera alone do"
    change = f"track_id in the feature_tracks of camera {camera}: one id for one point, whichever camera sees it"
    return Finding((cause,), evidence, (change,), usual=True)


def _same_place(camera: int, relation: Relation, rows: list[Row]) -> Diagnosis:
    """Tell of two cameras that are given at one place; where points are far that may be as well."""
    if not relation.has_direction or rows[1].share < AGREED:
        return Diagnosis(
            untold=[f"too little parallax between cameras 0 and {camera} to tell how they stand"], rows=rows
        )
    cause = f"baseline of camera {camera} missing: it is given at the same place as camera 0"
    evidence = f"{rows[1].share:.0%} of the tracks of cameras 0 and {camera} meet if they are apart"
    change = f"the position in body_from_camera of camera {camera} in camera_rig (or tf_static)"
    return Diagnosis([Finding((cause,), evidence, (change,), usual=True)], rows=rows)


def _differ(one: Pose, other: Pose) -> bool:
    """Return True if two poses are so far apart that the one cannot stand for a small error in the other."""
    return max(one.turned_from(other), float(np.nan_to_num(one.direction_from(other)))) > _SAME_DEG


def _finding(mistakes: list[Mistake], evidence: str, camera: int = 0) -> Finding:
    causes = tuple(one.name.format(camera=camera) for one in mistakes)
    return Finding(causes, evidence, tuple(one.change.format(camera=camera) for one in mistakes), usual=True)


def _misfit(camera: int, relation: Relation, given: Pose, rows: list[Row]) -> Diagnosis:
    """Tell of a camera that is a little off its place, or whose own intrinsics are wrong: the rig fits with others."""
    row, other = rows[0], Diagnosis(rows=rows)
    change = f"body_from_camera of camera {camera} in camera_rig (or tf_static)"
    info = f"k in the camera_info of camera {camera}"
    tried = {factor: two_view.share(relation.pair.zoomed(factor), given) for factor in _ZOOMS}
    factor = max(tried, key=lambda one: tried[one])
    if tried[factor] >= max(_NAMED * relation.share, 1.1 * row.share):
        cause = f"focal length of camera {camera} off by a factor of about {factor:.2g} against that of camera 0"
        rows.append(Row(row.test, cause, tried[factor]))
        other.findings.append(Finding((cause,), f"{row.share:.0%} of the tracks meet as given", (info,)))
        return other
    # A rotation alone is measured far better than together with the direction of the baseline.
    turned = two_view.refined(relation.pair, given, free=3)
    relation = relation if two_view.share(relation.pair, turned) < _NAMED * relation.share else relation.at(turned)
    row = dataclasses.replace(row, rotation_deg=given.turned_from(relation.pose))
    what = f"by about {angle(row.rotation_deg)}"
    if row.rotation_deg < _MISFIT_DEG:
        what = f"in the direction from camera 0, by about {row.direction_deg:.0f} degrees"
    causes, changes = [f"camera {camera} does not fit its place on the body {what}"], [change]
    turn = geometry.so3_log(relation.pose.rotation @ given.rotation.T)
    shifted = relation.pair.shifted(np.array([turn[1], -turn[0]]))
    if two_view.share(shifted, given) >= _NAMED * relation.share:
        causes.append(f"principal point of camera {camera} off by as much")
        changes.append(info)
    evidence = (
        f"of the tracks of cameras 0 and {camera}, {row.share:.0%} meet as given,"
        f" {relation.share:.0%} where they see it"
    )
    other.findings.append(Finding(tuple(causes), evidence, tuple(changes)))
    return other


def check_motion(tracks: Tracks, relations: list[Relation]) -> Diagnosis:
    """Compare the front-end's steps with those of a camera."""
    given = as_given(tracks)
    usable = [one for one in relations if one.has_direction]
    before = compare(given, usable)
    moving = before.length > 0.1 * np.median(before.length) if usable else np.zeros(0, bool)
    usable = [one for one, moves in zip(usable, moving, strict=True) if moves]
    if len(usable) < _PAIRS_NEEDED:
        return Diagnosis(
            untold=[f"too little parallax to compare poses with tracks ({len(usable)} pairs of keyframes)"]
        )
    test = "poses against tracks"
    now = compare(given, usable)
    rows = [now.row(test, "as given"), Row(test, "free", float(np.mean([one.share for one in usable])))]
    tell = f"the poses fit the tracks (directions to {np.median(now.direction):.1f} degrees)"
    if np.median(now.off) <= _DOUBTFUL_DEG:
        return _turned(given, usable, now, rows) or Diagnosis(sound=[tell], rows=rows)
    tried = {one: compare(one.undo(given, 0), usable) for one in IN_MOTION}
    rows += [other.row(test, one.name) for one, other in tried.items()]
    best = min(float(np.median(other.off)) for other in tried.values())
    named = [one for one, it in tried.items() if np.median(it.off) <= 1.15 * best + 1.0 and now.loses_to(it)]
    if named:
        evidence = (
            f"as given the front-end's steps are {np.median(now.off):.0f} degrees off, {best:.0f} with that undone"
        )
        return Diagnosis([_finding(named, evidence)], rows=rows)
    if not agreed(usable):
        return Diagnosis(untold=["too many outliers to tell how the poses are off the tracks"], rows=rows)
    return _unnamed(given, usable, now, rows, tell)


def _unnamed(given: SetUp, usable: list[Relation], now: Steps, rows: list[Row], tell: str) -> Diagnosis:
    """Tell of a camera that is turned against the body, or of poses that contradict the tracks."""
    turned = _turned(given, usable, now, rows)
    if turned is not None:
        return turned
    if len(usable) >= 2 * _PAIRS_NEEDED and np.median(now.direction) > _ABSURD_DEG:
        evidence = f"the steps of the camera are {np.median(now.direction):.0f} degrees off the front-end's"
        return Diagnosis(
            [Finding(("the poses contradict the tracks",), evidence, ("the pose in the keyframes",))], rows=rows
        )
    return Diagnosis(sound=[tell], rows=rows)


def _turned(given: SetUp, usable: list[Relation], now: Steps, rows: list[Row]) -> Diagnosis | None:
    """Tell of a camera that is turned against the body, or its principal point off; None if steps do not say so."""
    turn = _turn(given, usable)
    degrees = float(np.degrees(np.linalg.norm(geometry.so3_log(turn))))
    turned = compare(given, usable, turn)
    least = _BESIDE_DEG if agreed(usable) else _DOUBTFUL_DEG
    if len(usable) < 2 * _PAIRS_NEEDED or degrees < least or not now.loses_to(turned):
        return None
    rows.append(turned.row(rows[0].test, f"cameras turned by {degrees:.0f} degrees"))
    cause = f"camera 0 does not fit its place on the body by about {degrees:.0f} degrees"
    evidence = f"its steps are {np.median(now.off):.0f} degrees off the front-end's, turned {np.median(turned.off):.0f}"
    change = "body_from_camera in camera_rig (or tf_static), or the principal point in camera_info (region of interest)"
    return Diagnosis([Finding((cause,), evidence, (change,))], rows=rows)


@dataclass(frozen=True)
class Steps:
    """How far a set-up is off the tracks, a row a pair of images: degrees; length of its steps; share explained."""

    rotation: FloatArray
    direction: FloatArray
    length: FloatArray
    share: FloatArray

    @property
    def off(self) -> FloatArray:
        """Return one angle for both: a rotation is known better than a direction."""
        return np.asarray(np.nan_to_num(self.direction, nan=90.0) + 2.0 * self.rotation)

    def loses_to(self, other: Steps) -> bool:
        """Return True if another set-up is clearly nearer to the tracks."""
        prefers = np.mean(other.off < self.off)
        return bool(np.median(other.off) < _BETTER * np.median(self.off) and prefers >= _VOTES)

    def row(self, test: str, name: str) -> Row:
        """Return it for the table."""
        return Row(
            test, name, float(np.mean(self.share)), float(np.median(self.rotation)), float(np.median(self.direction))
        )


def compare(given: SetUp, relations: list[Relation], turn: FloatArray | None = None) -> Steps:
    """Return how far a set-up is off the tracks, with its cameras turned by a rotation (3, 3) if there is one."""
    rows = []
    for one in relations:
        step = given.between_images(one.a, one.b)
        if turn is not None:
            step = Pose(turn @ step.rotation @ turn.T, turn @ step.translation)
        off = step.direction_from(one.pose)
        rows.append((step.turned_from(one.pose), off, np.linalg.norm(step.translation), two_view.share(one.pair, step)))
    return Steps(*np.array(rows).reshape(-1, 4).T)


def _turn(given: SetUp, relations: list[Relation]) -> FloatArray:
    """Return the rotation of the cameras that brings the given steps nearest to those of the tracks (Kabsch)."""
    total = 0.1 * len(relations) * np.eye(3)
    for one in relations:
        step = given.between_images(one.a, one.b)
        length = np.linalg.norm(step.translation)
        total += np.outer(one.pose.translation, step.translation / length)
        total += np.outer(geometry.so3_log(one.pose.rotation), geometry.so3_log(step.rotation))
    return geometry.nearest_rotation(total)
