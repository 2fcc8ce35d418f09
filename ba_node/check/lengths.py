# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare lengths by measured depths, by two cameras and by the front-end's steps, and say which of them is off.

Two that differ do not tell which is wrong. A third does, or a size that no depth and no speed has; else both are named.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding, Row, angle
from ba_node.check.relations import Relation, agreed, rays, spread
from ba_node.check.tracks import Tracks
from ba_node.check.two_view import Pose
from ba_node.check.units import FASTEST, POSITIONS, speed_of
from ba_node.core.loss import NORMAL
from ba_node.core.units import unit_of

# Parallax, in gates, from which on a triangulated depth is worth something; points and pairs that are needed.
_PARALLAX = 4.0
_POINTS = 8
_PAIRS = 4
_MANY_PAIRS = 20
# Factors of a depth and of a length beyond which they are wrong, however few pairs of images tell.
_DEPTH_FACTOR = 1.5
_LENGTH_FACTOR = 1.3
# Many pairs tell it beyond a smaller factor, where it is so many standard errors from 1: lengths that are wrong by that
# much bend the whole way, and the steps of a robot that moves are known better.
_SMALL_FACTOR = 1.06
_STANDARD_ERRORS = 4.0
# Factors beyond which they are wrong whatever the share of outliers.
_GROSS = 5.0
# A factor is named if depths agree on it to this share (median deviation of its logarithm).
_AGREE = 0.35
# Points agree on a factor to this part of it: 0.04 where the unit is another, 0.3 where many move along with a camera.
_ALIKE = 0.15
# A shift of all disparities is named unless a factor of all depths leaves so many times less spread, and goes first.
_CLEARLY = 3.0
# A factor is named unless a shift leaves so much less.
_SURELY = 0.7
# Usual depths that are sensible, m; keyframes in which two cameras are asked for depths, and how nearly they have to
# agree with one of two that differ, in shares of the logarithm of their factor.
_DEPTHS_M, _COMPARED, _NEARER = (0.05, 200.0), 20, 0.25
# Smaller shifts of all disparities are not named, px.
_LEAST_SHIFT_PX = 0.5
# Depths of other points follow those by steps to less than this part, where these spread by so many times their error.
_FOLLOW, _TOLD, _MANY_POINTS = 0.4, 1.0, 200
# What is laid to another kind of depth spreads by more than this.
_LEAST_SPREAD = 0.03
_ORDER = "camera_index in the feature_tracks, or the order of the cameras in camera_rig"
# Keyframes that are needed to judge lengths.
_KEYFRAMES = 10


def check_depth(tracks: Tracks, relations: list[Relation]) -> Diagnosis:
    """Compare measured depths with those of the front-end's steps, or of two cameras."""
    measured = np.isfinite(tracks.depth_m)
    if not measured.any():
        return Diagnosis()
    by = "the front-end's steps"
    pairs = _depth_pairs(tracks, relations, tracks.depth_m)
    if len(pairs) < _PAIRS and not (pairs and _make_no_sense(tracks, pairs)):
        few = _of_few_points(tracks, relations)
        return few or Diagnosis(untold=["too little parallax to compare depths with steps"])
    ratio = [float(np.median(np.log(given / found))) for given, found in pairs]
    factor, scatter = float(np.exp(np.median(ratio))), _deviation(ratio)
    rows = [Row("depth", f"measured over triangulated: {factor:.4g}", 1.0)]
    given, found = (np.concatenate(part) for part in zip(*pairs, strict=True))
    many_outliers = not agreed(relations)
    if not many_outliers and _deviation(np.log(given * found)) < 0.5 * _deviation(np.log(given / found)):
        inverse = float(np.exp(np.median(np.log(given * found))))
        cause = f"depth_m holds inverse depths: it falls as depth grows (their product is {inverse:.3g})"
        return Diagnosis([_depth_finding(cause, f"against {by}")], rows=rows)
    along = None if many_outliers else _along_rays(tracks, relations, pairs)
    if along is not None:
        return Diagnosis([_or_intrinsics(_depth_finding(along, f"against {by}"))], rows=rows)
    other = None if many_outliers else _of_other_points(relations, pairs)
    if other is not None:
        return Diagnosis([_depth_finding(other, f"against {by}")], rows=rows)
    if scatter > _AGREE:
        return Diagnosis(untold=[f"depths contradict {by}"], rows=rows)
    if _alike(ratio, _DEPTH_FACTOR):
        return Diagnosis(sound=[f"depths fit {by} (to {abs(factor - 1.0):.0%})"], rows=rows)
    if many_outliers and 1.0 / _GROSS < factor < _GROSS:
        return Diagnosis(untold=["too many outliers to compare depths with steps"], rows=rows)
    inner = float(np.median([_deviation(np.log(given / found)) for given, found in pairs]))
    small, moderate = (1.0 / most < factor < most for most in (_DEPTH_FACTOR, _GROSS))
    if moderate and not small and inner > _ALIKE * abs(np.log(factor)):
        return Diagnosis(untold=[f"depths contradict {by}, each by another factor: much may move"], rows=rows)
    return Diagnosis([_depth_or_steps(tracks, factor, f"over {len(pairs)} pairs of keyframes")], rows=rows)


