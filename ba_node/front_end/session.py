# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Go through one map's images: the pose of each, which are keyframes, and what is told of these."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.config.front_end import FrontEndOptions
from ba_node.core import geometry
from ba_node.estimate import Cloud, Poses, Transform
from ba_node.front_end import covariance
from ba_node.front_end.frame import Frame
from ba_node.front_end.odometry import Step, step_of
from ba_node.front_end.records import Images, State, Tracked
from ba_node.front_end.rectify import IdealRig
from ba_node.front_end.tracking import Content, Found, Tracker
from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses, Measurement

_IDENTITY = Transform(np.eye(3), np.zeros(3))
# Features have moved by less than this (median): nothing moves, px.
_STANDS_PX = 0.5
# One camera alone begins once features have moved this far by its motion (median), px.
_START_PX = 20.0


class Session:
    """A tracker, and what is told of it in the fixed frame. It begins with its first image."""

    def __init__(
        self, ideal: IdealRig, options: FrontEndOptions, number: int, fixed_frame: str, odometry: Transform | None
    ) -> None:
        self.number, self.options = number, options
        self.tracker = Tracker(ideal, options)
        self.lost = 0  # images in a row without a pose
        self.unseen = 0  # images without a pose since the last keyframe
        self.scale = ""  # what tells lengths: measured, odometry, or free: one camera without either
        # What was taken until it is known how the second camera is turned: arguments of ``FrontEnd._track``.
        learns = options.stereo_align and ideal.baseline
        self.first_images: list[tuple[Images, Transform | None, float, bool]] | None = [] if learns else None
        self._ideal, self._fixed_frame = ideal, fixed_frame
        self._motion = _IDENTITY  # camera now from camera at the image before
        self._keyframe_pose: Transform | None = None  # fixed frame from body at the last keyframe
        self._waiting: Content | None = None  # first keyframe of one camera alone, until it has moved
        self._waiting_ns = 0
        self._fixed_from_map = _IDENTITY  # changes when the map is refined, so that published poses do not
        self._odometry = odometry  # at the last image that had a pose
        self.step: Step | None = None  # to the last keyframe as images alone see it, where there is an odometry
        self.keyframes = 0
        self._rest = (0, np.empty(0, np.uint64), np.empty((0, 2)))  # since when nothing moves; ids of features, where
        self._known_id = 0  # points up to this id were told as guesses

    def begin(self, frame: Frame) -> Content:
        """Take the first image; return what it shows."""
        place = (self._odometry or _IDENTITY).after(self._ideal.body_from_camera)
        self.tracker.begin(frame, place.inverse())
        return self.tracker.keyframe(1)[0]

    def first(self, images: Images, content: Content) -> Tracked:
        """Tell of the first image, a keyframe; one camera alone tells of it once it has moved."""
        self.scale = "measured" if content.depths.measures else "free" if self._odometry is None else "odometry"
        if self.scale != "free":
            return self._keyframe(images, content)
        self._waiting, self._waiting_ns = content, images.stamp_ns
        return self.told(State.STARTING, images)

    @property
    def has_begun(self) -> bool:
        """Return False while nothing was told of it."""
        return self._waiting is None

    def wait(self, images: Images, frame: Frame) -> Tracked | None:
        """Begin with one camera alone, once it has moved; None where too little of the first image is left."""
        tracker, first = self.tracker, self._waiting
        assert first is not None
        tracker.follow(frame, None)
        if len(tracker.rows) < max(self.options.min_points, len(first.track_id) // 3):
            return None
        if not tracker.begin_alone(_START_PX):
            return self.told(State.STARTING, images)
        earlier = self._measurements(self._waiting_ns, first, self._body(tracker.keyframe_pose))
        self._waiting = None
        content, _ = tracker.keyframe(self.keyframes + 1)
        return self._keyframe(images, content, earlier)

    def take(
        self, images: Images, frame: Frame, odometry: Transform | None, *, gap: bool, sure: bool
    ) -> Tracked | None:
        """Find the pose of an image, and make it a keyframe if it is worth it; None where it is lost.

        Args:
            images: of the image.
            frame: the same as ideal cameras see it.
            odometry: fixed frame from body at its time, if there is one.
            gap: a long time has passed since the image before.
            sure: its stamp is to be trusted; without that it is no keyframe.
        """
        found = self._locate(frame, odometry, gap)
        if found is None:
            return None
        self.lost = 0
        moved, shift = self.tracker.moved()
        o = self.options
        still = moved < o.keyframe_parallax_px and self.tracker.share >= o.keyframe_min_shared and not self.unseen
        if still or not sure:
            state = State.STANDING if shift < _STANDS_PX else State.TRACKING
            return self.told(state, images, found, odometry)
        before = self.tracker.last
        content, refined = self.tracker.keyframe(self.keyframes + 1)
        if odometry is not None and before is not None:
            self.step = self.tracker.seen_step if self.tracker.given else self._measured_step(*before, content)
        return self._keyframe(images, content, (), refined or found, odometry)

    def _measured_step(self, before: Content, there: Transform, content: Content) -> Step:
        """Return the step from a keyframe to the last image, where depths tell both poses."""
        _, i, j = np.intersect1d(before.track_id, content.track_id, return_indices=True)
        motion = self.tracker.pose.after(there.inverse())
        return step_of(self._ideal, motion, before.uv[i], content.uv[j], has_length=True)

    def _expected(self, odometry: Transform | None) -> Transform:
        """Return camera from map as foretold, by odometry or by going on as before."""
        tracker = self.tracker
        if odometry is None or self._odometry is None:
            return self._motion.after(tracker.pose)
        step = odometry.inverse().after(self._odometry)  # body now from body before
        body = self._ideal.body_from_camera
        return body.inverse().after(step).after(body).after(tracker.pose)

    def _locate(self, frame: Frame, odometry: Transform | None, gap: bool) -> Found | None:
        """Find the pose of an image; leave everything as it was if that fails."""
        tracker = self.tracker
        before, expected = tracker.state(), self._expected(odometry)
        blind = (gap or self.lost > 0) and odometry is None
        for first in (None,) if blind else (expected, None):
            tracker.follow(frame, first)
            if odometry is not None and frame.right is None and frame.depth is None:
                found = tracker.locate_by(expected)
            else:
                found = tracker.locate()
            if found is not None:
                self._motion = _IDENTITY if self.lost else tracker.pose.after(before["pose"].inverse())
                self._odometry = odometry
                return found
            tracker.restore(before)
        return None

    def _body(self, camera_from_map: Transform) -> Transform:
        """Return fixed frame from body of a camera in the map."""
        camera = self._fixed_from_map.after(camera_from_map.inverse())
        return camera.after(self._ideal.body_from_camera.inverse())

    def _keyframe(
        self,
        images: Images,
        content: Content,
        earlier: tuple[Measurement, ...] = (),
        found: Found | None = None,
        odometry: Transform | None = None,
    ) -> Tracked:
        """Tell of an image that was made a keyframe."""
        told = self.told(State.TRACKING, images, found, odometry)
        assert told.pose is not None
        keyframe, *tracks = self._measurements(images.stamp_ns, content, told.pose)
        assert isinstance(keyframe, Keyframe)
        return dataclasses.replace(
            told,
            keyframe=keyframe,
            tracks=tuple(one for one in tracks if isinstance(one, FeatureTracks)),
            guesses=self._guesses(content),
            earlier=earlier,
        )

    def told(
        self, state: State, images: Images, found: Found | None = None, odometry: Transform | None = None
    ) -> Tracked:
        """Return what is known of an image that is no keyframe."""
        pose, uncertain = None, np.full((6, 6), np.nan)
        if self.has_begun:
            pose = self._body(self.tracker.pose)
            uncertain = covariance.of_lost(self.lost)
            if found is not None:
                fixed_from_camera = self._fixed_from_map.rotation @ self.tracker.pose.rotation.T
                uncertain = covariance.of_tracked(found.covariance, fixed_from_camera)
        if odometry is not None and not self._ideal.baseline and images.depth_m is None:
            pose = odometry
        since = None if state is State.LOST else self._still_since(images.stamp_ns)
        return Tracked(state, self.number, images.stamp_ns, pose, uncertain, still_since_ns=since)

    def _still_since(self, stamp_ns: int) -> int:
        """Return the stamp of the first image since which features are where they were, as by now; ns."""
        tracker = self.tracker
        ids, uv = tracker.map.track_id[tracker.rows], tracker.uv
        since, ids_then, uv_then = self._rest
        _, i, j = np.intersect1d(ids, ids_then, return_indices=True)
        if not len(i) or np.median(np.linalg.norm(uv[i] - uv_then[j], axis=1)) >= _STANDS_PX:
            self._rest = since, _, _ = stamp_ns, ids, uv
        return since

    def _measurements(self, stamp_ns: int, content: Content, pose: Transform) -> tuple[Measurement, ...]:
        """Return keyframe and tracks, in pixels of the raw images."""
        self.keyframes += 1
        ideal, session, number = self._ideal, self.number, self.keyframes
        orientation = geometry.quaternion_from_matrix(pose.rotation)
        told = self._step_covariance(pose)
        keyframe = Keyframe(session, number, stamp_ns, self._fixed_frame, pose.translation, orientation, told)
        depths = content.depths
        depth_m = np.empty(0)
        stereo = np.isfinite(depths.disparity)
        if depths.measures and not stereo.any():
            depth_m = 1.0 / depths.inverse_depth
        raw = ideal.raw(0, content.uv)
        left = FeatureTracks(session, number, 0, content.track_id, raw, content.sigma, depth_m)
        if not stereo.any():
            return keyframe, left
        there = content.uv[stereo] - np.column_stack([depths.disparity[stereo], np.zeros(int(stereo.sum()))])
        # A disparity is between both images, and both are off by sigma: the second bears what is more than the first's.
        sigma = np.hypot(depths.disparity_sigma[stereo], self.options.sigma_px)
        right = FeatureTracks(session, number, 1, content.track_id[stereo], ideal.raw(1, there), sigma)
        return keyframe, left, right

    def _step_covariance(self, pose: Transform) -> np.ndarray:
        """Return the covariance of the step to a keyframe, (36,); (0,) where it is what images that see well give."""
        before, unseen = self._keyframe_pose, self.unseen
        self._keyframe_pose, self.unseen = pose, 0
        if before is None:
            return np.empty(0)
        if self.tracker.given:
            return covariance.of_step(before.inverse().after(pose), self.tracker.lengths.noise).reshape(-1)
        return covariance.of_lost(unseen).reshape(-1) if unseen else np.empty(0)

    def _guesses(self, content: Content) -> LandmarkGuesses | None:
        """Return where points are that were not told before, in the fixed frame."""
        known = self.tracker.map
        rows = np.flatnonzero(known.known & (known.track_id > self._known_id))
        if not content.depths.measures or not len(rows):
            return None
        self._known_id = int(known.track_id[rows].max())
        points, _ = known.points(rows)
        moved = points @ self._fixed_from_map.rotation.T + self._fixed_from_map.translation
        return LandmarkGuesses(self.number, known.track_id[rows], moved)

    def refine(self, poses: Poses, cloud: Cloud | None) -> None:
        """Take refined poses of keyframes, by id, and points, by track id."""
        if not self.has_begun:
            return
        rotation = geometry.matrix_from_quaternion(poses.orientation)
        body = self._ideal.body_from_camera
        there = {
            int(key): Transform(rotation[i], poses.position[i]).after(body) for i, key in enumerate(poses.keyframe_id)
        }
        moved = self.tracker.refine(there)
        if moved is not None:
            self._fixed_from_map = self._fixed_from_map.after(moved.inverse())
        if cloud is not None and len(cloud):
            self.tracker.map.refine(cloud.track_id, cloud.position)
