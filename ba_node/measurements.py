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
    """A keyframe and the front-end's pose of it (message ``ba_msgs/Keyframe``).

    Attributes:
        session_id: rises when the front-end restarts.
        keyframe_id: any uint64.
        stamp_ns: time of the image, ns.
        frame_id: name of the fixed frame.
        position: (3,) body in the fixed frame, m.
        orientation: (4,) fixed frame from body, quaternion x y z w.
    """

    session_id: int
    keyframe_id: int
    stamp_ns: int
    frame_id: str
    position: FloatArray
    orientation: FloatArray


@dataclass(frozen=True)
class FeatureTracks:
    """What one camera saw in one keyframe (message ``ba_msgs/FeatureTracks``).

    Attributes:
        session_id: as in the keyframe.
        keyframe_id: the keyframe it belongs to.
        camera_index: index into the rig.
        track_id: (n,) uint64.
        uv: (n, 2) raw image coordinates, px. When u and v differ in length, ``malformed`` says so.
        sigma_px: (n,) or (0,): standard deviation of u and v, px.
        depth_m: (n,) or (0,): distance along the optical axis, m, NaN for none.
        malformed: why the arrays of the message could not be put together, empty if they could.
    """

    session_id: int
    keyframe_id: int
    camera_index: int
    track_id: IdArray
    uv: FloatArray
    sigma_px: FloatArray = field(default_factory=_no_floats)
    depth_m: FloatArray = field(default_factory=_no_floats)
    malformed: str = ""


@dataclass(frozen=True)
class LandmarkGuesses:
    """First positions of points (message ``ba_msgs/LandmarkGuesses``).

    Attributes:
        session_id: as in the keyframe.
        track_id: (n,) uint64.
        position: (n, 3) in the fixed frame, m.
        malformed: why the arrays could not be put together, empty if they could.
    """

    session_id: int
    track_id: IdArray
    position: FloatArray
    malformed: str = ""


@dataclass(frozen=True)
class CameraRig:
    """The cameras on the body (messages ``ba_msgs/CameraRig`` and ``sensor_msgs/CameraInfo``).

    Attributes:
        frame_id: name of the body frame.
        names: optical frame of each camera.
        models: distortion model of each camera, as in CameraInfo.
        intrinsics: (n, 4) fx fy cx cy, px of the image.
        distortion: n arrays, the coefficients as in CameraInfo.
        image_size: (n, 2) width and height, px; 0 if unknown.
        position: (n, 3) camera in the body, m.
        orientation: (n, 4) body from camera optical frame, quaternion x y z w.
        malformed: why a camera of the message cannot be used, empty if all can.
        notes: what was adjusted, a sentence each.
    """

    frame_id: str
    names: tuple[str, ...]
    models: tuple[str, ...]
    intrinsics: FloatArray
    distortion: tuple[FloatArray, ...]
    image_size: NDArray[np.int64]
    position: FloatArray
    orientation: FloatArray
    malformed: str = ""
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.models)


Measurement = Keyframe | FeatureTracks | LandmarkGuesses | CameraRig
