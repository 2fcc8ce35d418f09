# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what a front-end delivers, as arrays: the neutral form of the input messages.

The node and the offline tools both turn their messages into these (``messages/``); from here
on nothing knows whether data came over a topic or from a file. Nothing in this module checks
values: lengths and numbers are checked where they are used, in ``scene/``, which counts what it rejects.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray, IdArray


def _no_floats() -> FloatArray:
    return np.empty(0)


@dataclass(frozen=True)
class Keyframe:
    """A keyframe and the front-end's pose of it (message ``ba_msgs/Keyframe``)."""

    session_id: int  # rises when the front-end restarts
    keyframe_id: int  # any uint64
    stamp_ns: int  # time of the image, ns
    frame_id: str  # name of the fixed frame
    position: FloatArray  # (3,) body in the fixed frame, m
    orientation: FloatArray  # (4,) fixed frame from body, quaternion x y z w
    # (36,) or (0,) if unknown: covariance of the step from the keyframe before, row by row, in x, y, z (m) and
    # rotations (rad) about the axes of the body there
    covariance: FloatArray = field(default_factory=_no_floats)


@dataclass(frozen=True)
class FeatureTracks:
    """What one camera saw in one keyframe (message ``ba_msgs/FeatureTracks``)."""

    session_id: int  # as in the keyframe
    keyframe_id: int  # the keyframe it belongs to
    camera_index: int  # index into the rig
    track_id: IdArray  # (n,) uint64
    uv: FloatArray  # (n, 2) raw image coordinates, px. When u and v differ in length, ``malformed`` says so.
    sigma_px: FloatArray = field(default_factory=_no_floats)  # (n,) or (0,): standard deviation of u and v, px
    # (n,) or (0,): distance along the optical axis, m, NaN for none
    depth_m: FloatArray = field(default_factory=_no_floats)
    malformed: str = ""  # why the arrays of the message could not be put together, empty if they could


@dataclass(frozen=True)
class LandmarkGuesses:
    """First positions of points (message ``ba_msgs/LandmarkGuesses``)."""

    session_id: int  # as in the keyframe
    track_id: IdArray  # (n,) uint64
    position: FloatArray  # (n, 3) in the fixed frame, m
    malformed: str = ""  # why the arrays could not be put together, empty if they could


@dataclass(frozen=True)
class RelativePose:
    """A measured pose of one keyframe in another (message ``ba_msgs/RelativePose``)."""

    session_id: int  # as in the keyframes
    from_keyframe_id: int  # the keyframe in whose body it is given
    to_keyframe_id: int  # the keyframe whose pose it is
    is_loop: bool  # it may be wrong as a whole
    position: FloatArray  # (3,) body at the one in the body at the other, m
    orientation: FloatArray  # (4,) the same, quaternion x y z w
    covariance: FloatArray  # (36,) of x, y, z (m) and rotations (rad) about the axes of the body at the first


@dataclass(frozen=True)
class LandmarkPriors:
    """Points whose places are known (message ``ba_msgs/LandmarkPriors``)."""

    session_id: int  # as in the keyframes
    frame_id: str  # name of the frame of the positions
    track_id: IdArray  # (n,) uint64
    position: FloatArray  # (n, 3) m
    covariance: FloatArray  # (n, 3, 3) m^2
    malformed: str = ""  # why the arrays could not be put together, empty if they could


@dataclass(frozen=True)
class TrackMerge:
    """Tracks that are the same point (message ``ba_msgs/TrackMerge``)."""

    session_id: int  # as in the keyframes
    track_id: IdArray  # (n,) uint64, tracks that go on under ...
    same_as: IdArray  # (n,) uint64, ... the id of these
    malformed: str = ""  # why the arrays could not be put together, empty if they could


@dataclass(frozen=True)
class GravityDirection:
    """Which way is down at a keyframe (message ``ba_msgs/GravityDirection``)."""

    session_id: int  # as in the keyframe
    keyframe_id: int  # the keyframe it belongs to
    down: FloatArray  # (3,) in the body, any length
    sigma_rad: float  # standard deviation about each horizontal axis, rad


@dataclass(frozen=True)
class PosePrior:
    """Where the body is in a frame fixed to the world (message ``geometry_msgs/PoseWithCovarianceStamped``)."""

    stamp_ns: int  # time of the measurement, ns
    frame_id: str  # name of the frame
    position: FloatArray  # (3,) m
    orientation: FloatArray  # (4,) frame from body, quaternion x y z w
    covariance: FloatArray  # (36,) of x, y, z (m) and rotations (rad) about the axes of the frame


@dataclass(frozen=True)
class GlobalFix:
    """Where an antenna is on the earth (message ``sensor_msgs/NavSatFix``)."""

    stamp_ns: int  # time of the measurement, ns
    frame_id: str  # name of the frame of the antenna
    geodetic: FloatArray  # (3,) latitude and longitude (deg, WGS 84), altitude over the ellipsoid (m)
    covariance: FloatArray  # (9,) of east, north, up, row by row, m^2
    is_fix: bool  # False: the receiver says that it has none


@dataclass(frozen=True)
class CameraRig:
    """The cameras on the body (messages ``ba_msgs/CameraRig`` and ``sensor_msgs/CameraInfo``)."""

    frame_id: str  # name of the body frame
    names: tuple[str, ...]  # optical frame of each camera
    models: tuple[str, ...]  # distortion model of each camera, as in CameraInfo
    intrinsics: FloatArray  # (n, 4) fx fy cx cy, px of the image
    distortion: tuple[FloatArray, ...]  # n arrays, the coefficients as in CameraInfo
    image_size: NDArray[np.int64]  # (n, 2) width and height, px; 0 if unknown
    position: FloatArray  # (n, 3) camera in the body, m
    orientation: FloatArray  # (n, 4) body from camera optical frame, quaternion x y z w
    malformed: str = ""  # why a camera of the message cannot be used, empty if all can
    notes: tuple[str, ...] = ()  # what was adjusted, a sentence each

    def __len__(self) -> int:
        return len(self.models)


# What names the session that it belongs to, beside keyframes; and what belongs to whichever goes on at its time.
OfSession = FeatureTracks | LandmarkGuesses | RelativePose | LandmarkPriors | TrackMerge | GravityDirection
OfTime = PosePrior | GlobalFix
Measurement = Keyframe | OfSession | OfTime | CameraRig
