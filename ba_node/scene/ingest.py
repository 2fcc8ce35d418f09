# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check measurements by themselves, before anything that is known: shapes, numbers, ranges.

Bad rows are dropped one by one, good rows stay. Everything that is dropped is counted in a RejectionLog.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IdArray, changed
from ba_node.core import cameras, geometry
from ba_node.core.problem import Cameras
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.scene.records import Keyframes
from ba_node.scene.rejections import RejectionLog

MAX_PIXEL = 1e6
SIGMA_RANGE = (1e-6, 1e6)
DEPTH_RANGE_M = (1e-3, 1e6)
MAX_POSITION_M = 1e9
MAX_GUESS_M = 1e12
COARSE_M = 1e-3
_MIN_QUATERNION_NORM = 1e-6
_MAX_QUATERNION = 1e6
# A distortion that folds over within this share of the way from the principal point to the border is no calibration.
_FOLD_REFUSED = 0.5
_STAMP = np.iinfo(np.int64)


@dataclass(frozen=True)
class Pose:
    """A checked pose: rotation (3, 3) world from body, position (3,) of the body, m."""

    rotation: FloatArray
    position: FloatArray


def keyframe_pose(keyframe: Keyframe, log: RejectionLog) -> Pose | None:
    """Return the pose of a keyframe message, or None (counted) if it is not one."""
    name = f"keyframe {keyframe.keyframe_id}"
    wrong, what = _wrong_pose(keyframe)
    if wrong:
        log.reject(wrong, f"{name}: {what}")
        return None
    position, quaternion = np.asarray(keyframe.position, float), np.asarray(keyframe.orientation, float)
    _check_distance(name, keyframe.frame_id, position, log)
    return Pose(geometry.matrix_from_quaternion(quaternion), position)


def has_pose(keyframe: Keyframe) -> bool:
    """Return True if a keyframe message has a pose."""
    return not _wrong_pose(keyframe)[0]


def _wrong_pose(keyframe: Keyframe) -> tuple[str, str]:
    """Return why a keyframe is turned away, and what is wrong with it, in words; empty if nothing is."""
    position, quaternion = np.asarray(keyframe.position, float), np.asarray(keyframe.orientation, float)
    if position.shape != (3,) or quaternion.shape != (4,):
        return "malformed", f"pose of shape {position.shape}, {quaternion.shape}, expected (3,), (4,)"
    if not _STAMP.min <= keyframe.stamp_ns <= _STAMP.max:
        return "malformed", f"stamp {keyframe.stamp_ns} ns, expected 64 bits"
    if not _within(position, MAX_POSITION_M) or not is_rotation(quaternion):
        return "bad_pose", f"position {position} m, quaternion {quaternion}, expected finite and not zero"
    return "", ""


def plain_name(frame_id: str) -> str:
    """Return the name of a frame as tf2 has it: without the slash that tf of ROS 1 put before it."""
    return frame_id.strip().lstrip("/")


def check_frame(keyframe: Keyframe, named: str, taken: str, log: RejectionLog) -> None:
    """Say so if the name of a keyframe's fixed frame is none, or one that tf2 refuses.

    Where a parameter has ``named`` it, an empty name does no harm; ``taken`` is what is taken for an empty one.
    """
    name = plain_name(keyframe.frame_id)
    if name == keyframe.frame_id and name:
        return
    log.notice("frame_name")
    if "frame_name" in log.warnings:
        return
    where = f"keyframe {keyframe.keyframe_id}: header.frame_id = {keyframe.frame_id!r}"
    if name:
        log.warn(
            "frame_name", f"{where} is no name for tf2, taken as {name!r}: leave out spaces and the slash in front"
        )
    elif not named:
        log.warn("frame_name", f"{where} names no frame, taken as {taken!r}: name the fixed frame of the poses")


