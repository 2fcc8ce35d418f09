# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask whether two cameras that contradict each other saw the scene at different times.

A camera that is exposed t seconds after camera 0 is where the body has got to by then. So its relation to camera 0
differs from keyframe to keyframe as the body moves; one of a camera that is off its place does not. Each is fitted to
the tracks that both see, with the same loss: whichever explains them better is named, both where it is the same, as
where a robot goes straight on. Steps are those of the front-end, at constant velocity.

It is asked only where something was found to be wrong, or many tracks of both cameras do not meet: the cameras of many
rigs are a little late, and no harm is done.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.relations import rays, spread
from ba_node.check.tracks import Tracks
from ba_node.check.two_view import Pair, Pose
from ba_node.core import geometry
from ba_node.core.loss import robust_spread

_KEYFRAMES, _MAX_CAMERAS, _LEAST_RAYS = 20, 8, 200
# Delays that are tried: up to a keyframe's distance, and so many s; so many, in rounds that look closer.
_MOST_S, _TRIED, _CLOSER, _ROUNDS = 0.3, 31, 11, 3
# By how much the sum of losses is lower with a delay, at least; and how many times as much as with another place of the
# camera for it to be named too, and alone.
_SURE, _AS_GOOD, _BETTER = 40.0, 0.8, 1.25
# Where no test has found anything, so many times fewer tracks have to meet as given, and less than such a share.
_PLAIN, _DOUBTFUL = 0.9, 0.95
# Smaller delays are not named, s.
_LEAST_S = 0.001


def find_late(tracks: Tracks, found: Diagnosis) -> Diagnosis:
    """Return what a test of cameras found, with a delay in the place of it, or beside it, if it is, or may be, that.

    Where the test found nothing wrong, the delay has to make many more tracks meet.
    """
    for camera in range(1, min(len(tracks.cameras.model), 1 + _MAX_CAMERAS)):
        both = _Both(tracks, camera)
        late = both.late() if found.harmful or both.doubtful else None
        if late is None or not (found.harmful or late.plain):
            continue
        finding = late.finding
        if not late.alone:
            others = [one for one in found.findings if one.harmful]
            causes = tuple(cause for one in (finding, *others) for cause in one.causes)
            changes = tuple(change for one in (finding, *others) for change in one.changes)
            finding = dataclasses.replace(finding, causes=causes, changes=changes, since_ns=found.since_ns)
        rest = [one for one in found.findings if not one.harmful]
        return dataclasses.replace(found, findings=[finding, *rest], untold=[])
    return found


class _Late(NamedTuple):
    """A delay that explains tracks."""

    finding: Finding
    alone: bool  # nothing else explains them nearly as well
    plain: bool  # and many more tracks meet with it


class _Both:
    """Camera 0 and another one, which may be exposed later."""

    def __init__(self, tracks: Tracks, camera: int) -> None:
        self._tracks, self._camera = tracks, camera
        matched = ((int(k), tracks.match((k, 0), (k, camera))) for k in spread(len(tracks) - 1, _KEYFRAMES))
        self._seen = [(k, rays(tracks, rows)) for k, rows in matched if len(rows[0])]
        self._gate = float(np.median([pair.gate for _, pair in self._seen])) if self._seen else 0.0

    @property
    def doubtful(self) -> bool:
        """Return True if many tracks do not meet as given."""
        return bool(self._seen) and float(np.mean(np.abs(self._residuals(0.0)) < self._gate)) < _DOUBTFUL

    def late(self) -> _Late | None:
        """Return the delay that explains the tracks better than nothing and no worse than another place; or None."""
        most_s = min(_MOST_S, float(np.median(np.diff(self._tracks.stamp_ns))) * 1e-9)
        if sum(len(pair) for _, pair in self._seen) < _LEAST_RAYS or not most_s > _LEAST_S:
            return None
        noise = self._gate / 3.0
        tried, reach_s, best_s = np.linspace(-most_s, most_s, _TRIED), most_s, 0.0
        for _ in range(_ROUNDS):
            losses = [_loss(self._residuals(by_s), noise) for by_s in tried]
            best_s, reach_s = float(tried[int(np.argmin(losses))]), 2.0 * reach_s / (len(tried) - 1)
            tried = np.linspace(best_s - reach_s, best_s + reach_s, _CLOSER)
        given, delayed = (self._residuals(by_s) for by_s in (0.0, best_s))
        elsewhere = self._elsewhere()
        # Whichever explains them, among outliers, tells how noisy they are.
        noise = max(min(float(robust_spread(delayed)), float(robust_spread(elsewhere))), 1e-9)
        if noise > self._gate:
            return None  # of mostly outliers, which lie nearer to some lines than to others
        loss = _loss(given, noise)
        gain, otherwise = loss - _loss(delayed, noise), loss - _loss(elsewhere, noise)
        if abs(best_s) < _LEAST_S or gain < max(_SURE, _AS_GOOD * otherwise):
            return None
        meet, undone = (float(np.mean(np.abs(one) < 3.0 * noise)) for one in (given, delayed))
        cause = (
            f"camera {self._camera} is not synchronised with camera 0: its images are exposed about"
            f" {1e3 * abs(best_s):.0f} ms {'after' if best_s > 0.0 else 'before'} those of camera 0"
        )
        evidence = f"of the tracks of both {meet:.0%} meet as given, {undone:.0%} with that undone, as the body moves"
        change = "the trigger of the cameras, or which of their images go into one keyframe: those of one stamp"
        alone = gain > _BETTER * otherwise
        return _Late(Finding((cause,), evidence, (change,)), alone, alone and meet < _PLAIN * undone)

    def _residuals(self, by_s: float) -> FloatArray:
        """Return Sampson's distances of all tracks, the second camera exposed so many s later."""
        return np.concatenate([two_view.residuals(pair, self._pose(k, by_s)) for k, pair in self._seen])

    def _pose(self, k: int, by_s: float) -> Pose:
        """Return the camera from camera 0 in a keyframe, where the body has got to so many s later."""
        tracks, rig = self._tracks, self._tracks.cameras
        first = k if by_s >= 0.0 or k == 0 else k - 1
        share = by_s / max(float(tracks.stamp_ns[first + 1] - tracks.stamp_ns[first]) * 1e-9, 1e-9)
        one = np.array([first])
        turn, move = geometry.steps_between(tracks.rotation, tracks.position, one, one + 1)
        turned = geometry.so3_exp(share * geometry.so3_log(turn))[0]
        moved = share * (move[0] if first == k else turn[0].T @ move[0])
        from_first = geometry.inverse(rig.rotation[0], rig.translation[0])
        then = geometry.compose(*geometry.inverse(turned, moved), *from_first)
        return Pose(*geometry.compose(rig.rotation[self._camera], rig.translation[self._camera], *then))

    def _elsewhere(self) -> FloatArray:
        """Return the distances with the camera where it explains the tracks best in all keyframes alike."""
        parts = (np.concatenate([getattr(pair, name) for _, pair in self._seen]) for name in "ab")
        whole, given = (
            Pair(next(parts), next(parts), self._seen[0][1].gate),
            self._tracks.between_cameras(0, self._camera),
        )
        starts = given, two_view.estimate(whole) or given
        found = [two_view.residuals(whole, two_view.refined(whole, pose)) for pose in starts]
        return min(found, key=lambda one: _loss(one, whole.gate))


def _loss(residuals: FloatArray, noise: float) -> float:
    """Return the sum of Cauchy's losses."""
    return float(np.sum(np.log1p((residuals / noise) ** 2)))
