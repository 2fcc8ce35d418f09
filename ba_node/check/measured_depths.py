# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of a young map whether measured depths err by more or less with the distance, as an offset makes them.

A depth camera whose origin lies behind its lens, that saturates, or that rounds, errs within the bounds of a single
depth, and solves give way to it: they stretch, bend and turn the way until it fits.

So points are placed once more by images alone, from the refined poses, where these see them with parallax enough. Their
unit is that of the refined steps, which depths and odometry have a part in; but the ratio r of a measured depth to such
a distance z is the same at every z where depths are right, whatever the unit. Depths are put in classes by z, and the
medians of r in these are compared: an offset a leaves ``r = s (1 + a / z)``, a straight line in 1 / z; what is cut off
or rounded does not lie on one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.tracks import Tracks, tracks_of
from ba_node.check.watch import Check
from ba_node.core import triangulation
from ba_node.core.loss import robust_spread
from ba_node.scene.scene import Scene

# A point is placed by so many images, with a parallax of so many rad and sigmas, and by rays that are within so many
# sigmas of it; rounds in which others are left out.
_VIEWS, _PARALLAX, _SIGMAS, _GATE = 3, 0.1, 75.0, 5.0
_ROUNDS = 2
# Depths that are needed, in each class too; classes at most; and those needed.
_DEPTHS, _CLASS, _MOST_CLASSES, _LEAST_CLASSES = 200, 40, 12, 5
# Ratios further off the usual one are of points that move or are mismatched; share of others that is needed.
_APART, _MOST = 0.25, 0.7
# Standard error of a median, in those of a mean; what medians of sound depths differ by at least, for errors in the
# poses and lenses.
_OF_MEDIAN, _FLOOR = 1.25, 0.001
# An offset is wrong from so many m, standard errors and that share of depth between the nearest and farthest class on.
_OFFSET_M, _ERRORS, _TILT = 0.03, 4.5, 0.005
# A smaller one may be of a focal length that bends the way.
_OF_INTRINSICS_M = 0.06
# Larger ones are hardly those of a sensor, m.
_OF_SENSORS_M = 0.3
# Medians that scatter by such a share about what an offset leaves are wrong, if that is so many standard errors.
_BENT, _BENT_ERRORS = 0.01, 4.0
# Keyframes at which it is asked, up to which a map is young, and from which on it is asked at once: with fewer, poses
# that are off along the way look like an offset.
_AT, _YOUNG, _FEWEST = frozenset({30, 60, 120}), 120, 20


class Profile(NamedTuple):
    """How measured depths compare with those by images, in classes of these, nearest first."""

    distance: FloatArray  # (n,) usual depth by images in each, m
    ratio: FloatArray  # (n,) median of measured over by images
    error: FloatArray  # (n,) standard error of it
    depths: int  # that are compared


def depths_err(scene: Scene, *, at_once: bool = False) -> Check | None:
    """Return what is wrong if measured depths of a young map err with the distance; None if nothing is known to be.

    ``at_once``: it is asked at any number of keyframes, as no more will come, or as lengths differ.
    """
    count, known = len(scene.keyframes), scene.constraints
    if not (_FEWEST <= count <= _YOUNG if at_once else count in _AT) or known.absolute or known.landmarks:
        return None
    if "moving" in scene.log.warnings or not np.isfinite(scene.observations.depth_m).any():
        return None
    profile = profile_of(scene)
    finding = None if profile is None else wrong_with(profile)
    if finding is None:
        return None
    found = Diagnosis([finding])
    return Check(scene, lambda: found, found)