def _check_distance(name: str, frame_id: str, position: FloatArray, log: RejectionLog) -> None:
    """Warn where the cloud, as viewers take it, cannot tell points apart any more that the map can."""
    # That of float32 where double precision has its own.
    step_m = math.ulp(max(map(abs, position.tolist()))) * 2.0**29
    if step_m > COARSE_M:
        text = (
            f"{name} is {np.linalg.norm(position):.0f} m from the origin of {frame_id!r}: points on ~/points are"
            f" float32, with steps of {step_m:.2g} m there; give poses relative to a place near the site (poses"
            " and points.ply keep all digits)"
        )
        log.warn("far_from_origin", text=text)


def check_stamp(keyframe: Keyframe, known: Keyframes, log: RejectionLog) -> None:
    """Say so, once, if a keyframe has the stamp of one that is known."""
    same = np.flatnonzero(known.stamp_ns == keyframe.stamp_ns)
    if not len(same) or "equal_stamps" in log.warnings:
        return
    other = f"keyframe {int(known.keyframe_id[same[-1]])}, {keyframe.stamp_ns * 1e-9:.3f} s"
    text = f"keyframe {keyframe.keyframe_id} has the stamp of {other}: they are put in order of arrival"
    log.warn("equal_stamps", f"{text}; set header.stamp to the time of the image")


def clean_tracks(tracks: FeatureTracks, log: RejectionLog) -> FeatureTracks | None:
    """Return the good rows of a tracks message with sigma and depth filled in, or None (counted) if malformed."""
    name = f"tracks of camera {tracks.camera_index} in keyframe {tracks.keyframe_id}"
    wrong = tracks.malformed or _wrong_shape(tracks)
    if wrong:
        log.reject("malformed", f"{name}: {wrong}")
        return None
    n = len(tracks.track_id)
    uv = np.asarray(tracks.uv, float)
    sigma = np.asarray(tracks.sigma_px, float) if len(tracks.sigma_px) else np.ones(n)
    depth = np.array(tracks.depth_m, float) if len(tracks.depth_m) else np.full(n, np.nan)
    ids = np.asarray(tracks.track_id).astype(np.uint64)
    if _nothing_to_check(ids, uv, sigma, depth):
        return changed(tracks, track_id=ids, uv=uv, sigma_px=sigma, depth_m=depth)
    finite = np.isfinite(uv).all(axis=1) & np.isfinite(sigma)
    with np.errstate(invalid="ignore"):
        near = (np.abs(uv) <= MAX_PIXEL).all(axis=1)
        sane_sigma = (sigma >= SIGMA_RANGE[0]) & (sigma <= SIGMA_RANGE[1])
        bad_depth = (depth < DEPTH_RANGE_M[0]) | (depth > DEPTH_RANGE_M[1])
    good = np.ones(n, bool)
    for reason, passed in (("non_finite", finite), ("out_of_range", near), ("bad_sigma", sane_sigma)):
        failed = np.flatnonzero(good & ~passed)
        if len(failed):
            i = failed[0]
            values = f"u = {uv[i, 0]:g}, v = {uv[i, 1]:g}, sigma = {sigma[i]:g} px, depth = {depth[i]:g} m"
            log.reject(reason, f"track {tracks.track_id[i]} in {name[10:]}: {values}", len(failed))
        good &= passed
    failed = np.flatnonzero(good & bad_depth)
    if len(failed):
        i = failed[0]
        log.reject("bad_depth", f"track {tracks.track_id[i]} in {name[10:]}: depth = {depth[i]:g} m", len(failed))
        depth[failed] = np.nan
    good &= _first_of_each(tracks, good, log)
    return dataclasses.replace(tracks, track_id=ids[good], uv=uv[good], sigma_px=sigma[good], depth_m=depth[good])