def _of_few_points(tracks: Tracks, relations: list[Relation]) -> Diagnosis | None:
    """Return what is wrong where few points have a depth, as most are out of reach, and all are off by far alike."""
    pairs = _depth_pairs(tracks, relations, tracks.depth_m, least=1)
    if len(pairs) < _PAIRS:
        return None
    off = np.concatenate([np.log(given / found) for given, found in pairs])
    factor = float(np.exp(np.median(off)))
    if len(off) < _POINTS or 1.0 / _GROSS < factor < _GROSS or _deviation(off) > _AGREE:
        return None
    rows = [Row("depth", f"measured over triangulated: {factor:.4g}", 1.0)]
    return Diagnosis([_depth_or_steps(tracks, factor, f"over {len(off)} points")], rows=rows)


def _make_no_sense(tracks: Tracks, pairs: list[tuple[FloatArray, FloatArray]]) -> bool:
    """Return True if depths are of a size that none are, and all pairs of images, however few, have others by far."""
    off = [np.log(given / found) for given, found in pairs]
    absurd = all(abs(np.median(one)) > np.log(_GROSS) and _deviation(one) < _AGREE for one in off)
    return absurd and _by_sense(tracks) == "depth"


def _of_other_points(relations: list[Relation], pairs: list[tuple[FloatArray, FloatArray]]) -> str | None:
    """Return in words that depths do not follow those by steps within the images; None if they do, or it is not known.

    Of independent logarithms a and b the differences have the variance of both; of equal ones but for noise of a none
    of that of b. How precisely b is known is told by its parallax.
    """
    given, found = (
        np.concatenate([np.log(of) - np.median(np.log(of)) for of in part]) for part in zip(*pairs, strict=True)
    )
    across = [(one.pair.gate, two_view.depths(one.pair, one.pose)[2]) for one in relations if one.has_direction]
    error = np.median(np.concatenate([gate / parallax[parallax > _PARALLAX * gate] for gate, parallax in across]))
    a, b, off = (_deviation(part) ** 2 for part in (given, found, given - found))
    follows = (a + b - off) / max(2.0 * b, 1e-12)
    if len(given) < _MANY_POINTS or np.sqrt(b) < _TOLD * error or follows > _FOLLOW:
        return None
    return "depth_m is of other points: of another image (delayed, in another order), or not registered to the camera"


def _along_rays(tracks: Tracks, relations: list[Relation], pairs: list[tuple[FloatArray, FloatArray]]) -> str | None:
    """Return in words that depths are distances from the camera, if they are."""
    undone = _depth_pairs(tracks, relations, tracks.depth_m / np.sqrt(1.0 + (tracks.ray**2).sum(axis=1)))
    if len(undone) < _PAIRS:
        return None
    before, after = (np.concatenate([np.log(one / other) for one, other in part]) for part in (pairs, undone))
    much, factor = _deviation(before), float(np.exp(np.median(after)))
    if much < _LEAST_SPREAD or _deviation(after) > _SURELY * much or not 1.0 / _DEPTH_FACTOR < factor < _DEPTH_FACTOR:
        return None
    return (
        f"depth_m is the distance from the camera along the ray: it grows towards the edges (by {np.std(before):.0%})"
    )