def wrong_with(profile: Profile) -> Finding | None:
    """Return what is wrong if ratios are not alike at all distances."""
    weight, inverse = 1.0 / profile.error**2, 1.0 / profile.distance
    design = np.column_stack([np.ones_like(inverse), inverse])
    covariance = np.linalg.inv(design.T @ (weight[:, None] * design))
    scale, slope = covariance @ (design.T @ (weight * profile.ratio))
    off = profile.ratio - design @ np.array([scale, slope])
    bent = float(np.sqrt(np.mean(off**2)))
    tilt = abs(slope) * float(np.ptp(inverse))
    evidence = f"against those of the refined images, over {profile.depths} depths"
    if bent > max(_BENT, _BENT_ERRORS * float(np.median(profile.error))):
        low, high = (int(k) for k in (np.argmin(profile.ratio), np.argmax(profile.ratio)))
        (at_low, at_high), middle = profile.distance[[low, high]], float(np.median(profile.ratio))
        cause = (
            f"depth_m errs with the distance: it is {profile.ratio[low] / middle:.2f} times the usual one at"
            f" {at_low:.1f} m and {profile.ratio[high] / middle:.2f} times at {at_high:.1f} m, as where depths are cut"
            " off or rounded"
        )
        change = "depth_m in the feature_tracks: NaN where the sensor saturates, and as precise as it measures"
        return Finding((cause,), evidence, (change,))
    offset, error = slope / scale, float(np.sqrt(covariance[1, 1])) / scale
    if abs(offset) < max(_OFFSET_M, _ERRORS * error) or tilt < _TILT:
        return None
    cause = f"depth_m is off by about {offset:+.2f} m at all distances"
    (first, last), (near_m, far_m) = profile.ratio[[0, -1]] / scale, profile.distance[[0, -1]]
    evidence = f"{first:.3f} times as much at {near_m:.1f} m and {last:.3f} at {far_m:.1f} m {evidence}"
    causes = {
        cause: "depth_m in the feature_tracks, expected from the centre of the camera (its lens) along the optical axis"
    }
    if abs(offset) < _OF_INTRINSICS_M:
        causes["focal length or principal point off by a few percent"] = "k of camera_info in camera_rig"
    if abs(offset) > _OF_SENSORS_M:
        causes["depth_m of another image (delayed), or not registered to the camera"] = (
            "depth_m in the feature_tracks: that of the pixel, in its image"
        )
    return Finding(tuple(causes), evidence, tuple(causes.values()))


def profile_of(scene: Scene) -> Profile | None:
    """Return how measured depths compare with those by images and refined poses; None where too few can be."""
    tracks = tracks_of(scene)
    if tracks is None:
        return None
    table, order = scene.keyframes, scene.order
    rows = np.flatnonzero(np.isfinite(tracks.ray[:, 0]) & table.refined[order][tracks.keyframe])
    if len(rows) < _DEPTHS:
        return None
    found = _by_images(tracks, rows, table.rotation[order], table.position[order])
    some = np.isfinite(found) & np.isfinite(tracks.depth_m[rows])
    if np.count_nonzero(some) < _DEPTHS:
        return None
    distance = found[some]
    ratio = tracks.depth_m[rows][some] / distance
    alike = np.abs(np.log(ratio / np.median(ratio))) < _APART
    n = min(_MOST_CLASSES, int(np.count_nonzero(alike)) // _CLASS)
    if np.mean(alike) < _MOST or n < _LEAST_CLASSES:
        return None
    distance, ratio = distance[alike], ratio[alike]
    parts = np.array_split(np.argsort(distance, kind="stable"), n)
    middle = np.array([np.median(ratio[part]) for part in parts])
    spread = [robust_spread(ratio[part] - one) for part, one in zip(parts, middle, strict=True)]
    error = np.hypot(_FLOOR, _OF_MEDIAN * np.array(spread) / np.sqrt([len(part) for part in parts]))
    return Profile(np.array([np.median(distance[part]) for part in parts]), middle, error, len(ratio))


def _by_images(tracks: Tracks, rows: IntArray, rotation: FloatArray, position: FloatArray) -> FloatArray:
    """Return the depth of some observations by the images of their tracks, (n,) m; NaN where these do not tell.

    ``rotation`` (n_kf, 3, 3) and ``position`` (n_kf, 3) m are the poses of the keyframes.
    """
    keyframe, camera, rig = tracks.keyframe[rows], tracks.camera[rows], tracks.cameras
    turn = rotation[keyframe] @ np.swapaxes(rig.rotation[camera], 1, 2)
    eye = position[keyframe] - (turn @ rig.translation[camera][:, :, None])[..., 0]
    ray = np.column_stack([tracks.ray[rows], np.ones(len(rows))])
    ray = (turn @ (ray / np.linalg.norm(ray, axis=1)[:, None])[:, :, None])[..., 0]
    sigma = tracks.sigma_px[rows] / np.sqrt(rig.params[camera, 0] * rig.params[camera, 1])
    track = np.unique(tracks.track[rows], return_inverse=True)[1]
    nothing = np.full(len(rows), np.nan)
    rays, kept = triangulation.Rays(track, eye, ray, 1.0 / sigma, nothing, nothing), np.ones(len(rows), bool)
    for _ in range(_ROUNDS):
        found = triangulation.triangulate(rays.part(kept), int(track.max()) + 1)
        kept = triangulation.errors(rays, found.points) < _GATE
    depth = np.sum((found.points[track] - eye) * turn[:, :, 2], axis=1)
    good = kept & (np.bincount(track, kept)[track] >= _VIEWS) & (depth > 0.0)
    good &= found.parallax_rad[track] > np.maximum(_PARALLAX, _SIGMAS * sigma)
    return np.where(good, depth, np.nan)
