# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare how the cameras stand to each other by their tracks with how they should by the rig.

The relation is estimated from the tracks alone. Only where the given one explains clearly fewer of them are the usual
mistakes tried, and the nearest is named.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import numpy as np

from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding, Row, angle
from ba_node.check.mistakes import BETWEEN_CAMERAS, FLIPS, Flip, Mistake, finding, images_of_one, swapped
from ba_node.check.motion import check_motion, compare, compare_steps, contradicts
from ba_node.check.relations import AGREED, Relation, in_motion, of_cameras, relate, shared_views, spread
from ba_node.check.tracks import Tracks
from ba_node.check.two_view import Pose
from ba_node.core import geometry

_ONE_ID = "track_id in the feature_tracks of camera {camera}: one id for one point, whichever camera sees it"
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
_ZOOMS, _CLOSER = (tuple(map(float, np.geomspace(1.0 / most, most, n))) for most, n in ((2.0, 41), (1.03, 9)))
# Another focal length explains so many times what the given one does.
_BETTER = 1.1
_INFO = "k in the camera_info of camera {camera}"
# Cameras of which all orders are tried.
_MOST_ORDERED = 4
_ORDER = "camera_index in the feature_tracks, or the order of the cameras in camera_rig"
# Pairs of keyframes that are needed to judge poses, and the share of them that must prefer another hypothesis.
_PAIRS_NEEDED = 5
_VOTES = 0.8
# Keyframes for which a camera has to be silent, and those just before and after that tell whose tracks go on.
_SILENT = 5
_NEXT = 3
# Two cameras that see so much of the same have tracks in common.
_SEE_THE_SAME = 0.5
# Outliers keep it from being measured unless the given relation explains less than this share of what the best does.
_CLEAR = 0.85


def check_cameras(tracks: Tracks, related: Callable[[], list[Relation]]) -> Diagnosis:
    """Compare the cameras of the rig with each other; ``related`` gives the relations in motion, should it matter."""
    outcome = Diagnosis()
    compared: dict[int, Diagnosis] = {}
    for camera in range(1, min(len(tracks.cameras.model), 1 + _MAX_CAMERAS)):
        relation = of_cameras(tracks, camera)
        if relation is None:
            if shared := shared_views(tracks, camera):
                outcome.untold.append(f"cameras 0 and {camera} share too few tracks ({shared})")
            elif len(tracks) >= _KEYFRAMES_TO_MEASURE and (overlap := _overlap(tracks, camera)) > _SEE_THE_SAME:
                outcome.add(_none_shared(tracks, camera, overlap, related()))
            continue
        found = _check_camera(tracks, camera, relation, related)
        if (best := max(row.share for row in found.rows)) < _CONTRADICT and _agree_alone(tracks, camera):
            found = Diagnosis([_ids_differ(camera, best)], rows=found.rows)
        unclear = relation.share < AGREED and found.rows[0].share > _CLEAR * relation.share
        why = "too many outliers" if unclear else "too few keyframes"
        if (len(tracks) < _KEYFRAMES_TO_MEASURE or unclear) and not found.usual:
            found = Diagnosis(untold=[f"{why} to measure how camera {camera} is off its place"], rows=found.rows)
        compared[camera] = found
    for found in _by_majority(tracks, _order(tracks, compared)).values():
        outcome.add(found)
    return outcome


