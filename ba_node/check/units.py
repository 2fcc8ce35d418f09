# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check what needs no geometry of its own: units of pixels, sigma_px and stamps, sizes of images, speeds."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import BoolArray, IntArray
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.relations import in_motion
from ba_node.check.tracks import Tracks
from ba_node.core.loss import NORMAL

_PAIRS = 4
POSITIONS = "the position in the keyframes, expected metres"
# Image coordinates no larger than this are no pixels, where the focal length is at least this.
_NO_PIXEL = 3.0
_FOCAL = 30.0
# Share of the observations that may lie outside the image, by so much and more, px.
_MOST_OUTSIDE, _ASIDE_PX = 0.05, 4.0
# Keyframes before that have next to none outside, where all later ones but a few have; and those that are needed.
_NEXT_TO_NONE, _LATER_OUTSIDE, _BEFORE, _LATER = 0.002, 0.02, 5, 3
# Values of sigma_px that are not looked at; the factor by which others are wrong, and the least noise of tracks, px.
_USUAL_SIGMA_PX = (0.05, 5.0)
_SIGMA_FACTOR, _LEAST_NOISE_PX = 8.0, 0.01
# Nothing on the ground or in the air is faster, m/s.
FASTEST = 350.0
# Sensible distances between keyframes, s; and units that stamps may have been taken for.
_SPACING_S = (5e-4, 600.0)
_STAMP_UNITS = ((1e3, "microseconds"), (1e6, "milliseconds"), (1e9, "seconds"))


def check_pixels(tracks: Tracks) -> Diagnosis:
    """Look whether image coordinates are in the unit of the focal length."""
    reach, focal = float(np.percentile(np.abs(tracks.uv), 95.0)), float(np.median(tracks.cameras.params[:, 0]))
    if reach > _NO_PIXEL or focal < _FOCAL:
        return Diagnosis()
    cause = f"image coordinates are not in pixels: nearly all of them are below {reach:.2g}"
    change = "u and v in the feature_tracks, expected pixels of the image, not normalised coordinates"
    return Diagnosis([Finding((cause,), f"the focal length is {focal:.0f} px", (change,), usual=True)])


def check_image_size(tracks: Tracks) -> Diagnosis:
    """Look whether observations lie within the images that the rig speaks of."""
    outcome = Diagnosis()
    for camera, size in enumerate(() if tracks.image_size is None else tracks.image_size):
        uv = tracks.uv[tracks.camera == camera]
        if not size.all() or not len(uv):
            continue
        outside = ((uv < -_ASIDE_PX) | (uv > size - 1.0 + _ASIDE_PX)).any(axis=1)
        since = _outside_since(tracks.keyframe[tracks.camera == camera], outside, len(tracks))
        if since is not None:
            cause = f"images of camera {camera} are others from stamp {tracks.stamp_ns[since] * 1e-9:.3f} s on"
            cause += ": another focal length (zoomed), another size, or another region of interest"
            evidence = f"none of its observations lie outside {size[0]} x {size[1]} px before, then many do"
            change = "images as they were before, or another session_id with a camera_rig that is theirs"
            at = int(tracks.stamp_ns[since])
            outcome.findings.append(Finding((cause,), evidence, (change,), usual=True, since_ns=at))
        elif (share := float(np.mean(outside))) > _MOST_OUTSIDE:
            cause = f"image size of camera {camera} is not that of the images that were tracked"
            evidence = f"{share:.0%} of its observations lie outside {size[0]} x {size[1]} px"
            change = "width and height in the camera_info of camera_rig, and k if it is that of another size"
            outcome.findings.append(Finding((cause,), evidence, (change,), harmful=False, usual=True))
    return outcome


