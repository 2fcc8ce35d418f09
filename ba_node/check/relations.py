# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Estimate how images stand to each other from their tracks alone."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import IntArray
from ba_node.check import two_view
from ba_node.check.tracks import Image, Tracks
from ba_node.check.two_view import MIN_PAIRS, Pair, Pose

# Keyframes that are looked at, and rays of two cameras.
_KEYFRAMES = 20
_MAX_RAYS = 800
# Keyframes between the images of one camera that are tried, widest first.
_GAPS = (8, 5, 3, 2, 1)
# A relation that is this far off the front-end's step is looked at twice, degrees: another one may explain as much. It
# takes its place if this share of the tracks that agree with that agree with it.
_FAR_DEG = 15.0
_AS_GOOD = 0.95
# Share of the tracks of two images that must agree with their best relation; where fewer do, outliers pull at whatever
# is estimated, and nothing but the usual mistakes of placement is told.
AGREED = 0.7
# Share of the rays of two images that another rig must leave, as no lens sees all that a pixel may be taken for.
_SEEN = 0.9


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
        good = two_view.explained(self.pair, pose)
        across = two_view.depths(self.pair, pose)[2][good]
        parallax = float(np.median(across) / self.pair.gate) if len(across) else 0.0
        return dataclasses.replace(self, pose=pose, share=float(good.mean()), parallax=parallax)

    def seen_by(self, tracks: Tracks) -> Relation | None:
        """Return the same images as other tracks with the same rows have them; None if many have no ray there."""
        good = np.isfinite(tracks.ray[self.rows_a]).all(axis=1) & np.isfinite(tracks.ray[self.rows_b]).all(axis=1)
        if good.mean() < _SEEN:
            return None
        rows_a, rows_b = self.rows_a[good], self.rows_b[good]
        pair = rays(tracks, (rows_a, rows_b))
        pose = two_view.refined(pair, tracks.between_cameras(self.a[1], self.b[1]))
        return dataclasses.replace(self, rows_a=rows_a, rows_b=rows_b, pair=pair).at(pose)

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
    found = Relation(a, b, *rows, pair, pose, 0.0, 0.0).at(pose)
    return found if a[0] < 0 else _nearer(found, tracks.between_images(a, b))


def _nearer(found: Relation, given: Pose) -> Relation:
    """Return the relation that is found from the front-end's step on, if it explains the tracks as well.

    Two relations explain the images of a plane, as of a wall beside the way (Longuet-Higgins, *The reconstruction of a
    plane surface from two perspective projections*, 1986), and a few points off the plane hardly choose between them.
    """
    off = _off(found.pose, given)
    if off < _FAR_DEG or not np.linalg.norm(given.translation) > 0.0:
        return found
    other = found.at(two_view.refined(found.pair, given))
    if other.share >= _AS_GOOD * found.share and _off(other.pose, given) < off:
        return other
    # Where what was given is mirrored, the other way round may lead to the better one of the two.
    back = found.at(two_view.refined(found.pair, Pose(given.rotation, -given.translation)))
    return back if back.share * _AS_GOOD > found.share else found


def _off(pose: Pose, given: Pose) -> float:
    """Return how far a relation is off the given one, degrees."""
    return float(np.nan_to_num(given.direction_from(pose), nan=0.0)) + 2.0 * given.turned_from(pose)


def rays(tracks: Tracks, rows: tuple[IntArray, IntArray]) -> Pair:
    """Return the rays of some matches; the gate is three sigma, but one pixel at least."""
    gate = max(max(tracks.px(part), 3.0 * tracks.sigma(part)) for part in rows)
    return Pair(tracks.ray[rows[0]], tracks.ray[rows[1]], gate)


def of_cameras(tracks: Tracks, camera: int, other: int = 0) -> Relation | None:
    """Return how a camera stands to another one by what both see in the same keyframes."""
    found = [tracks.match((k, other), (k, camera)) for k in spread(len(tracks), _KEYFRAMES)]
    rows_a, rows_b = (np.concatenate(part) for part in zip(*found, strict=True))
    pick = spread(len(rows_a), _MAX_RAYS)
    return relate(tracks, (-1, other), (-1, camera), (rows_a[pick], rows_b[pick]))


def shared_views(tracks: Tracks, camera: int) -> int:
    """Return how many observations of a camera are of points that camera 0 sees in the same keyframe, of some."""
    return sum(len(tracks.match((k, 0), (k, camera))[0]) for k in spread(len(tracks), _KEYFRAMES))


def in_motion(tracks: Tracks, of: int | None = None) -> list[Relation]:
    """Return how images of one camera stand to each other, over the recording; of the busiest camera by default."""
    main = [of if (k, of) in tracks.images else None for k in range(len(tracks))]
    if of is None:
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
