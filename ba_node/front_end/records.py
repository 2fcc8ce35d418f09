# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what goes into the front-end and what comes out, an image or a pair of images at a time."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray
from ba_node.estimate import Transform
from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses, Measurement

Grey = NDArray[np.uint8]


class FrontEndError(ValueError):
    """A rig or an image that the front-end cannot work with, in words for the user."""


class State(enum.Enum):
    """How tracking goes with the images that come."""

    STARTING = "starting"  # one camera alone has not moved enough yet; or nothing to see since the start
    TRACKING = "tracking"  # the pose of the last image is known
    STANDING = "standing"  # likewise, and nothing has moved since the last keyframe
    LOST = "lost"  # the last image has no pose of its own: it is that before, or the odometry's


@dataclass(frozen=True)
class Images:
    """What the cameras of the rig saw at one time, raw (as the rig's intrinsics and distortion have it).

    Depth, if any, is registered to the first image: (h, w) along its optical axis, m; 0 or NaN for none.
    """

    stamp_ns: int  # when the first image was taken, ns
    grey: tuple[Grey, ...]  # (h, w) uint8 each, one or two, in the order of the rig; see ``images.grey_of``
    depth_m: NDArray[np.float32] | None = None
    skew_ns: int = 0  # stamp of the second image (or of the depth) less that of the first, ns
    # (h, w) of the first image, False where nothing is to be looked at: what moves by its class, the robot itself
    mask: BoolArray | None = None


@dataclass(frozen=True)
class Tracked:
    """What came of an image: its pose always, a keyframe with tracks sometimes."""

    state: State
    session_id: int  # rises when tracking was lost for good
    stamp_ns: int  # of the image
    pose: Transform | None  # fixed frame from body; None before anything is known
    # (6, 6) x, y, z (m), rotation about X, Y, Z (rad) of the fixed frame, of the step from the last keyframe;
    # large while lost, NaN while starting
    covariance: FloatArray
    keyframe: Keyframe | None = None  # set if the image was made a keyframe
    tracks: tuple[FeatureTracks, ...] = ()  # one a camera, the keyframe's
    guesses: LandmarkGuesses | None = None  # positions of points that are new with this keyframe, in the fixed frame
    still_since_ns: int | None = None  # of the first image since which nothing has moved; None where none was tracked
    # Keyframes that became known together with this one, as when one camera alone has moved enough: earlier ones, each
    # followed by its tracks.
    earlier: tuple[Measurement, ...] = ()
    # The session before is void: this one began with the same images, tracked again, as more is known of the rig.
    again: bool = False
    notes: tuple[str, ...] = ()  # what a user has to know, a sentence each, told once a cause

    def measurements(self) -> tuple[Measurement, ...]:
        """Return what is to be published or recorded, in order: earlier ones, keyframe, tracks, guesses."""
        own = () if self.keyframe is None else (self.keyframe, *self.tracks)
        rest = () if self.guesses is None else (self.guesses,)
        return (*self.earlier, *own, *rest)
