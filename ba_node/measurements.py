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


Measurement = Keyframe | FeatureTracks | LandmarkGuesses | CameraRig