def _by_majority(tracks: Tracks, compared: dict[int, Diagnosis]) -> dict[int, Diagnosis]:
    """Return what the comparisons of cameras with camera 0 tell together: it may be that which is wrong."""
    wrong = [camera for camera, one in compared.items() if one.harmful and not one.usual]
    zooms = {camera: zoom for camera in wrong if (zoom := _zoom_of(tracks, camera))}
    if not any(one.sound for one in compared.values()) and len(wrong) == 1 and zooms:
        ((camera, factor),) = zooms.items()
        (finding,) = compared[camera].findings
        cause = f"focal length of camera 0 off by a factor of about {1.0 / factor:.3g} against that of camera {camera}"
        changes = (*finding.changes, _INFO.format(camera=0))
        both = dataclasses.replace(finding, causes=(*finding.causes, cause), changes=changes)
        return compared | {camera: dataclasses.replace(compared[camera], findings=[both])}
    if len(wrong) < 2 or len(wrong) < len(compared):
        return compared
    relation, given = of_cameras(tracks, wrong[1], wrong[0]), tracks.between_cameras(*wrong[:2])
    if relation is None or two_view.share(relation.pair, given) < max(_FITS * relation.share, _CONTRADICT):
        return compared
    those = f"cameras {' and '.join(map(str, wrong[:2]))}"
    cause, change = "camera 0 does not fit its place on the body", "body_from_camera of camera 0 in camera_rig"
    if len(zooms) == len(wrong):
        factor = 1.0 / float(np.median(list(zooms.values())))
        cause, change = f"focal length of camera 0 off by a factor of about {factor:.3g}", _INFO.format(camera=0)
        cause += f" against those of {those}"
    evidence = f"{those} agree with each other, and neither with camera 0"
    first = Diagnosis(
        [Finding((cause,), evidence, (change,))], rows=[row for one in compared.values() for row in one.rows]
    )
    return {0: first}


def _order(tracks: Tracks, compared: dict[int, Diagnosis]) -> dict[int, Diagnosis]:
    """Return what is found with another order of three or four cameras named too, if that undoes what is wrong."""
    wrong = [camera for camera, one in compared.items() if one.harmful]
    if not wrong or not 3 <= len(tracks.cameras.model) <= _MOST_ORDERED:
        return compared
    relations = {camera: relation for camera in compared if (relation := of_cameras(tracks, camera)) is not None}
    every = itertools.permutations(range(len(tracks.cameras.model)))
    orders = [", ".join(map(str, order)) for order in every if _fit_in_order(tracks, relations, order)]
    if not orders:
        return compared
    cause = f"cameras in another order than in camera_rig: they sit where it says that {' or '.join(orders)} do"
    for camera in wrong:
        found = []
        for one in compared[camera].findings:
            # Of a known mistake either may be it; a camera that is somewhere else is explained by the order.
            causes, changes = (one.causes, one.changes) if one.usual else ((), ())
            found.append(dataclasses.replace(one, causes=(cause, *causes), changes=(_ORDER, *changes), usual=True))
        compared = compared | {camera: dataclasses.replace(compared[camera], findings=found)}
    return compared


def _fit_in_order(tracks: Tracks, relations: dict[int, Relation], order: Sequence[int]) -> bool:
    """Return True if cameras fit where an order says that they sit, with the intrinsics given or those of there."""
    rig, rows = tracks.cameras, list(order)
    placed = dataclasses.replace(rig, rotation=rig.rotation[rows], translation=rig.translation[rows])
    for other in (dataclasses.replace(tracks, cameras=placed), swapped(tracks, order)):
        seen = {camera: one.seen_by(other) for camera, one in relations.items()}
        if all(
            it is not None
            and two_view.share(it.pair, other.between_cameras(0, camera)) >= _NAMED * relations[camera].share
            for camera, it in seen.items()
        ):
            return True
    return False


def _zoom_of(tracks: Tracks, camera: int) -> float:
    """Return the factor by which the focal length of a camera is off that of camera 0; 0 if it is not."""
    relation, given = of_cameras(tracks, camera), tracks.between_cameras(0, camera)
    return 0.0 if relation is None else _zoom(relation, given, two_view.share(relation.pair, given))[0]


def _zoom(relation: Relation, given: Pose, share: float) -> tuple[float, float]:
    """Return the factor of the focal length of b with which the given pose explains the rays, and their share; or 0."""
    best, tried = 1.0, _ZOOMS
    for _ in range(2):
        shares = {factor: two_view.share(relation.pair.zoomed(factor), given) for factor in tried}
        best = max(shares, key=lambda one: shares[one])
        tried = tuple(float(best * factor) for factor in _CLOSER)
    explains = shares[best] >= max(_NAMED * relation.share, _BETTER * share)
    return (best, shares[best]) if explains else (0.0, 0.0)


