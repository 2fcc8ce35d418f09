# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check that a track goes on being the same point."""

from __future__ import annotations

import numpy as np

from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding, Row
from ba_node.check.relations import AGREED, relate, spread
from ba_node.check.tracks import Tracks

# Images that far apart, in keyframes, share tracks; where ids are used again, fewer of them are the same point.
_FAR = 4
_STARTS = 8
_LOST = 0.9
# Keyframes that are needed to judge ids; share of the ids of the last quarter that the first one had.
_KEYFRAMES = 10
_PERSIST = 0.85
# Images at least that far apart, in keyframes, which share ids; so many pairs of them are compared. Less than this part
# of near images' agreement is what different points come to.
_APART = 8
_DISTANT = 5
_OTHER_POINTS = 0.6
# Different points agree by chance to less than this share.
_CHANCE = 0.3
# Keyframes across which rays jump farthest are those from which ids may stand for other points; so many beside agree.
# Fewer keyframes with wrong ids are left out by solves.
_TRIED = 4
_LASTING = 6
# As many ids in all as one image has tracks, but for this factor, are numbers of rows or places.
_PLACES = 1.5


def check_ids(tracks: Tracks) -> Diagnosis:
    """Look whether a track goes on being the same point: by consensus of neighbouring images, and of distant ones.

    Where ids are used again, few new ones come, although tracks end.
    """
    if len(tracks) < _KEYFRAMES:
        return Diagnosis(untold=["too few keyframes to judge ids"])
    near, far = _along(tracks)
    quarter = max(1, len(tracks) // 4)
    early = np.unique(tracks.track[tracks.keyframe < quarter])
    late = tracks.track[tracks.keyframe >= len(tracks) - quarter]
    persist = float(np.isin(late, early).mean()) if len(late) else 0.0
    again = _distant(tracks)
    rows = [Row("ids", "images next to each other", near), Row("ids", f"images {_FAR} keyframes apart", far)]
    rows += [Row("ids", "images far apart that share ids", again)]
    rows += [Row("ids", "of the last keyframes that the first had too", persist)]
    rows = [row for row in rows if np.isfinite(row.share)]
    ids, most = len(np.unique(tracks.track)), max(len(part) for part in tracks.images.values())
    as_places = ids <= _PLACES * most and persist >= _PERSIST
    if as_places and not near >= _CHANCE:
        evidence = f"there are {ids} of them in all, an image has up to {most} tracks, and images do not agree on them"
        return Diagnosis([_reused(evidence)], rows=rows)
    if np.isnan(near):
        return Diagnosis(untold=["too few long tracks to judge ids"])
    if near < AGREED:
        return Diagnosis(untold=["too many outliers to judge ids"], rows=rows)
    since = _others_since(tracks)
    if since is not None:
        evidence = f"{near:.0%} of the tracks agree from one keyframe to the next, next to none across that one"
        cause = f"track ids stand for other points from stamp {tracks.stamp_ns[since] * 1e-9:.3f} s on"
        change = "track_id in the feature_tracks: a tracker that begins anew counts on, or raises session_id"
        return Diagnosis(
            [Finding((cause,), evidence, (change,), usual=True, since_ns=int(tracks.stamp_ns[since]))], rows=rows
        )
    if again < _OTHER_POINTS * near or (far < _LOST * near and persist >= _PERSIST):
        evidence = (
            f"{near:.0%} of the tracks agree from one keyframe to the next, {far:.0%} over {_FAR},"
            f" and {persist:.0%} of the ids of the first keyframes are in the last"
        )
        return Diagnosis([_reused(evidence if np.isnan(again) else f"{evidence}; far apart {again:.0%}")], rows=rows)
    return Diagnosis(sound=["tracks keep their ids"], rows=rows)


def _along(tracks: Tracks) -> tuple[float, float]:
    """Return the share of tracks that agree from one image to the next, and over some; NaN where few images tell."""
    near, far = [], []
    for k in spread(len(tracks) - _FAR, _STARTS):
        camera = tracks.main_camera(k)
        if camera is None:
            continue
        pairs = [
            relate(tracks, (int(k), camera), (int(k + gap), camera), tracks.match((k, camera), (k + gap, camera)))
            for gap in (1, _FAR)
        ]
        if pairs[0] is not None and len(tracks.match((k, camera), (k + _FAR, camera))[0]) >= two_view.MIN_PAIRS:
            near.append(pairs[0].share)
            far.append(0.0 if pairs[1] is None else pairs[1].share)
    return (float(np.median(near)), float(np.median(far))) if len(near) >= 3 else (float("nan"), float("nan"))


def _others_since(tracks: Tracks) -> int | None:
    """Return the keyframe from which on all ids stand for other points than before; None if there is none."""
    jumps: list[tuple[float, int, int]] = []
    for k in range(1, len(tracks)):
        camera = tracks.main_camera(k)
        rows = tracks.match((k - 1, camera or 0), (k, camera or 0))
        # Mismatches alone make few that are shared disagree.
        if camera is not None and len(rows[0]) >= 2 * two_view.MIN_PAIRS:
            off = np.linalg.norm(tracks.ray[rows[0]] - tracks.ray[rows[1]], axis=1)
            jumps.append((float(np.median(off)), k, camera))

    def agree(k: int, camera: int) -> float:
        rows = tracks.match((k - 1, camera), (k, camera))
        if len(rows[0]) < two_view.MIN_PAIRS:
            return 0.0
        pair = relate(tracks, (k - 1, camera), (k, camera), rows)
        return 0.0 if pair is None else pair.share

    for _, k, camera in sorted(jumps, reverse=True)[:_TRIED]:
        beside = [one for one in range(max(1, k - _LASTING), min(len(tracks), k + _LASTING + 1)) if one != k]
        if agree(k, camera) < _CHANCE and all(agree(one, camera) >= _CHANCE for one in beside):
            return k if k <= len(tracks) - _LASTING else None
    return None


def _distant(tracks: Tracks) -> float:
    """Return the share of the ids common to images far apart that agree; NaN where such images share few."""
    found: list[tuple[int, int, int, int]] = []
    for k in spread(len(tracks) - _APART, _STARTS):
        camera = tracks.main_camera(k)
        if camera is None:
            continue
        others = k + _APART + spread(len(tracks) - _APART - k, _STARTS)
        counts = [len(tracks.match((k, camera), (int(other), camera))[0]) for other in others]
        best = int(np.argmax(counts))
        found.append((counts[best], int(k), int(others[best]), camera))
    shares = []
    for count, k, other, camera in sorted(found, reverse=True)[:_DISTANT]:
        if count >= 2 * two_view.MIN_PAIRS:
            pair = relate(tracks, (k, camera), (other, camera), tracks.match((k, camera), (other, camera)))
            shares.append(0.0 if pair is None else pair.share)
    return float(np.median(shares)) if len(shares) >= 3 else float("nan")


def _reused(evidence: str) -> Finding:
    return Finding(
        ("ids reused: the same track_id stands for several points",),
        evidence,
        ("track_id in the feature_tracks: a new id for each point, never one of an ended track",),
        harmful=False,
    )
