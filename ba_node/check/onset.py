# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Look for the keyframe from which on the images of a camera are others: zoomed, cut out elsewhere, or mirrored.

Points are placed by two keyframes before it and the front-end's step between these, and seen from it: its pose, the
factor of its focal length and the shift of its principal point are those with the least Cauchy sum of residuals
(resection with intrinsics free). Where images go on as they were factor and shift are 1 and 0 up to noise, however the
camera moves and whatever the front-end's step to it is worth; where they change the same tracks tell it at once, and so
do the keyframes that follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.relations import rays
from ba_node.check.tracks import Image, Tracks
from ba_node.check.two_view import Pose
from ba_node.core import geometry
from ba_node.core.loss import robust_spread

_MAX_CAMERAS, _NEWEST = 8, 60
# Keyframes between the two that place points, widest first.
_GAPS = (4, 3, 2, 1)
# Keyframes that are needed; those that follow and have to say the same, but for a part of it.
_KEYFRAMES, _FOLLOW, _SAME = 6, 2, 0.6
# Those of which the standard errors are more than this part of it tell nothing.
_KNOWN = 0.5
# Standard errors that a change has to be worth; they are no less than those by which all keyframes scatter.
ERRORS = 8.0
# Changes that are not named: of the focal length by a share, of the principal point in focal lengths.
LEAST = np.array([0.03, 0.02, 0.02])
_MIRRORED = -0.5
# The front-end's step to an image is not further off, degrees.
_TURNED_DEG = 5.0
# Points meet if they do so to this many times the usual distance.
_MEET = 3.0
_ITERATIONS, _HALF = 10, 2.0
# An image taken so many times farther from those that place points than these are apart may see any of them elsewhere.
_FARTHER = 5.0
# Of fewer points mismatches tell nine unknowns as well as the rest; that images are mirrored is plain.
_POINTS = 35
# What to change.
ADVICE = "images as they were before, or another session_id with a camera_rig that is theirs"


@dataclass(frozen=True)
class Change:
    """How an image differs from what those before let expect."""

    signs: FloatArray  # (2,) -1 where u or v is mirrored
    value: FloatArray  # (3,) log of the factor of the focal length, shift of the principal point in focal lengths
    error: FloatArray  # (3,) their standard errors

    @property
    def mirrored(self) -> bool:
        """Return True if one of the axes is."""
        return bool((self.signs < 0.0).any())

    def measured_by(self, other: Change) -> bool:
        """Return True if another one is known well enough to say whether it is as much."""
        return self.mirrored or float(np.linalg.norm(other.error)) < _KNOWN * float(np.linalg.norm(self.value))

    def same(self, other: Change, usual: FloatArray, steps: int) -> bool:
        """Return True if another one says as much, but for a part of it.

        ``usual`` (3,) is by how much any image differs from those just before it; the other is so many keyframes off.
        """
        off = float(np.linalg.norm(other.value - steps * usual - self.value))
        size = float(np.linalg.norm(self.value - usual))
        return np.array_equal(self.signs, other.signs) and (self.mirrored or off < _SAME * size)


def check_onset(tracks: Tracks) -> Diagnosis:
    """Look for a keyframe from which on images are others."""
    outcome = Diagnosis()
    for camera in range(min(len(tracks.cameras.model), _MAX_CAMERAS)):
        found = {
            k: one
            for k in range(max(2, len(tracks) - _NEWEST), len(tracks))
            if (one := _change(tracks, camera, k, k)) is not None
        }
        if len(found) < _KEYFRAMES:
            continue
        usual = np.median([one.value for one in found.values()], axis=0)
        scores = np.array([(one.value - usual) / one.error for one in found.values()])
        spread = np.maximum(robust_spread(scores), 1.0)
        clear = [
            k
            for (k, one), score in zip(found.items(), scores / spread, strict=True)
            if one.mirrored or ((np.abs(score) > ERRORS) & (np.abs(one.value - usual) > LEAST)).any()
        ]
        # Those that come after it are compared with points that are wrong.
        for k in clear:
            # So do later images, and this one from points that leave out the image just before it.
            others = [(_change(tracks, camera, k, k + i), 1 + i) for i in range(1, 1 + _FOLLOW)]
            others.append((_change(tracks, camera, k - 1, k), 2))
            agree = [
                found[k].same(one, usual, steps)
                for one, steps in others
                if one is not None and found[k].measured_by(one)
            ]
            # Mirrored images are plain by themselves, where the next ones share too little with those before.
            if all(agree) and (len(agree) > 1 or found[k].mirrored):
                outcome.findings.append(named(tracks, camera, k, found[k], usual))
                break
    return outcome


def named(tracks: Tracks, camera: int, k: int, change: Change, usual: FloatArray) -> Finding:
    """Return in words what changes at a keyframe, beside what (3,) is usual between images."""
    since = f"from stamp {tracks.stamp_ns[k] * 1e-9:.3f} s on"
    where = f"camera {camera} {since}"
    value, focal = change.value - usual, tracks.cameras.params[camera, :2]
    sure = np.abs(value) > np.maximum(LEAST, ERRORS * change.error)
    causes = []
    if change.mirrored:
        left, top = (change.signs < 0.0).tolist()
        sides = "mirrored: left and right are exchanged" if left else "mirrored: top and bottom are exchanged"
        causes.append(f"images of {where} are {'upside down' if left and top else sides}")
    if sure[0] and not change.mirrored:
        causes.append(f"focal length of {where} is {np.exp(value[0]):.3g} times that of before")
    if sure[1:].any() and not change.mirrored:
        u, v = value[1:] * focal
        causes.append(f"region of interest or principal point of {where} is another, by ({u:.0f}, {v:.0f}) px")
    evidence = "the same points are seen so by several keyframes"
    return Finding((", and ".join(causes),), evidence, (ADVICE,), usual=True, since_ns=int(tracks.stamp_ns[k]))