def clean_guesses(guesses: LandmarkGuesses, log: RejectionLog) -> LandmarkGuesses | None:
    """Return the good rows of a guesses message, the first of each track; None (counted) if malformed."""
    ids, position = np.asarray(guesses.track_id), np.asarray(guesses.position, float)
    wrong = guesses.malformed
    if not wrong and (not _is_id_array(ids) or position.shape != (len(ids), 3)):
        wrong = f"{ids.shape} ids of type {ids.dtype} and positions of shape {position.shape}, expected (n,) and (n, 3)"
    if wrong:
        log.reject("malformed", f"landmark guesses: {wrong}")
        return None
    with np.errstate(invalid="ignore"):
        good = (np.abs(position) <= MAX_GUESS_M).all(axis=1)
    failed = np.flatnonzero(~good)
    if len(failed):
        log.reject("bad_guess", f"guess for track {ids[failed[0]]}: {position[failed[0]]} m", len(failed))
    unique, first = np.unique(ids[good].astype(np.uint64), return_index=True)
    log.notice("repeated_guess", int(good.sum()) - len(unique))
    return dataclasses.replace(guesses, track_id=unique, position=position[good][first])


def rig_cameras(rig: CameraRig, log: RejectionLog) -> Cameras | None:
    """Return the cameras of a rig, or None (counted) if one of them cannot be used."""
    n = len(rig)
    if rig.malformed:
        log.reject("bad_rig", f"camera rig {rig.frame_id!r}: {rig.malformed}")
        return None
    arrays = (rig.intrinsics, rig.position, rig.orientation, rig.image_size)
    shapes = (*(np.shape(array) for array in arrays), len(rig.distortion), len(rig.names))
    expected = ((n, 4), (n, 3), (n, 4), (n, 2), n, n)
    if n == 0 or shapes != expected:
        log.reject("bad_rig", f"camera rig of {n} cameras: shapes {shapes}, expected {expected}")
        return None
    model, params = np.zeros(n, np.uint8), np.zeros((n, cameras.N_PARAMS))
    for i in range(n):
        if not _within(rig.position[i], MAX_POSITION_M) or not is_rotation(rig.orientation[i]):
            pose = f"position {rig.position[i]} m, quaternion {rig.orientation[i]}"
            log.reject("bad_rig", f"camera {i}: {pose}, expected finite and not zero")
            return None
        try:
            model[i], params[i] = cameras.parameters(rig.models[i], rig.intrinsics[i], rig.distortion[i])
            _check_fold(f"camera {i} ({rig.names[i]!r})", cameras.Model(model[i]), params[i], rig.image_size[i], log)
        except cameras.CameraError as error:
            log.reject("unknown_model", f"camera {i} ({rig.names[i]!r}): {error}")
            return None
    rotation, translation = geometry.inverse(geometry.matrix_from_quaternion(rig.orientation), rig.position)
    return Cameras(rotation, translation, model, params)


def _check_fold(
    name: str, model: cameras.Model, params: FloatArray, size: NDArray[np.int64], log: RejectionLog
) -> None:
    """Raise CameraError if a distortion folds over near the middle of the image, warn if it does so farther out.

    Corners are let pass: those of a fisheye's image are black.
    """
    focal, centre = params[: cameras.CX], params[cameras.CX : cameras.DISTORTION.start]
    nearest = float(np.min(np.concatenate([centre, size - centre]) / np.tile(focal, 2)))
    limit = cameras.widest(model, params) if nearest > 0.0 else np.inf
    if limit >= nearest:
        return
    limit_px, nearest_px = limit * focal.min(), nearest * focal.min()
    where = f"folds over {limit_px:.0f} px from the principal point; the image reaches {nearest_px:.0f} px"
    if limit < _FOLD_REFUSED * nearest:
        raise cameras.CameraError(f"the distortion {where}: d is not that of this camera, calibrate it again")
    text = f"{name}: the distortion {where}: observations beyond have no ray; calibrate it again"
    log.warn("distortion_folds", text=text)