def _depth_or_steps(tracks: Tracks, factor: float, evidence: str) -> Finding:
    """Return what is wrong where depths are ``factor`` times what steps tell: the one, the other, or either."""
    by, unit = "the front-end's steps", unit_of(factor)
    small = 1.0 / _DEPTH_FACTOR < factor < _DEPTH_FACTOR
    if small:
        depth = _depth_finding(f"scale of depth_m: it is {_times(factor)} what {by} tell", evidence)
        depth = dataclasses.replace(depth, changes=("the factor from depth images to depth_m",))
        steps = f"scale of {by}: they are {_times(1.0 / factor)} what depth_m tells"
    else:
        name = unit or "in another unit"
        depth = _depth_finding(f"depth_m {name}: it is {_times(factor)} what {by} tell", evidence)
        steps = _scale_of_steps(factor)
    blame = _by_baseline(tracks, factor) or ("" if small else _by_sense(tracks))
    if blame == "steps":
        evidence = f"depth_m is {_times(factor)} what they tell, {evidence}"
        return Finding((steps,), evidence, (POSITIONS,))
    causes, changes = depth.causes, depth.changes
    if not blame:
        causes, changes = (*causes, steps), (*changes, POSITIONS)
    found = dataclasses.replace(depth, causes=causes, changes=changes)
    return _or_intrinsics(found) if not unit and not small else found


def _or_intrinsics(found: Finding) -> Finding:
    """Return a finding with the intrinsics named too, as what steps tell of distances depends on them."""
    causes = *found.causes, "focal length or principal point wrong (region of interest, binning)"
    return dataclasses.replace(
        found, causes=causes, changes=(*found.changes, "k, roi and binning in the camera_info of camera_rig")
    )


def _by_baseline(tracks: Tracks, factor: float) -> str:
    """Return which of depths and steps, that differ by a factor, two cameras contradict; empty if they do not tell."""
    if len(tracks.cameras.model) < 2:
        return ""
    found, _ = _stereo_depths(tracks, spread(len(tracks), _COMPARED).tolist(), 1, tracks.between_cameras(0, 1))
    both = np.isfinite(found) & np.isfinite(tracks.depth_m)
    if np.count_nonzero(both) < 2 * _POINTS:
        return ""
    off = float(np.median(np.log(tracks.depth_m[both] / found[both])) / np.log(factor))
    return "steps" if abs(off) < _NEARER else "depth" if abs(off - 1.0) < _NEARER else ""


def _by_sense(tracks: Tracks) -> str:
    """Return which of depths and steps are of a size that none are; empty if neither is, or both are."""
    deep = not _DEPTHS_M[0] < float(np.nanmedian(tracks.depth_m)) < _DEPTHS_M[1]
    fast = speed_of(tracks) > FASTEST
    return ("" if fast else "depth") if deep else ("steps" if fast else "")


def _alike(ratio: list[float], most: float) -> bool:
    """Tell whether logarithms of ratios, one for each pair of images, are those of equal lengths.

    They are not if their median is beyond a factor ``most``, or clearly beyond a small one.
    """
    middle = abs(float(np.median(ratio)))
    error = 1.25 * NORMAL * _deviation(ratio) / np.sqrt(len(ratio))
    clear = len(ratio) >= _MANY_PAIRS and middle > max(np.log(_SMALL_FACTOR), _STANDARD_ERRORS * error)
    return middle < np.log(most) and not clear


def _times(factor: float) -> str:
    return f"{factor:.0f} times" if factor >= 10.0 else f"{factor:.3g} times"


def _depth_finding(cause: str, evidence: str) -> Finding:
    return Finding((cause,), evidence, ("depth_m in the feature_tracks, expected metres along the optical axis",))