def check_silent(tracks: Tracks) -> Diagnosis:
    """Look whether the tracks of a camera that fell silent go on under the index of another one."""
    outcome, n_cam = Diagnosis(), len(tracks.cameras.model)
    for camera in range(min(n_cam, 1 + _MAX_CAMERAS)):
        seen = [k for k, of in tracks.images if of == camera]
        since = max(seen, default=len(tracks)) + 1
        if len(seen) < _SILENT or since > len(tracks) - _SILENT:
            continue
        for other in range(min(n_cam, 1 + _MAX_CAMERAS)):
            pairs = [
                ((k, other), (after, other))
                for k in range(since - _NEXT, since)
                for after in range(since, since + _NEXT)
            ]
            matches = [(a, b, rows) for a, b in pairs if len((rows := tracks.match(a, b))[0]) >= two_view.MIN_PAIRS]
            related = [one for match in matches if (one := relate(tracks, *match)) is not None and one.has_direction]
            if other == camera or len(related) < _PAIRS_NEEDED:
                continue
            given = compare(tracks, related)
            meant = compare_steps([tracks.between_images(one.a, (one.b[0], camera)) for one in related], related)
            if given.loses_to(meant):
                cause = f"tracks of camera {camera} come as those of camera {other}"
                cause += f" from stamp {tracks.stamp_ns[since] * 1e-9:.3f} s on"
                evidence = (
                    f"steps are {np.median(given.off):.0f} degrees off, {np.median(meant.off):.0f} with that undone"
                )
                outcome.add(
                    Diagnosis([Finding((cause,), evidence, ("camera_index in the feature_tracks",), usual=True)])
                )
    return outcome


def _check_camera(tracks: Tracks, camera: int, relation: Relation, related: Callable[[], list[Relation]]) -> Diagnosis:
    test, now = f"camera {camera} against camera 0", tracks.between_cameras(0, camera)
    rows = [_row(test, "as given", relation, now), _row(test, "free", relation, relation.pose)]
    if not np.linalg.norm(now.translation) > 0.0:
        return _same_place(camera, relation, rows)
    fits = Diagnosis(sound=[f"camera {camera} is where the rig says"], rows=rows)
    # Nothing that is estimated explains images of another kind, as mirrored ones, any better.
    as_good = rows[0].share >= max(_FITS * rows[1].share, _CONTRADICT)
    if as_good and rows[0].share >= AGREED:
        return fits
    others: dict[Mistake | Flip, Pose] = {
        one: one.undo(tracks, camera).between_cameras(0, camera) for one in BETWEEN_CAMERAS
    }
    # Where points are far, consensus finds one of many relations; a usual mistake may be the way to a better one.
    near = (relation.at(two_view.refined(relation.pair, pose)) for pose in others.values())
    relation = max((relation, *near), key=lambda one: one.share)
    rows = [_row(test, "as given", relation, now), _row(test, "free", relation, relation.pose)]
    if relation.share < _CONTRADICT:
        return Diagnosis(untold=[f"the tracks of cameras 0 and {camera} contradict each other"], rows=rows)
    tried: dict[Mistake | Flip, Row] = {
        one: _row(test, one.name.format(camera=camera), relation, pose) for one, pose in others.items()
    }
    for flip in FLIPS:
        seen = of_cameras(flip.undo(tracks), camera)
        if seen is not None and not contradicts(tracks, related(), flip):
            tried[flip] = _row(test, flip.name, seen, now)
    for alone in images_of_one(tracks, camera):
        undone = alone.undo(tracks, camera)
        seen = relation.seen_by(undone)
        if seen is not None:
            tried[alone] = _row(test, alone.name.format(camera=camera), seen, undone.between_cameras(0, camera))
    rows += tried.values()
    best = max(one.share for one in tried.values())
    if as_good and rows[0].share >= _FITS * best:
        return fits
    named = [
        mistake
        for mistake, one in tried.items()
        if one.share >= max(0.97 * best, _NAMED * rows[1].share)
        and one.rotation_deg < _TURNED_DEG
        and not one.direction_deg > rows[0].direction_deg
        and (mistake not in others or _differ(now, others[mistake]))
    ]
    if not named:
        return _misfit(camera, relation, now, rows)
    evidence = (
        f"of the tracks of cameras 0 and {camera}, {rows[0].share:.0%} meet in front as given,"
        f" {best:.0%} with that undone"
    )
    return Diagnosis([finding(named, evidence, camera)], rows=rows)