def _change(tracks: Tracks, camera: int, before: int, k: int) -> Change | None:
    """Return how the image of a keyframe ``k`` differs from what those before another let expect; None if unknown."""
    near, own = (before - 1, camera), (k, camera)
    if k >= len(tracks):
        return None
    rows, seen = tracks.match(near, own)
    for gap in _GAPS:
        far = (near[0] - gap, camera)
        first, second = tracks.match(far, near)
        _, at, of = np.intersect1d(second, rows, assume_unique=True, return_indices=True)
        if len(at) >= two_view.MIN_PAIRS:
            placing, step = (
                float(np.linalg.norm(tracks.between_images(*two).translation)) for two in ((far, near), (near, own))
            )
            if step > _FARTHER * placing:
                # Where points that had no parallax are seen from there is not known, as after a stand-still.
                return None
            nearness, meet = _nearness(tracks, far, near, (first[at], second[at]))
            of = of[meet]
            return _resection(tracks, (near, own), tracks.ray[rows[of]], nearness[meet], tracks.ray[seen[of]])
    return None


def _nearness(tracks: Tracks, far: Image, near: Image, rows: tuple[IntArray, IntArray]) -> tuple[FloatArray, BoolArray]:
    """Return the inverse depths of points by the front-end's step, 1/m, 0 for those that are far; and which meet."""
    pose, pair = tracks.between_images(far, near), rays(tracks, rows)
    if (length := float(np.linalg.norm(pose.translation))) > 0.0:
        # The tracks know its direction better, and what it turns.
        pose = two_view.refined(pair, pose)
        pose = Pose(pose.rotation, length * pose.translation)
    _, depth, parallax = two_view.depths(pair, pose)
    good = (depth > 0.0) & (parallax > pair.gate)
    off = np.abs(two_view.residuals(pair, pose))
    return np.where(good, 1.0 / np.where(good, depth, 1.0), 0.0), off < max(_MEET * float(np.median(off)), pair.gate)


def _resection(
    tracks: Tracks, images: tuple[Image, Image], ray: FloatArray, nearness: FloatArray, seen: FloatArray
) -> Change | None:
    step = tracks.between_images(*images)
    rotation, move = step.rotation, step.translation.copy()
    expected = _project(rotation, move, ray, nearness)
    ok = expected[1] > 0.0
    if np.count_nonzero(ok) < two_view.MIN_PAIRS:
        return None
    ray, nearness, seen, flat = ray[ok], nearness[ok], seen[ok], expected[0][ok]
    slopes = np.array([_slope(flat[:, i], seen[:, i]) for i in range(2)])
    signs = np.where(slopes < _MIRRORED, -1.0, 1.0)
    if (signs > 0.0).all() and len(ray) < _POINTS:
        return None
    seen = seen * signs
    zoom = np.clip(np.mean(np.abs(slopes)), 0.2, 5.0)
    value = np.array([np.log(zoom), *np.median(seen - zoom * flat, axis=0)])
    floor = 0.3 * tracks.px(tracks.images[images[1]])
    for _ in range(_ITERATIONS):
        flat, depth = _project(rotation, move, ray, nearness)
        zoom = np.exp(value[0])
        left = seen - zoom * flat - value[1:]
        scale = max(float(robust_spread(left.ravel())), floor)
        x, y = flat.T
        zero, one = np.zeros_like(x), np.ones_like(x)
        by_turn = np.stack([np.stack([-x * y, 1 + x * x, -y], 1), np.stack([-1 - y * y, x * y, x], 1)], 1)
        by_move = np.stack([np.stack([one, zero, -x], 1), np.stack([zero, one, -y], 1)], 1)
        by_move *= (nearness / depth)[:, None, None]
        own = np.stack([np.stack([zoom * x, one, zero], 1), np.stack([zoom * y, zero, one], 1)], 1)
        jacobian = np.concatenate([zoom * by_turn, zoom * by_move, own], axis=2)
        weight = 1.0 / (1.0 + np.sum(left * left, axis=1) / (_HALF * scale) ** 2)
        normal = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian)
        normal += np.diag(1e-7 * np.diagonal(normal) + 1e-12)
        change = np.linalg.solve(normal, np.einsum("n,nij,ni->j", weight, jacobian, left))
        rotation, move = geometry.so3_exp(change[:3]) @ rotation, move + change[3:6]
        value = value + change[6:]
        if not np.isfinite(value).all() or abs(value[0]) > 3.0:
            return None
        if np.abs(change[6:]).max() < 1e-4:
            break
    # A plane is explained by many poses together with as many intrinsics: those near the front-end's step alone count.
    if Pose(rotation, move).turned_from(step) > _TURNED_DEG:
        return None
    error = scale * np.sqrt(np.diagonal(np.linalg.inv(normal))[6:])
    return Change(signs, value, np.maximum(error, 1e-6))


def _project(
    rotation: FloatArray, move: FloatArray, ray: FloatArray, nearness: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rays (n, 2) of points seen from a step on, and their depths over those of before (n,)."""
    there = np.append(ray, np.ones((len(ray), 1)), axis=1) @ rotation.T + nearness[:, None] * move
    depth = np.where(np.abs(there[:, 2]) > 1e-3, there[:, 2], 1e-3)
    return there[:, :2] / depth[:, None], depth


def _slope(x: FloatArray, y: FloatArray) -> float:
    """Return the usual slope between points of the lower and of the upper half."""
    order, half = np.argsort(x), len(x) // 2
    low, high = order[:half], order[half : 2 * half]
    return float(np.median((y[high] - y[low]) / np.maximum(x[high] - x[low], 1e-12)))