def _outside_since(keyframe: IntArray, outside: BoolArray, count: int) -> int | None:
    """Return the keyframe from which on observations lie outside the image while none did before; None if none is."""
    seen, out = np.bincount(keyframe, minlength=count), np.bincount(keyframe, outside, count)
    looked = np.flatnonzero(seen)
    many = out[looked] > _LATER_OUTSIDE * seen[looked]
    if not many.any():
        return None
    first = int(np.argmax(many))
    before, later = looked[:first], many[first:]
    clean = first >= _BEFORE and out[before].sum() <= _NEXT_TO_NONE * seen[before].sum()
    return int(looked[first]) if clean and len(later) >= _LATER and later.mean() > 0.8 else None


def check_sigma(tracks: Tracks) -> Diagnosis:
    """Compare sigma_px, where it is an unusual one, with how far tracks are off what is best for two images."""
    told = float(np.median(tracks.sigma_px))
    if _USUAL_SIGMA_PX[0] <= told <= _USUAL_SIGMA_PX[1]:
        return Diagnosis()
    # With a gate of its own, which the sigma that came does not widen.
    pairs = in_motion(dataclasses.replace(tracks, sigma_px=np.ones_like(tracks.sigma_px)))
    if len(pairs) < _PAIRS:
        return Diagnosis(untold=["too few tracks to judge sigma_px"])
    focal = float(np.median(tracks.cameras.params[:, 0]))
    found = [np.median(np.abs(two_view.residuals(one.pair, one.pose))) for one in pairs]
    noise = NORMAL * focal * float(np.median(found))
    if not 1.0 / _SIGMA_FACTOR < told / max(noise, _LEAST_NOISE_PX) < _SIGMA_FACTOR:
        cause = f"sigma_px is {told:.2g} px, the tracks scatter by about {noise:.2g} px"
        change = "sigma_px in the feature_tracks: the standard deviation of u and of v, px"
        return Diagnosis([Finding((cause,), f"over {len(pairs)} pairs of keyframes", (change,), harmful=False)])
    return Diagnosis(sound=["sigma_px fits the tracks"])


def check_stamps(tracks: Tracks) -> Diagnosis:
    """Look whether keyframes follow each other at a sensible pace."""
    steps = np.diff(tracks.stamp_ns)
    steps = steps[steps > 0]
    if len(steps) < 2:
        return Diagnosis(untold=["too few keyframes to judge stamps"])
    usual = float(np.median(steps)) * 1e-9
    if _SPACING_S[0] <= usual <= _SPACING_S[1]:
        # That stamps are plausible is no sign that the tracks fit.
        return _check_speed(tracks)
    likely = [name for factor, name in _STAMP_UNITS if 0.01 <= usual * factor <= 10.0]
    likely += [f"{name} taken for seconds" for factor, name in _STAMP_UNITS if 0.01 <= usual / factor <= 10.0]
    cause = f"stamps in another unit: keyframes are {usual:.3g} s apart" + (f", perhaps {likely[0]}" if likely else "")
    return Diagnosis([Finding((cause,), "median of their stamps", ("header.stamp of the keyframes",), harmful=False)])


def _check_speed(tracks: Tracks) -> Diagnosis:
    """Look whether poses move as fast as anything does: images of one camera have no scale that would tell."""
    speed = speed_of(tracks)
    if not speed > FASTEST:
        return Diagnosis()
    causes = "poses in another unit than metres, as in millimetres", "stamps in another unit than seconds"
    changes = POSITIONS, "header.stamp of the keyframes"
    return Diagnosis([Finding(causes, f"by both the body moves at {speed:.0f} m/s", changes, harmful=False)])


def speed_of(tracks: Tracks) -> float:
    """Return the usual speed by poses and stamps, m/s; NaN where stamps do not tell."""
    seconds = np.diff(tracks.stamp_ns) * 1e-9
    steps = np.linalg.norm(np.diff(tracks.position, axis=0), axis=1)[seconds > 0.0]
    seconds = seconds[seconds > 0.0]
    known = len(seconds) > 1 and _SPACING_S[0] <= float(np.median(seconds)) <= _SPACING_S[1]
    return float(np.median(steps / seconds)) if known else float("nan")
