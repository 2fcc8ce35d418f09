# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What a source of keyframes is: the topics that it reads, and the pieces that their messages become."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray
from ba_node.measurements import CameraRig
from ba_node.messages.factory import stamp_ns_from_message

ODOMETRY, CLOUD = "nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
# Half of all pixels lie within no less, px, and are so many times as far apart as their rays. Of both, most are on the
# same side of the middle.
_LEAST_SPREAD_PX, _SAME_SIDE = 5.0, 0.75
# Fewest points that tell so.
_FEWEST = 8


class LayoutError(ValueError):
    """A message that is not laid out as its source publishes it, or holds nothing; ``reason`` is what counts it."""

    def __init__(self, words: str, reason: str = "malformed") -> None:
        super().__init__(words)
        self.reason = reason


@dataclass(frozen=True)
class Input:
    """A topic that a source publishes."""

    name: str  # the last part of its name
    type_name: str  # ``package/msg/Type``
    role: str = ""  # of inputs with the same role one is enough, the first that is there; empty: not needed


@dataclass(frozen=True)
class Pose:
    """Where the body was."""

    stamp_ns: int  # time of the image, ns
    frame_id: str  # fixed frame
    position: FloatArray  # (3,) body in the fixed frame, m
    orientation: FloatArray  # (4,) fixed frame from body, quaternion x y z w
    key: int | None = None  # id of the keyframe, None for its stamp
    session: int = 0  # of the source; another one than before: ids before mean other points
    is_keyframe: bool = False  # the source says that it is one


@dataclass(frozen=True)
class Features:
    """What the cameras saw in one image, a row an observation."""

    stamp_ns: int  # time of the image, ns
    ids: FloatArray  # (n,) of the tracks, as they came
    uv: FloatArray  # (n, 2) raw image coordinates, px
    camera: NDArray[np.int64]  # (n,) index into the rig
    normalised: FloatArray  # (n, 2) the same without the camera: x / z and y / z, undistorted; NaN where unknown
    point: FloatArray  # (n, 3) in the fixed frame, or in the body, m; NaN where unknown
    point_in_body: bool = False
    has_depth: bool = False  # points in the body tell a depth that was measured, by the same share near and far
    wrong: Mapping[str, BoolArray] = field(default_factory=dict)  # rows to leave out, by reason
    is_keyframe: bool = False  # the source says that it is one


@dataclass(frozen=True)
class Extrinsic:
    """Where the first camera sits, from a source that tells its lens elsewhere."""

    frame_id: str  # body
    position: FloatArray  # (3,) camera in the body, m
    orientation: FloatArray  # (4,) body from camera, quaternion x y z w


Piece = Pose | Features | Extrinsic | CameraRig


class Source:
    """Reads the messages of one front-end."""

    inputs: ClassVar[tuple[Input, ...]]
    # Images come with poses whether they are keyframes or not: these are chosen here.
    every_image: ClassVar[bool] = False
    # Ids from here on may stand for others: float32 holds no larger numbers exactly.
    max_id: ClassVar[int] = 2**24

    def __init__(self, cameras: int = 1) -> None:
        self.cameras = cameras  # how many cameras ids are of, where ids tell the camera

    def read(self, name: str, message: Any) -> Iterator[Piece]:
        """Yield what a message on one of the inputs says.

        Raises:
            LayoutError: it is not laid out as this source publishes it.
        """
        raise NotImplementedError


def xyz(vector: Any) -> FloatArray:
    """Return a vector or point, (3,)."""
    return np.array([vector.x, vector.y, vector.z], np.float64)


def xyzw(quaternion: Any) -> FloatArray:
    """Return a quaternion, (4,)."""
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)


def pose(odometry: Any, session: int = 0, *, is_keyframe: bool = False) -> Pose:
    """Return the pose of a ``nav_msgs/Odometry``."""
    at, header = odometry.pose.pose, odometry.header
    stamp_ns = stamp_ns_from_message(header.stamp)
    place = xyz(at.position), xyzw(at.orientation)
    return Pose(stamp_ns, str(header.frame_id), *place, None, session, is_keyframe)


def nowhere(n: int, size: int) -> FloatArray:
    """Return (n, size) NaN."""
    return np.full((n, size), np.nan)


def mismatch(features: Features) -> str:
    """Return in words why pixels and rays cannot be those of the same points, empty if they can.

    It holds for every lens: what is farther right of the others in one is so in the other, and a camera of a focal
    length below some pixels there is none.
    """
    uv, rays = features.uv, features.normalised
    if len(uv) < _FEWEST:
        return ""
    spread_px = np.subtract(*np.percentile(uv, [75, 25], axis=0))
    if (spread_px < _LEAST_SPREAD_PX).all():
        return f"half of the pixels lie within {spread_px.max():.2g} px: are they divided by the focal length?"
    if not np.isfinite(rays).all():
        return ""
    spread = np.subtract(*np.percentile(rays, [75, 25], axis=0))
    if (spread_px < _LEAST_SPREAD_PX * spread).all():
        return f"half of x / z and y / z lie within {spread.max():.3g}, of the pixels {spread_px.max():.3g}: exchanged?"
    same = ((uv > np.median(uv, axis=0)) == (rays > np.median(rays, axis=0))).mean(axis=0)
    if (same < _SAME_SIDE).any():
        return f"{100 * same.min():.0f} % of x / z and y / z are on the side of u and v: are these exchanged?"
    return ""
