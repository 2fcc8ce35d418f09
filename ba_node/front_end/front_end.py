# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Take images, say what came of them: the face of the front-end, with sessions, keyframes and what is published."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import BoolArray, FloatArray
from ba_node.config.front_end import FrontEndOptions
from ba_node.core import geometry
from ba_node.estimate import Cloud, Poses, Transform
from ba_node.front_end import covariance, opencv
from ba_node.front_end.checks import ImageWatch
from ba_node.front_end.frame import Frame
from ba_node.front_end.records import FrontEndError, Images, State, Tracked
from ba_node.front_end.rectify import IdealRig, ideal_rig
from ba_node.front_end.tracking import Content, Found, Tracker
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement

_IDENTITY = Transform(np.eye(3), np.zeros(3))
# Features have moved by less than this since the last keyframe (median): nothing moves, px.
_STANDS_PX = 0.5
# Depth cameras tell nothing beyond this, m.
_FARTHEST_M = 1e4
# One camera alone begins once features have moved this far by its motion (median), px.
_START_PX = 20.0
_ALONE = "one camera without odometry: the scale is free, lengths are in units of the first step"


class FrontEnd:
    """Images in; keyframes, tracks and first points out. Single-threaded, deterministic, without a clock or ROS.

    What is in the images decides on the mode: two grey images of a rig of two cameras are stereo (rectified or raw),
    one with depth is RGB-D, one with odometry takes its scale from there, and one alone has a scale of its own, which
    a note says. ::

        front_end = FrontEnd(rig, FrontEndOptions())
        publish(rig)
        for images in camera:
            tracked = front_end.process(images)
            for measurement in tracked.measurements():
                publish(measurement)
            for note in tracked.notes:
                log.warning(note)

        # now and then, when the back-end has refined keyframes
        front_end.refine(estimate.refined, estimate.cloud)

    The fixed frame has its origin at the body's first pose, or is the odometry's where there is one. It is continuous:
    refined poses make the map better against which images are tracked, and thereby the steps to come, but never move
    the published pose (that jump is ``map -> odom``, the back-end's).
    """

    def __init__(
        self,
        rig: CameraRig,
        options: FrontEndOptions | None = None,
        *,
        mask: BoolArray | None = None,
        session_id: int = 1,
        fixed_frame: str = "odom",
    ) -> None:
        """Start with nothing known.

        Args:
            rig: one or two cameras, raw; the first is the one in which features are followed.
            options: see ``config/front_end.py``; None for the defaults.
            mask: (h, w) of the first image, False where nothing is ever to be looked at (a part of the robot).
            session_id: of the first session; each loss for good begins one higher.
            fixed_frame: name of the fixed frame in keyframes.

        Raises:
            FrontEndError: the rig has no camera or more than two, or one that cannot be used; a library is missing.
        """
        if not 1 <= len(rig) <= 2:
            raise FrontEndError(f"the rig has {len(rig)} cameras: expected one or two")
        opencv.cv2()
        opencv.poselib()
        self.rig, self.options = rig, options or FrontEndOptions()
        self.session_id = session_id
        self._mask, self._fixed_frame = mask, fixed_frame
        self._watch = ImageWatch(rig, self.options)
        self._notes: list[str] = []
        self._ideal: IdealRig | None = None
        self._allowed: BoolArray = np.ones((0, 0), bool)
        if rig.image_size.all():
            self._know_size((int(rig.image_size[0, 0]), int(rig.image_size[0, 1])))
        self._stamp_ns: int | None = None
        self._turn = np.array([self.options.stereo_yaw_px, self.options.stereo_roll_px])
        self._tracker: Tracker | None = None
        self._forget()

    def _know_size(self, size: tuple[int, int]) -> None:
        self._ideal = ideal_rig(self.rig, size)
        inside = self._ideal.cameras[0].inside
        width, height = self._ideal.size
        self._allowed = np.ones((height, width), bool)
        if inside is not None:
            # The rim of the raw image looks like corners.
            side = self.options.patch_px
            kernel = np.ones((side, side), np.uint8)
            self._allowed = np.asarray(opencv.cv2().erode(inside.astype(np.uint8), kernel, borderValue=0)) > 0
        if self._mask is not None:
            if self._mask.shape != (size[1], size[0]):
                found = f"{self._mask.shape[1]} x {self._mask.shape[0]}"
                raise FrontEndError(f"mask of {found} px: expected {size[0]} x {size[1]} px, the image's")
            self._allowed = self._allowed & (self._ideal.image(0, self._mask.astype(np.uint8), linear=False) > 0)

    def _forget(self) -> None:
        """Forget the session."""
        if self._tracker is not None:
            self._turn = self._tracker.alignment.turn
        self._tracker = None
        self._motion = _IDENTITY  # camera now from camera at the image before
        self._lost = 0  # images in a row without a pose
        self._unseen = 0  # images without a pose since the last keyframe
        self._keyframe_pose: Transform | None = None  # fixed frame from body at it
        self._alone = False  # one camera without odometry
        self._waiting: Content | None = None  # first keyframe of one camera alone, until it has moved
        self._waiting_ns = 0
        self._fixed_from_map = _IDENTITY  # changes when the map is refined, so that published poses do not
        self._odometry: Transform | None = None  # at the last image that had a pose
        self._count = 0  # keyframes of the session
        self._known_id = 0  # points up to this id were told as guesses

    @property
    def alignment(self) -> tuple[FloatArray, FloatArray] | None:
        """Return yaw and roll of the second camera as learned (``alignment.py``) and their sigmas, (2,) px each."""
        tracker = self._tracker
        return None if tracker is None else (tracker.alignment.turn, tracker.alignment.sigma)

    @property
    def counts(self) -> dict[str, int]:
        """Return how many images were left out or lost, by cause."""
        return dict(sorted(self._watch.counts.items()))

    def process(self, images: Images, odometry: Transform | None = None) -> Tracked:
        """Take in the images of one time; return what came of them.

        Args:
            images: with rising stamps; what cannot be used (another size than the rig says, black, a pair whose stamps
                differ) is said in the notes and changes nothing else.
            odometry: fixed frame from body at that time, of wheels or anything else that is continuous; once given it
                must come with every image. Its frame is the fixed frame then. One camera takes its pose for the
                keyframe's; where depths are measured it foretells.

        Returns:
            The pose and perhaps a keyframe. Nothing is raised, whatever the images hold.
        """
        self._notes = []
        if self._stamp_ns is not None and images.stamp_ns <= self._stamp_ns - 1_000_000_000:
            self._end(f"stamps went back by {(self._stamp_ns - images.stamp_ns) / 1e9:.1f} s")
            self._stamp_ns = None
        usable = self._watch.look(images, self._stamp_ns, self._notes)
        if usable is not None and self._ideal is None:
            try:
                self._know_size((usable.grey[0].shape[1], usable.grey[0].shape[0]))
            except FrontEndError as error:
                self._watch.say("rig", str(error), self._notes)
                usable = None
        if usable is None:
            if self._stamp_ns is not None and images.stamp_ns > self._stamp_ns:
                self._lost, self._unseen = self._lost + 1, self._unseen + 1
            return self._told(State.LOST if self._tracker else State.STARTING, images)
        gap_s = 0.0 if self._stamp_ns is None else (images.stamp_ns - self._stamp_ns) / 1e9
        self._stamp_ns = images.stamp_ns
        frame = self._frame(usable)
        if self._alone and odometry is not None:
            self._end("an odometry is there now, whose scale it has")
        if self._tracker is None:
            return self._first(images, frame, odometry)
        if self._waiting is not None:
            return self._wait(images, frame)
        if self._tracker.given and odometry is None:
            return self._lose(images, frame, None, gap_s, "no odometry, which the session has its scale from")
        found = self._locate(frame, odometry, gap_s > self.options.max_gap_s)
        if found is None:
            return self._lose(images, frame, odometry, gap_s, "too little of what was seen before is found again")
        self._lost = 0
        self._watch.clear("lost")
        return self._tracking(images, found, odometry)

    def _frame(self, images: Images) -> Frame:
        """Return images as the ideal cameras see them."""
        assert self._ideal is not None
        ideal = self._ideal
        grey = [ideal.image(index, image) for index, image in enumerate(images.grey)]
        depth, allowed = images.depth_m, self._allowed
        if depth is not None:
            depth = ideal.image(0, depth, linear=False)
            farthest = self.options.max_depth_m or _FARTHEST_M
            depth = np.where((depth >= self.options.min_depth_m) & (depth <= farthest), depth, np.float32(0.0))
        if images.mask is not None and images.mask.shape == images.grey[0].shape:
            allowed = allowed & (ideal.image(0, images.mask.astype(np.uint8), linear=False) > 0)
        return Frame(grey[0], grey[1] if len(grey) > 1 else None, depth, allowed)

    def _first(self, images: Images, frame: Frame, odometry: Transform | None) -> Tracked:
        """Begin a session with an image."""
        assert self._ideal is not None
        yaw, roll = self._turn.tolist()
        tracker = Tracker(self._ideal, dataclasses.replace(self.options, stereo_yaw_px=yaw, stereo_roll_px=roll))
        tracker.begin(frame, (odometry or _IDENTITY).after(self._ideal.body_from_camera).inverse())
        content, _ = tracker.keyframe(self._count + 1)
        if frame.right is not None:
            self._watch.partners(frame, self._ideal, self._notes)
        if len(content.track_id) < self.options.min_points:
            text = f"only {len(content.track_id)} features at {images.stamp_ns} ns: too little to begin with"
            self._watch.say("empty", text, self._notes)
            return self._told(State.STARTING, images)
        self._watch.clear("empty")
        self._tracker, self._odometry = tracker, odometry
        if not content.depths.measures and odometry is None:
            self._watch.say("alone", _ALONE, self._notes)
            self._alone = True
            self._waiting, self._waiting_ns = content, images.stamp_ns
            return self._told(State.STARTING, images)
        return self._keyframe(images, content)

    def _wait(self, images: Images, frame: Frame) -> Tracked:
        """Begin with one camera alone, once it has moved."""
        tracker, first = self._tracker, self._waiting
        assert tracker is not None and first is not None
        tracker.follow(frame, None)
        if len(tracker.rows) < max(self.options.min_points, len(first.track_id) // 3):
            self._forget()
            return self._first(images, frame, None)
        if not tracker.begin_alone(_START_PX):
            return self._told(State.STARTING, images)
        earlier = self._measurements(self._waiting_ns, first, self._body(tracker.keyframe_pose))
        self._waiting = None
        content, _ = tracker.keyframe(self._count + 1)
        return self._keyframe(images, content, earlier)

    def _expected(self, odometry: Transform | None) -> Transform:
        """Return camera from map as foretold, by odometry or by going on as before."""
        tracker = self._tracker
        assert tracker is not None and self._ideal is not None
        if odometry is None or self._odometry is None:
            return self._motion.after(tracker.pose)
        step = odometry.inverse().after(self._odometry)  # body now from body before
        body = self._ideal.body_from_camera
        return body.inverse().after(step).after(body).after(tracker.pose)

    def _locate(self, frame: Frame, odometry: Transform | None, gap: bool) -> Found | None:
        """Find the pose of an image; leave everything as it was if that fails."""
        tracker = self._tracker
        assert tracker is not None
        before, expected = tracker.state(), self._expected(odometry)
        blind = (gap or self._lost > 0) and odometry is None
        for first in (None,) if blind else (expected, None):
            tracker.follow(frame, first)
            if odometry is not None and frame.right is None and frame.depth is None:
                found = tracker.locate_by(expected)
            else:
                found = tracker.locate()
            if found is not None:
                self._motion = _IDENTITY if self._lost else tracker.pose.after(before["pose"].inverse())
                self._odometry = odometry
                return found
            tracker.restore(before)
        return None

    def _lose(self, images: Images, frame: Frame, odometry: Transform | None, gap_s: float, why: str) -> Tracked:
        """Say that an image has no pose; begin anew when that has gone on for too long."""
        self._lost, self._unseen = self._lost + 1, self._unseen + 1
        self._watch.say("lost", f"lost at {images.stamp_ns} ns: {why}", self._notes)
        if self._lost <= self.options.max_lost and gap_s <= self.options.max_gap_s:
            return self._told(State.LOST, images)
        gap = gap_s > self.options.max_gap_s
        self._end(f"{gap_s:.1f} s without images" if gap else f"{self._lost} images without a pose")
        return self._first(images, frame, odometry)

    def _end(self, why: str) -> None:
        """End the session, if there is one."""
        if self._tracker is None:
            return
        self._forget()
        self.session_id += 1
        self._notes.append(f"session {self.session_id} begins: {why}; the map of the one before stays as it is")

    def _tracking(self, images: Images, found: Found, odometry: Transform | None) -> Tracked:
        """Make the image a keyframe if it is worth it."""
        tracker = self._tracker
        assert tracker is not None
        moved, shift = tracker.moved()
        share = len(tracker.rows) / max(tracker.shared, 1)
        o = self.options
        if moved < o.keyframe_parallax_px and share >= o.keyframe_min_shared and not self._unseen:
            state = State.STANDING if shift < _STANDS_PX else State.TRACKING
            return self._told(state, images, found, odometry)
        content, refined = tracker.keyframe(self._count + 1)
        return self._keyframe(images, content, (), refined or found, odometry)

    def _body(self, camera_from_map: Transform) -> Transform:
        """Return fixed frame from body of a camera in the map."""
        assert self._ideal is not None
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
        told = self._told(State.TRACKING, images, found, odometry)
        assert told.pose is not None
        measured = self._measurements(images.stamp_ns, content, told.pose)
        keyframe = next(one for one in measured if isinstance(one, Keyframe))
        tracks = tuple(one for one in measured if isinstance(one, FeatureTracks))
        return dataclasses.replace(
            told, keyframe=keyframe, tracks=tracks, guesses=self._guesses(content), earlier=earlier
        )

    def _told(
        self, state: State, images: Images, found: Found | None = None, odometry: Transform | None = None
    ) -> Tracked:
        """Return what is known of an image that is no keyframe."""
        tracker = self._tracker
        pose, uncertain = None, np.full((6, 6), np.nan)
        if tracker is not None and self._waiting is None:
            pose = self._body(tracker.pose)
            uncertain = covariance.of_lost(self._lost)
            if found is not None:
                fixed_from_camera = self._fixed_from_map.rotation @ tracker.pose.rotation.T
                uncertain = covariance.of_tracked(found.covariance, fixed_from_camera)
        if odometry is not None and (self._ideal is None or not self._ideal.baseline) and images.depth_m is None:
            pose = odometry
        return Tracked(state, self.session_id, images.stamp_ns, pose, uncertain, notes=tuple(self._notes))

    def _measurements(self, stamp_ns: int, content: Content, pose: Transform) -> tuple[Measurement, ...]:
        """Return keyframe and tracks, in pixels of the raw images."""
        assert self._ideal is not None
        self._count += 1
        ideal, session, number = self._ideal, self.session_id, self._count
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

    def _step_covariance(self, pose: Transform) -> FloatArray:
        """Return the covariance of the step to a keyframe, (36,); (0,) where it is what images that see well give."""
        tracker, before, unseen = self._tracker, self._keyframe_pose, self._unseen
        self._keyframe_pose, self._unseen = pose, 0
        if before is None or tracker is None:
            return np.empty(0)
        if tracker.given:
            return covariance.of_step(before.inverse().after(pose)).reshape(-1)
        return covariance.of_lost(unseen).reshape(-1) if unseen else np.empty(0)

    def _guesses(self, content: Content) -> LandmarkGuesses | None:
        """Return where points are that were not told before, in the fixed frame."""
        tracker = self._tracker
        assert tracker is not None
        rows = np.flatnonzero(tracker.map.known & (tracker.map.track_id > self._known_id))
        if not content.depths.measures or not len(rows):
            return None
        self._known_id = int(tracker.map.track_id[rows].max())
        points, _ = tracker.map.points(rows)
        moved = points @ self._fixed_from_map.rotation.T + self._fixed_from_map.translation
        return LandmarkGuesses(self.session_id, tracker.map.track_id[rows], moved)

    def refine(self, poses: Poses, cloud: Cloud | None = None) -> None:
        """Take from the back-end refined poses of keyframes of this session (by id) and of points (by track id).

        What is not known here (any more) is passed over. Points that are not in the cloud move with the keyframe that
        they were first seen from.
        """
        tracker = self._tracker
        if tracker is None or self._waiting is not None or self._ideal is None:
            return
        rotation = geometry.matrix_from_quaternion(poses.orientation)
        body = self._ideal.body_from_camera
        there = {
            int(key): Transform(rotation[i], poses.position[i]).after(body) for i, key in enumerate(poses.keyframe_id)
        }
        moved = tracker.refine(there)
        if moved is not None:
            self._fixed_from_map = self._fixed_from_map.after(moved.inverse())
        if cloud is not None and len(cloud):
            tracker.map.refine(cloud.track_id, cloud.position)