def check_lengths(tracks: Tracks, relations: list[Relation], intrinsics_fit: bool = True) -> Diagnosis:
    """Compare depths of two cameras, which are in units of their baseline, with those of the front-end's steps.

    Where it is not known that ``intrinsics_fit``, a mistake needs more pairs of images, as it may be theirs.
    """
    outcome, n_cam = Diagnosis(), len(tracks.cameras.model)
    if n_cam > 1 and len(tracks) < _KEYFRAMES:
        return Diagnosis(untold=["too few keyframes to compare a baseline with steps"])
    for camera in range(1, min(n_cam, 3)):
        baseline = tracks.between_cameras(0, camera)
        keyframes = sorted({one.b[0] for one in relations if one.b[1] == 0})
        if not any(len(tracks.match((k, 0), (k, camera))[0]) for k in keyframes):
            continue
        pairs = _stereo_pairs(tracks, relations, *_stereo_depths(tracks, keyframes, camera, baseline))
        if len(pairs) < _PAIRS:
            outcome.untold.append(f"too little parallax to compare the baseline of camera {camera} with steps")
            continue
        found = _lengths(tracks, camera, float(np.linalg.norm(baseline.translation)), pairs)
        why = "" if agreed(relations) else "too many outliers"
        if not intrinsics_fit and len(pairs) < _MANY_PAIRS:
            why = why or "too little is known of the intrinsics"
        if found.findings and why:
            found = Diagnosis(untold=[f"{why} to measure the baseline of camera {camera}"], rows=found.rows)
        outcome.add(found)
    return outcome


def _stereo_depths(tracks: Tracks, keyframes: list[int], camera: int, baseline: Pose) -> tuple[FloatArray, FloatArray]:
    """Return the depth of each observation by two cameras, and that at which it would have a parallax of one gate.

    Both are (n_obs,) m; NaN where there is less parallax, or no second camera.
    """
    depth, reach = np.full((2, len(tracks.keyframe)), np.nan)
    for k in keyframes:
        rows = tracks.match((k, 0), (k, camera))
        if not len(rows[0]):
            continue
        pair = rays(tracks, rows)
        in_a, _, parallax = two_view.depths(pair, baseline)
        good = two_view.explained(pair, baseline) & (parallax > pair.gate) & (in_a > 0.0)
        depth[rows[0][good]] = in_a[good]
        reach[rows[0][good]] = (in_a * parallax)[good] / pair.gate
    return depth, reach


