# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Take images, say what came of them: the face of the front-end, which looks at images and begins and ends sessions."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import BoolArray, FloatArray
from ba_node.config.front_end import FrontEndOptions
from ba_node.estimate import Cloud, Poses, Transform
from ba_node.front_end import opencv
from ba_node.front_end.checks import ImageWatch
from ba_node.front_end.frame import Frame
from ba_node.front_end.odometry import OdometryWatch
from ba_node.front_end.records import FrontEndError, Images, State, Tracked
from ba_node.front_end.rectify import IdealRig, ideal_rig
from ba_node.front_end.rim import Rim
from ba_node.front_end.session import Session
from ba_node.measurements import CameraRig

# Depth cameras tell nothing beyond this, m.
_FARTHEST_M = 1e4
# How the second camera is turned is known once its yaw is, to so many px; that it is far off, by so many keyframes.
_SETTLED_PX, _ENOUGH_KEYFRAMES = 0.1, 6
# Images that are kept until then.
_MOST_KEPT = 40
# A turn that is known too late by more, px, spoils the keyframes from before.
_FAR_OFF_PX = 0.5
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
        self._odometry = OdometryWatch(lambda cause, words: self._watch.say(cause, words, self._notes))
        self._ideal: IdealRig | None = None
        self._allowed: BoolArray = np.ones((0, 0), bool)
        self._rims = tuple(Rim(self.options.patch_px | 1) for _ in range(len(rig)))
        if rig.image_size.all():
            self._know_size((int(rig.image_size[0, 0]), int(rig.image_size[0, 1])))
        self._stamp_ns: int | None = None
        self._turn = np.array([self.options.stereo_yaw_px, self.options.stereo_roll_px])
        self._session: Session | None = None

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

    @property
    def alignment(self) -> tuple[FloatArray, FloatArray] | None:
        """Return yaw and roll of the second camera as learned (``alignment.py``) and their sigmas, (2,) px each."""
        if self._session is None:
            return None
        alignment = self._session.tracker.alignment
        return alignment.turn, alignment.sigma

    @property
    def scale(self) -> str:
        """Return what tells lengths: ``measured`` (depths, a baseline), ``odometry``, ``free``; or nothing yet."""
        return "" if self._session is None else self._session.scale

    @property
    def waits(self) -> bool:
        """Return True while one camera alone has not moved enough for a map to begin."""
        return self._session is not None and not self._session.has_begun

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
        if images.depth_m is not None:
            images = dataclasses.replace(images, depth_m=images.depth_m * np.float32(self.options.depth_scale))
        told = self._process(images, odometry)
        if odometry is not None:
            self._hold_against(odometry, told)
        return dataclasses.replace(told, notes=tuple(self._notes))

    def refine(self, poses: Poses, cloud: Cloud | None = None) -> None:
        """Take from the back-end refined poses of keyframes of this session (by id) and of points (by track id).

        What is not known here (any more) is passed over. Points that are not in the cloud move with the keyframe that
        they were first seen from.
        """
        if self._session is not None:
            self._session.refine(poses, cloud)

    def _hold_against(self, odometry: Transform, told: Tracked) -> None:
        """Hold the odometry of an image against what came of it."""
        self._odometry.image(told.stamp_ns, odometry, stands=told.state is State.STANDING)
        if told.keyframe is not None and self._session is not None and self._ideal is not None:
            step = self._session.step
            self._odometry.keyframe(told.stamp_ns, odometry, step, self._ideal.body_from_camera)

    def _process(self, images: Images, odometry: Transform | None) -> Tracked:
        last_ns = self._stamp_ns
        if last_ns is not None and images.stamp_ns <= last_ns - 1_000_000_000:
            self._end(f"stamps went back by {(last_ns - images.stamp_ns) / 1e9:.1f} s")
            last_ns = self._stamp_ns = None
        usable = self._watch.look(images, last_ns, self._notes)
        if usable is not None and self._ideal is None:
            try:
                self._know_size((usable.grey[0].shape[1], usable.grey[0].shape[0]))
            except FrontEndError as error:
                self._watch.say("rig", str(error), self._notes)
                usable = None
        session = self._session
        if usable is None:
            if session is None:
                return self._nothing(images)
            if last_ns is not None and images.stamp_ns > last_ns:
                session.lost, session.unseen = session.lost + 1, session.unseen + 1
            return session.told(State.LOST, images)
        sure = self._watch.believes(images.stamp_ns, last_ns, self._notes)
        gap_s = 0.0 if last_ns is None or not sure else (images.stamp_ns - last_ns) / 1e9
        self._stamp_ns = images.stamp_ns if sure else last_ns
        if session is not None and session.scale == "free" and odometry is not None:
            self._end("an odometry is there now, whose scale it has")
        told = self._track(usable, odometry, gap_s, sure)
        return self._settled(told, (usable, odometry, gap_s, sure))

    def _settled(self, told: Tracked, image: tuple[Images, Transform | None, float, bool]) -> Tracked:
        """Track the first images again where the second camera turns out to be far from where the rig has it.

        Their keyframes were measured before that was known. What moves tells it within some keyframes.
        """
        session = self._session
        if session is None or session.first_images is None or told.state in (State.STANDING, State.LOST):
            return told
        alignment, first_images = session.tracker.alignment, session.first_images
        if len(first_images) >= _MOST_KEPT:
            del first_images[1::2]  # so many between few keyframes are near enough to each other
        first_images.append(image)
        yaw, roll = alignment.turn.tolist()
        o = session.options
        far_off = max(abs(yaw - o.stereo_yaw_px), abs(roll - o.stereo_roll_px)) > _FAR_OFF_PX
        if alignment.sigma[0] > _SETTLED_PX and not (far_off and session.keyframes >= _ENOUGH_KEYFRAMES):
            return told
        session.first_images = None
        if not far_off:
            return told
        notes, self._notes = self._notes, []
        self._forget()
        self.session_id += 1
        again = [self._track(*one) for one in first_images]
        if self._session is None or any(one.state is State.LOST for one in again):
            self._session, self.session_id, self._notes = session, session.number, notes
            return told
        self._session.first_images = None
        words = f"{yaw:.2f} px of yaw and {roll:.2f} of roll against the rig: session {self.session_id} begins"
        words += f" with the same {len(again)} images, tracked again; the one before is void"
        self._notes = [*notes, f"the second camera is turned by {words}"]
        earlier = tuple(measurement for one in again[:-1] for measurement in one.measurements())
        return dataclasses.replace(again[-1], earlier=earlier + again[-1].earlier, again=True)

    def _track(self, images: Images, odometry: Transform | None, gap_s: float, sure: bool = True) -> Tracked:
        """Go on with the session, or begin one where there is none, or where it is lost for good."""
        frame, session = self._frame(images), self._session
        if session is None:
            return self._first(images, frame, odometry)
        if not session.has_begun:
            told = session.wait(images, frame)
            if told is None:
                self._forget()
                return self._first(images, frame, odometry)
            return told
        gap = gap_s > self.options.max_gap_s
        why = "no odometry, which the session has its scale from"
        if odometry is not None or not session.tracker.given:
            told = session.take(images, frame, odometry, gap=gap, sure=sure)
            if told is not None:
                self._watch.clear("lost")
                self._watch.pause(gap_s if gap else 0.0, images.stamp_ns, self._notes)
                return told
            why = "too little of what was seen before is found again"
        session.lost, session.unseen = session.lost + 1, session.unseen + 1
        self._watch.say("lost", f"lost at {images.stamp_ns} ns: {why}", self._notes)
        if session.lost <= self.options.max_lost and not gap:
            return session.told(State.LOST, images)
        self._end(f"{gap_s:.1f} s without images" if gap else f"{session.lost} images without a pose")
        return self._first(images, frame, odometry)

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
        clear = [rim.clear_of(image) for rim, image in zip(self._rims, grey, strict=False)]
        allowed = allowed if clear[0] is None else allowed & clear[0]
        if len(grey) == 1:
            return Frame(grey[0], None, depth, allowed)
        return Frame(grey[0], grey[1], depth, allowed, clear[1])

    def _first(self, images: Images, frame: Frame, odometry: Transform | None) -> Tracked:
        """Begin a session with an image."""
        assert self._ideal is not None
        yaw, roll = self._turn.tolist()
        options = dataclasses.replace(self.options, stereo_yaw_px=yaw, stereo_roll_px=roll)
        session = Session(self._ideal, options, self.session_id, self._fixed_frame, odometry)
        content = session.begin(frame)
        if frame.right is not None:
            self._watch.partners(frame, self._ideal, self._notes)
        if len(content.track_id) < self.options.min_points:
            text = f"only {len(content.track_id)} features at {images.stamp_ns} ns: too little to begin with"
            self._watch.say("empty", text, self._notes)
            return self._nothing(images)
        self._watch.clear("empty")
        self._session = session
        told = session.first(images, content)
        if session.scale == "free":
            self._watch.say("alone", _ALONE, self._notes)
        return told

    def _nothing(self, images: Images) -> Tracked:
        """Return what is known of an image without a session."""
        return Tracked(State.STARTING, self.session_id, images.stamp_ns, None, np.full((6, 6), np.nan))

    def _forget(self) -> None:
        """Forget the session, but for how the second camera is turned."""
        if self._session is not None:
            self._turn = self._session.tracker.alignment.turn
        self._session = None
        self._odometry.forget()

    def _end(self, why: str) -> None:
        """End the session, if there is one."""
        if self._session is None:
            return
        self._forget()
        self.session_id += 1
        self._notes.append(f"session {self.session_id} begins: {why}; the map of the one before stays as it is")