def _row(test: str, name: str, relation: Relation, pose: Pose) -> Row:
    """Return how well a pose explains the rays of a relation, and how far it is off that."""
    off = pose.direction_from(relation.pose) if relation.has_direction else float("nan")
    return Row(test, name, two_view.share(relation.pair, pose), pose.turned_from(relation.pose), off)


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
    return Finding((cause,), evidence, (_ONE_ID.format(camera=camera),), usual=True)


def _overlap(tracks: Tracks, camera: int) -> float:
    """Return which share of what camera 0 sees another one that has tracks of the same keyframes sees too, far away."""
    both = [k for k in spread(len(tracks), _PAIRS_NEEDED) if {(k, 0), (k, camera)} <= tracks.images.keys()]
    if len(both) < _PAIRS_NEEDED:
        return 0.0
    own, other = (tracks.ray[np.concatenate([tracks.images[k, one] for k in both])] for one in (0, camera))
    there = np.append(own, np.ones((len(own), 1)), axis=1) @ tracks.between_cameras(0, camera).rotation.T
    low, high = np.percentile(other, (2.0, 98.0), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = there[:, :2] / there[:, 2:]
    return float(np.mean((there[:, 2] > 0.0) & (seen > low).all(axis=1) & (seen < high).all(axis=1)))


def _none_shared(tracks: Tracks, camera: int, overlap: float, relations: list[Relation]) -> Diagnosis:
    """Tell of two cameras that are tracked one by one, which is a mistake only where no steps tell the scale."""
    text = f"cameras 0 and {camera} share no track, though they look at the same: each counts as one camera alone"
    if all(check_motion(tracks, one).sound for one in (relations, in_motion(tracks, camera))):
        return Diagnosis(sound=[f"{text}, whose steps fit"], notices=["no_shared_track"])
    if sum(one.has_direction for one in relations) < _PAIRS_NEEDED:
        return Diagnosis(untold=[f"{text}, with too little parallax to tell whether its steps fit"])
    evidence = f"camera {camera} sees {overlap:.0%} of what camera 0 sees, and the front-end's steps do not fit"
    change = _ONE_ID.format(camera=camera)
    return Diagnosis([Finding((text,), evidence, (change,), harmful=False, usual=True)])


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


def _misfit(camera: int, relation: Relation, given: Pose, rows: list[Row]) -> Diagnosis:
    """Tell of a camera that is a little off its place, or whose own intrinsics are wrong: the rig fits with others."""
    row, other = rows[0], Diagnosis(rows=rows)
    change = f"body_from_camera of camera {camera} in camera_rig (or tf_static)"
    info = _INFO.format(camera=camera)
    factor, share = _zoom(relation, given, row.share)
    if factor:
        cause = f"focal length of camera {camera} off by a factor of about {factor:.3g} against that of camera 0"
        rows.append(Row(row.test, cause, share))
        other.findings.append(Finding((cause,), f"{row.share:.0%} of the tracks meet as given", (info,)))
        return other
    # A rotation alone is measured far better than together with the direction of the baseline.
    turned = two_view.refined(relation.pair, given, free=3)
    relation = relation if two_view.share(relation.pair, turned) < _NAMED * relation.share else relation.at(turned)
    row = dataclasses.replace(row, rotation_deg=given.turned_from(relation.pose))
    what = f"by about {angle(row.rotation_deg)}"
    if row.rotation_deg < _MISFIT_DEG:
        by = f", by about {row.direction_deg:.0f} degrees" if np.isfinite(row.direction_deg) else ""
        what = f"in the direction from camera 0{by}"
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