def _stereo_pairs(
    tracks: Tracks, relations: list[Relation], depth: FloatArray, reach: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return depths by two cameras and by the front-end's steps, of points that are near enough.

    Which are is not for the two cameras to say: of points at the limit those would be taken that noise brings nearer.
    """
    near = _depth_pairs(tracks, relations, np.where(_PARALLAX * depth < reach, depth, np.nan))
    if len(near) < _PAIRS:
        # Points that are far tell no more than whether it is of the right size at all.
        far = _depth_pairs(tracks, relations, depth)
        return far if len(far) >= _PAIRS and abs(_log_factor(far)) > np.log(_GROSS) else near
    return _depth_pairs(tracks, relations, depth, reach / (_PARALLAX * np.exp(_log_factor(near))))


def _log_factor(pairs: list[tuple[FloatArray, FloatArray]]) -> float:
    return float(np.median([np.median(np.log(one / other)) for one, other in pairs]))


def _lengths(tracks: Tracks, camera: int, baseline: float, pairs: list[tuple[FloatArray, FloatArray]]) -> Diagnosis:
    stereo, steps = (np.concatenate(part) for part in zip(*pairs, strict=True))
    factor = float(np.exp(_log_factor(pairs)))
    rows = [Row("lengths", f"baseline of camera {camera} over the front-end's steps: {factor:.3g}", 1.0)]
    if _alike([float(np.median(np.log(one / other))) for one, other in pairs], _LENGTH_FACTOR):
        tell = f"the baseline of camera {camera} fits the steps (to {abs(factor - 1.0):.0%})"
        return Diagnosis(sound=[tell], rows=rows)
    evidence = f"depths of two cameras against those of the front-end's steps, over {len(pairs)} pairs of keyframes"
    # A shift of all disparities, 1 / z = 1 / z_steps + shift, against a factor: whichever leaves less of the spread.
    shift = float(np.median(1.0 / stereo - 1.0 / steps))
    shifted = _deviation(np.log(np.maximum(1.0 / stereo - shift, 1e-9) * steps))
    scaled = _deviation(np.log(stereo / steps))
    if min(shifted, scaled) > _AGREE:
        return Diagnosis(untold=[f"depths of cameras 0 and {camera} contradict the front-end's steps"], rows=rows)
    causes: dict[str, str] = {}
    if shifted < _CLEARLY * scaled and 1.0 / _GROSS < factor < _GROSS:
        causes |= _of_shift(tracks, camera, abs(shift) * baseline)
    if not causes or scaled < shifted / _SURELY or 1.0 / _LENGTH_FACTOR < factor < _LENGTH_FACTOR:
        causes |= _of_factor(camera, baseline, factor)
        for other in range(1, len(tracks.cameras.model)):
            known = float(np.linalg.norm(tracks.between_cameras(0, other).translation))
            if other != camera and _alike([np.log(baseline / factor / max(known, 1e-9))], _LENGTH_FACTOR):
                causes = {f"cameras {camera} and {other} swapped": _ORDER, **causes}
    if factor < 1.0 / _GROSS and speed_of(tracks) > FASTEST:
        causes = {_scale_of_steps(factor): POSITIONS}
    return Diagnosis([Finding(tuple(causes), evidence, tuple(causes.values()))], rows=rows)


def _of_shift(tracks: Tracks, camera: int, turn: float) -> dict[str, str]:
    """Return what shifts all disparities by an angle (its tangent), and what to change."""
    px, degrees = turn * float(tracks.cameras.params[camera, 0]), float(np.degrees(np.arctan(turn)))
    if px < _LEAST_SHIFT_PX:
        return {}
    return {
        f"camera {camera} does not fit its place on the body by about {angle(degrees)}, towards camera 0 or away": (
            f"body_from_camera of camera {camera} in camera_rig (or tf_static)"
        ),
        f"principal point of camera {camera} off by about {px:.0f} px along the baseline": (
            f"k in the camera_info of camera {camera}"
        ),
    }


def _of_factor(camera: int, baseline: float, factor: float) -> dict[str, str]:
    """Return what stretches all depths by a factor, and what to change."""
    fitting = f"({baseline:.3g} m; tracks fit {baseline / factor:.3g} m)"
    size = unit_of(factor) or f"is {_times(factor)} what the front-end's steps tell"
    return {
        f"baseline of camera {camera} {size}": (f"body_from_camera of camera {camera} in camera_rig {fitting}"),
        _scale_of_steps(factor): POSITIONS,
    }


def _scale_of_steps(factor: float) -> str:
    """Return what is wrong with poses where lengths are ``factor`` times what these tell."""
    if 1.0 / _DEPTH_FACTOR < factor < _DEPTH_FACTOR:
        return f"scale of the front-end's steps: they are {_times(1.0 / factor)} what the cameras tell"
    return f"poses {unit_of(1.0 / factor) or 'in another unit'}"


def _depth_pairs(
    tracks: Tracks,
    relations: list[Relation],
    depth: FloatArray,
    most: FloatArray | None = None,
    least: int = _POINTS,
) -> list[tuple[FloatArray, FloatArray]]:
    """Return given depths and those of the front-end's steps, m, for each pair of images with ``least`` of them.

    ``most`` (n_obs,) is how far a point may be by the steps, m.
    """
    found = []
    for one in relations:
        length = float(np.linalg.norm(tracks.between_images(one.a, one.b).translation))
        if not one.has_direction or length <= 0.0:
            continue
        _, in_b, parallax = two_view.depths(one.pair, Pose(one.pose.rotation, one.pose.translation * length))
        good = two_view.explained(one.pair, one.pose) & (parallax > _PARALLAX * one.pair.gate)
        good &= (depth[one.rows_b] > 0.0) & (in_b > 0.0)
        if most is not None:
            good &= in_b < most[one.rows_b]
        if np.count_nonzero(good) >= least:
            found.append((depth[one.rows_b][good], in_b[good]))
    return found


def _deviation(values: list[float] | FloatArray) -> float:
    return float(np.median(np.abs(np.asarray(values) - np.median(values))))
