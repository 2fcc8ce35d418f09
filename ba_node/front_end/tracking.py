# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Track points from image to image, estimate the camera's pose by them, and measure them anew at keyframes.

Between keyframes features are followed from image to image, which is quick; where depths are measured some lead, and
the others are where the pose has them, as far off as they were. At a keyframe each is aligned with the
patch that it was first seen as, warped to how it should look from here, so that no error is handed on; points of the
map that were lost and should be in view are looked for in the same way, and come back under their old ids.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray, take_rows
from ba_node.config.front_end import FrontEndOptions
from ba_node.estimate import Transform
from ba_node.front_end import features, patches, pose
from ba_node.front_end.alignment import Pair, StereoAlignment
from ba_node.front_end.covariance import Lengths
from ba_node.front_end.depths import Depths, measure_depths
from ba_node.front_end.frame import Frame, inside
from ba_node.front_end.local_map import LocalMap, Warp
from ba_node.front_end.odometry import Step, step_of
from ba_node.front_end.rectify import IdealRig

# Correlation of a patch and what is found for it, below which it is another thing; and of one that was lost.
_SAME, _SAME_AGAIN = 0.7, 0.85
# How far from where the pose says a patch may be found: followed ones, lost ones, px.
_NEAR_PX, _AGAIN_PX = 4.0, 4.0
# Least sigma of one camera, px; and as it is told beside an odometry, whose lengths must not be bent by what all points
# of a track are off by alike, which no average of them makes smaller.
_ALONE_PX, _TOLD_PX = 0.5, 1.0
# Distance of features of one camera from their epipolar line, px.
_EPIPOLAR_PX = 1.0
# Patches are cut anew when they appear larger or smaller by this.
_ZOOM = 1.5
# Lost points that are looked for at once, newest first.
_LOOKED_FOR = 160
# Points of known depth that are followed from image to image, whose pose tells where the others are.
_LEADERS = 200
_IDENTITY = Transform(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Found:
    """The pose of an image."""

    camera_from_map: Transform
    covariance: FloatArray  # (6, 6) turn, place
    agree: int  # features that agree


@dataclass(frozen=True)
class Content:
    """What a keyframe saw."""

    track_id: IdArray  # (n,)
    uv: FloatArray  # (n, 2) in the first image, px
    sigma: FloatArray  # (n,) px
    depths: Depths  # of the same rows
    added: FloatArray  # (n,) how disparities were corrected, px


class Tracker:
    """Features that are followed, and the map of points behind them. All in the frame of the first ideal camera."""

    def __init__(self, rig: IdealRig, options: FrontEndOptions) -> None:
        self.rig, self.options = rig, options
        self.side = options.patch_px | 1
        self.map = LocalMap(rig, self.side)
        self.alignment = StereoAlignment(rig, options.stereo_yaw_px, options.stereo_roll_px)
        self.last: tuple[Content, Transform] | None = None  # of the last keyframe, with its pose
        self.rows: IntArray = np.empty(0, np.intp)  # points that are followed
        self.uv = np.empty((0, 2))  # where they are in the last image
        self.frame: Frame | None = None
        self.pose = _IDENTITY  # camera from map, of the last image
        self.sigma = np.empty(0)  # their standard deviations at the last keyframe, px
        self.given = False  # True where poses come from an odometry
        self.lengths = Lengths()  # of its steps
        self.leaders: IntArray = np.empty(0, np.intp)  # points of the last keyframe that are followed themselves
        self._behind = self.rows, self.uv  # the others, and how far they were from where the pose had them, px
        self.seen_step: Step | None = None  # to it, as one camera sees it without the odometry

    @property
    def scene_inverse_depth(self) -> float:
        """Return the median inverse depth of what is known, 1/m; 0 if nothing is."""
        w = self.map.inverse_depth[self.rows[self.map.known[self.rows]]]
        return float(np.median(w)) if len(w) else 0.0

    def follow(self, frame: Frame, expected: Transform | None) -> None:
        """Follow features to a new image, and keep those that are found.

        ``expected`` is camera from map, as foretold; None if nobody knows, and then all are followed. Otherwise it is
        the leaders, after whom :meth:`locate` brings the others.
        """
        assert self.frame is not None
        rows, uv, first = self.rows, self.uv, None
        self._behind = rows[:0], uv[:0]
        if expected is not None:
            before = self.map.seen_at(rows, self.pose, self.scene_inverse_depth)
            first = uv + np.nan_to_num(self.map.seen_at(rows, expected, self.scene_inverse_depth) - before)
            leads = np.isin(rows, self.leaders)
            self._behind = rows[~leads], (uv - before)[~leads]
            rows, uv, first = rows[leads], uv[leads], first[leads]
        uv, found = features.follow(self.frame.grey, frame.grey, uv, first)
        found &= inside(frame.allowed, uv)
        self.rows, self.uv, self.frame = rows[found], uv[found], frame

    def locate(self) -> Found | None:
        """Find the pose by the features that are followed now, and let go those that do not agree with it."""
        assert self.frame is not None
        known = self.map.known[self.rows]
        seen = self._seen(self.rows[known], self.uv[known], np.full(int(known.sum()), 0.5))
        found = pose.consensus(self.rig, seen, self.options.max_error_px)
        if found is None or found[1].sum() < self.options.min_points:
            return None
        start, agree = found
        refined, covariance, _ = pose.refine(self.rig, take_rows(seen, agree), start)
        keep = np.ones(len(self.rows), bool)
        keep[known] = self._agreeing(seen, refined)
        if keep[known].sum() < self.options.min_points:
            return None
        rows, off = self._behind
        uv = off + self.map.seen_at(rows, refined)
        there = inside(self.frame.allowed, uv)
        self.rows = np.concatenate([self.rows[keep], rows[there]])
        self.uv = np.concatenate([self.uv[keep], uv[there]])
        self.pose = refined
        return Found(refined, covariance, int(keep[known].sum()))

    def _seen(self, rows: IntArray, uv: FloatArray, sigma: FloatArray) -> pose.Seen:
        points, along = self.map.points(rows)
        return pose.Seen(points, uv, sigma, along)

    def _agreeing(self, seen: pose.Seen, camera_from_map: Transform) -> BoolArray:
        return pose.errors(self.rig, seen, camera_from_map) < self.options.max_error_px / 0.5

    def moved(self) -> tuple[float, float]:
        """Return how far leaders have moved since the last keyframe (median), px: turning left out, and in all."""
        leads = np.isin(self.rows, self.leaders)
        rows, uv = self.rows[leads], self.uv[leads]
        turned = Transform(self.pose.rotation, self.pose.rotation @ -self.map.position[-1])
        w = self.scene_inverse_depth
        moved = np.linalg.norm(uv - self.map.seen_at(rows, turned, w), axis=1)
        shift = np.linalg.norm(uv - self.map.seen_at(rows, self.keyframe_pose, w), axis=1)
        ok = np.isfinite(moved) & np.isfinite(shift)
        return (float(np.median(moved[ok])), float(np.median(shift[ok]))) if ok.any() else (0.0, 0.0)

    def begin(self, frame: Frame, camera_from_map: Transform = _IDENTITY) -> None:
        """Take a first image and where it was taken."""
        self.frame, self.pose = frame, camera_from_map

    def state(self) -> dict[str, Any]:
        """Return what :meth:`restore` undoes, what was done with images since, by."""
        return {name: getattr(self, name) for name in ("rows", "uv", "frame", "pose")}

    def restore(self, before: Mapping[str, Any]) -> None:
        """Be again as before an image."""
        vars(self).update(before)

    @property
    def keyframe_pose(self) -> Transform:
        """Return camera from map of the last keyframe."""
        return Transform(self.map.rotation[-1], self.map.position[-1]).inverse()

    def locate_by(self, expected: Transform) -> Found | None:
        """Take a pose from elsewhere; let go features that contradict each other."""
        self.pose, self.given = expected, True
        known = self.map.known[self.rows]
        keep = np.ones(len(self.rows), bool)
        if known.sum() >= 2 * self.options.min_points:
            seen = self._seen(self.rows[known], self.uv[known], np.full(int(known.sum()), 0.5))
            found = pose.consensus(self.rig, seen, self.options.max_error_px)
            if found is not None:
                keep[known] = found[1]
        self.rows, self.uv = self.rows[keep], self.uv[keep]
        if len(self.rows) < self.options.min_points:
            return None
        return Found(expected, np.full((6, 6), np.nan), len(self.rows))

    def begin_alone(self, shift_px: float) -> bool:
        """Set the pose of the last image against the first keyframe, of one camera alone, the step being 1 long.

        Returns False, and changes nothing, until features have moved so far (median), turning left out.
        """
        first = self.map.uv[self.rows]
        found = pose.relative(self.rig, first, self.uv, self.options.max_error_px)
        if found is None:
            return False
        step, agree = found
        turned = self.rig.pixels(self.rig.rays(first) @ step.rotation.T)
        moved = np.linalg.norm(self.uv - turned, axis=1)[agree]
        if len(moved) < 2 * self.options.min_points or not np.nanmedian(moved) > shift_px:
            return False
        self.rows, self.uv = self.rows[agree], self.uv[agree]
        self.pose = step.after(self.keyframe_pose)
        return True

    def refine(self, there: Mapping[int, Transform]) -> Transform | None:
        """Move keyframes, by id, to map from camera; later ones follow. Returns how the last image moved in the map."""
        last = None
        for place, key in enumerate(self.map.keyframe_id):
            if key in there:
                old = Transform(self.map.rotation[place], self.map.position[place])
                last = there[key].after(old.inverse())
                new = there[key]
            elif last is not None:
                new = last.after(Transform(self.map.rotation[place], self.map.position[place]))
            else:
                continue
            self.map.rotation[place], self.map.position[place] = new.rotation, new.translation
        if last is not None:
            self.pose = self.pose.after(last.inverse())
            if self.last is not None:
                self.last = self.last[0], self.keyframe_pose
        return last

    def keyframe(self, keyframe_id: int) -> tuple[Content, Found | None]:
        """Make the last image a keyframe: measure all that it sees, fill up with new features."""
        frame = self.frame
        assert frame is not None
        found = self._align(frame)
        self._look_for_lost(frame)
        if frame.right is None and frame.depth is None:
            self._agree_in_pairs()
            wrong = self.map.triangulate(self.rows, self.uv, self.sigma, self.pose, self.options.max_error_px)
            self.rows, self.uv, self.sigma = self.rows[~wrong], self.uv[~wrong], self.sigma[~wrong]
        place = self.map.add_keyframe(keyframe_id, self.pose)
        old = len(self.rows)
        border = self.side // 2 + 2
        fresh_uv = features.corners(frame.grey, frame.allowed, self.uv, self.options.max_features, border)
        uv = np.concatenate([self.uv, fresh_uv])
        sigma = np.concatenate([self.sigma, np.full(len(fresh_uv), self._floor_px(frame))])
        first = np.full(len(uv), np.nan)
        warp = self.map.warp(self.rows, self.pose)
        known = self.map.known[self.rows]
        first[:old] = np.where(known, 1.0 / warp.depth, np.nan)
        depths = measure_depths(frame, self.rig, uv, first, self.side, self.alignment)
        keep = np.ones(len(uv), bool)
        if depths.measures:
            keep[old:] = depths.found[old:]
        fresh_rows = self.map.add(place, uv[old:][keep[old:]], patches.cut(frame.soft, uv[old:][keep[old:]], self.side))
        rows = np.concatenate([self.rows, fresh_rows])
        uv, sigma, depths = uv[keep], sigma[keep], take_rows(depths, keep)
        fresh = np.arange(len(rows)) >= old
        self._renew(frame, place, rows, uv, depths, fresh)
        self.map.last_seen[rows] = place
        self.rows, self.uv = rows, uv
        added = self.alignment.disparity(uv)
        told = np.maximum(sigma, _TOLD_PX) if self.given else sigma
        content = Content(self.map.track_id[rows], uv, told, depths, added)
        if self.options.stereo_align and depths.measures and frame.right is not None:
            self._learn(content)
        self.last = content, self.pose
        new = self.map.forget()
        self.rows = new[self.rows]
        known = self.map.known[self.rows] if depths.measures else np.zeros(len(self.rows), bool)
        spread = np.cumsum(known) % max(1, int(known.sum()) // _LEADERS) == 0
        self.leaders = self.rows[~known | spread]
        return content, found

    @property
    def share(self) -> float:
        """Return which share of the features of the last keyframe is still followed."""
        return float(np.isin(self.leaders, self.rows).mean()) if len(self.leaders) else 0.0

    def _learn(self, content: Content) -> None:
        """Learn from the last two keyframes how the second camera is turned, and put the map right by that."""
        if self.last is None:
            return
        before, pose_before = self.last
        _, i, j = np.intersect1d(before.track_id, content.track_id, return_indices=True)
        seen = before.depths.found[i]
        i, j = i[seen], j[seen]
        added = self.alignment.disparity(before.uv[i])
        of = before.depths
        raw = of.disparity[i] - before.added[i]
        pair = Pair(before.uv[i], content.uv[j], raw + added, of.disparity_sigma[i], content.sigma[j])
        change = self.alignment.learn_turn(pair, self.pose.after(pose_before.inverse()))
        if change.any():
            by = self.alignment.basis(self.map.uv) @ change
            self.map.inverse_depth += by / (self.rig.focal * self.rig.baseline)

    def _align(self, frame: Frame) -> Found | None:
        """Align what is followed with its patches; refine the pose by that."""
        warp = self.map.warp(self.rows, self.pose, self.scene_inverse_depth)
        uv, sigma, good = self._aligned(frame, self.rows, self.uv, warp, _SAME, _NEAR_PX)
        self.rows, self.uv, self.sigma = self.rows[good], uv[good], sigma[good]
        known = self.map.known[self.rows]
        if known.sum() < self.options.min_points:
            return None
        seen = self._seen(self.rows[known], self.uv[known], self.sigma[known])
        if self.given:
            # What the odometry is off shows in every feature: only those that are far from the others are wrong.
            size = pose.errors(self.rig, seen, self.pose)
            size = size * min(1.0, 2.0 / max(float(np.median(size)), 1e-9))
            self.lengths.compare(self.keyframe_pose, self.pose, pose.refine(self.rig, seen, self.pose)[0])
            refined, covariance = self.pose, np.full((6, 6), np.nan)
        else:
            refined, covariance, size = pose.refine(self.rig, seen, self.pose)
        keep = np.ones(len(self.rows), bool)
        keep[known] = size < 5.0
        self.pose = refined
        self.rows, self.uv, self.sigma = self.rows[keep], self.uv[keep], self.sigma[keep]
        return Found(refined, covariance, int((size < 5.0).sum()))

    def _aligned(
        self, frame: Frame, rows: IntArray, uv: FloatArray, warp: Warp, least: float, near_px: float
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return where points are in an image, to what sigma, and which are there; from first places and warps."""
        if not len(rows):
            return uv, np.empty(0), np.zeros(0, bool)
        affine = np.where(np.isfinite(warp.affine), warp.affine, np.eye(2))
        bend = np.nan_to_num(np.clip(warp.bend, -0.05, 0.05))
        found = patches.align(self.map.patch[rows], frame.soft, uv, affine, bend)
        sigma = np.sqrt(np.maximum(np.trace(found.covariance, axis1=1, axis2=2), 0.0) / 2.0)
        sigma = np.hypot(sigma, self._floor_px(frame))
        height, width = frame.grey.shape
        half = self.side // 3
        good = (found.uv >= half).all(axis=1) & (found.uv <= [width - 1 - half, height - 1 - half]).all(axis=1)
        good &= (found.correlation > least) & (np.linalg.norm(found.uv - uv, axis=1) < near_px)
        good &= inside(frame.allowed, found.uv)
        return found.uv, sigma, good

    def _floor_px(self, frame: Frame) -> float:
        """Return the least sigma; more for one camera alone, which does not know how surfaces are slanted."""
        alone = frame.right is None and frame.depth is None
        return max(self.options.sigma_px, _ALONE_PX) if alone else self.options.sigma_px

    def _agree_in_pairs(self) -> None:
        """Let go features that do not move as the others since the last keyframe: epipolar geometry, by consensus."""
        self.seen_step = None
        if self.last is None:
            return
        before = self.last[0]
        _, i, j = np.intersect1d(before.track_id, self.map.track_id[self.rows], return_indices=True)
        found = pose.relative(self.rig, before.uv[i], self.uv[j], _EPIPOLAR_PX)
        if found is None or found[1].mean() < 0.5:
            return
        self.seen_step = step_of(self.rig, found[0], before.uv[i][found[1]], self.uv[j][found[1]], has_length=False)
        keep = np.ones(len(self.rows), bool)
        keep[j[~found[1]]] = False
        self.rows, self.uv, self.sigma = self.rows[keep], self.uv[keep], self.sigma[keep]

    def _look_for_lost(self, frame: Frame) -> None:
        """Look for points of the map that are not followed and should be in view."""
        free = self.map.known.copy()
        free[self.rows] = False
        rows = np.flatnonzero(free)
        if not len(rows):
            return
        height, width = frame.grey.shape
        margin, uv = self.side // 2, self.map.seen_at(rows, self.pose)
        rows = rows[((uv > margin) & (uv < [width - margin, height - margin])).all(axis=1)]
        warp = self.map.warp(rows, self.pose)
        scale = warp.scale
        rows_of = np.flatnonzero((scale > 0.5) & (scale < 2.0))
        rows_of = rows_of[np.argsort(-self.map.last_seen[rows[rows_of]], kind="stable")[:_LOOKED_FOR]]
        rows_of = rows_of[inside(frame.allowed, warp.uv[rows_of])]
        rows, warp = rows[rows_of], take_rows(warp, rows_of)
        uv, sigma, good = self._aligned(frame, rows, warp.uv, warp, _SAME_AGAIN, _AGAIN_PX)
        if not good.any():
            return
        rows, uv, sigma = rows[good], uv[good], sigma[good]
        size = pose.errors(self.rig, self._seen(rows, uv, sigma), self.pose)
        keep = size < 5.0
        room = max(0, self.options.max_features - len(self.rows))
        chosen = np.flatnonzero(keep)[:room]
        self.rows = np.concatenate([self.rows, rows[chosen]])
        self.uv = np.concatenate([self.uv, uv[chosen]])
        self.sigma = np.concatenate([self.sigma, sigma[chosen]])

    def _renew(
        self, frame: Frame, place: int, rows: IntArray, uv: FloatArray, depths: Depths, fresh: BoolArray
    ) -> None:
        """Put depths into the map; cut patches anew that look too different from here."""
        at = np.flatnonzero(fresh & depths.found)
        self.map.place(rows[at], depths.inverse_depth[at], depths.sigma[at], depths.slant[at])
        old = np.flatnonzero(~fresh & depths.found)
        if not len(old):
            return
        now = self.map.warp(rows[old], self.pose)
        zoomed = (now.scale > _ZOOM) | (now.scale < 1.0 / _ZOOM)
        again = old[zoomed]
        self.map.move(rows[again], place, uv[again], patches.cut(frame.soft, uv[again], self.side))
        self.map.place(rows[again], depths.inverse_depth[again], depths.sigma[again], depths.slant[again])