def why_refused(rig: CameraRig) -> str:
    """Return why the cameras of a rig are turned away, in words; empty if they are not."""
    log = RejectionLog()
    # Without the count of what was turned away, which ends a note.
    return "" if rig_cameras(rig, log) is not None else log.notes[-1].rpartition("; dropped (")[0]


def seen_from_first(rig: CameraRig) -> CameraRig:
    """Return a rig as it is seen from its first camera, which then is the body; unchanged where it cannot be used."""
    if why_refused(rig):
        return rig
    rotation = geometry.matrix_from_quaternion(rig.orientation)
    back = geometry.inverse(rotation[0], rig.position[0])
    seen = geometry.compose(*back, rotation, rig.position)
    return dataclasses.replace(
        rig, frame_id=rig.names[0], position=seen[1], orientation=geometry.quaternion_from_matrix(seen[0])
    )


def _nothing_to_check(ids: IdArray, uv: FloatArray, sigma: FloatArray, depth: FloatArray) -> bool:
    """Return True for most messages: ids that rise, sane pixels and sigmas, no depth or only sane ones."""
    if native.kernels is not None:
        bounds = MAX_PIXEL, *SIGMA_RANGE, *DEPTH_RANGE_M
        return bool(native.kernels.are_sane_tracks(ids, uv, sigma, depth, bounds))
    if not len(ids) or not (ids[1:] > ids[:-1]).all():
        return False
    lowest, highest = np.fmin.reduce(depth), np.fmax.reduce(depth)
    # A NaN among u, v and sigma fails its comparison.
    return bool(
        max(uv.max(), -uv.min()) <= MAX_PIXEL
        and SIGMA_RANGE[0] <= sigma.min()
        and sigma.max() <= SIGMA_RANGE[1]
        and (np.isnan(lowest) or (DEPTH_RANGE_M[0] <= lowest and highest <= DEPTH_RANGE_M[1]))
    )


def _first_of_each(tracks: FeatureTracks, good: BoolArray, log: RejectionLog) -> BoolArray:
    """Return which rows are the first good one of their track."""
    rows = np.flatnonzero(good)
    _, first = np.unique(tracks.track_id[rows], return_index=True)
    keep = np.zeros(len(good), bool)
    keep[rows[first]] = True
    repeated = np.flatnonzero(good & ~keep)
    if len(repeated):
        where = f"keyframe {tracks.keyframe_id}, camera {tracks.camera_index}"
        what = f"track {tracks.track_id[repeated[0]]} twice in the message of {where}"
        log.reject("duplicate_observation", what, len(repeated))
    return keep


def _wrong_shape(tracks: FeatureTracks) -> str:
    ids, n = np.asarray(tracks.track_id), len(tracks.track_id)
    if not _is_id_array(ids):
        return f"track_id of shape {ids.shape} and type {ids.dtype}, expected a row of uint64"
    if np.shape(tracks.uv) != (n, 2):
        return f"{n} ids but coordinates of shape {np.shape(tracks.uv)}, expected ({n}, 2)"
    for name, values in (("sigma_px", tracks.sigma_px), ("depth_m", tracks.depth_m)):
        if np.shape(values) not in ((n,), (0,)):
            return f"{n} ids but {np.shape(values)} values of {name}, expected none or {n}"
    return ""


def _is_id_array(ids: NDArray[np.generic]) -> bool:
    return ids.ndim == 1 and (ids.dtype.kind == "u" or len(ids) == 0)


def _within(values: FloatArray, limit: float) -> bool:
    # Of a few numbers; no comparison holds for NaN.
    return all(abs(value) <= limit for value in values.ravel().tolist())


def is_rotation(quaternion: FloatArray) -> bool:
    """Return True for a quaternion that is finite and not zero."""
    return _within(quaternion, _MAX_QUATERNION) and math.hypot(*quaternion.tolist()) > _MIN_QUATERNION_NORM
