# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say what a library of messages must offer, and make the parts that many messages share."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray

NS_PER_S = 1_000_000_000


class ConversionError(ValueError):
    """A message or a value that has no counterpart on the other side."""


class MessageFactory(Protocol):
    """Make messages of one library (rclpy or rosbags)."""

    def make(self, type_name: str, **fields: Any) -> Any:
        """Return a message of a type such as ``std_msgs/msg/Header`` with all its fields."""
        ...

    def array(self, values: NDArray[Any]) -> Any:
        """Return a flat array in the form that the library takes for a sequence of numbers."""
        ...

    def fixed(self, values: NDArray[Any]) -> Any:
        """Return a flat array in the form that the library takes for an array of fixed size."""
        ...


def stamp_ns_from_message(stamp: Any) -> int:
    """Return a ``builtin_interfaces/Time`` in ns."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def stamp_parts(stamp_ns: int) -> tuple[int, int]:
    """Return seconds and nanoseconds of a ``builtin_interfaces/Time``; raise ConversionError if a stamp exceeds it."""
    # Floor division keeps nanosec in [0, 1e9) for times before the epoch too.
    sec, nanosec = divmod(int(stamp_ns), NS_PER_S)
    if not -(2**31) <= sec < 2**31:
        raise ConversionError(f"stamp {stamp_ns} ns does not fit into a message: its seconds ({sec}) exceed 32 bits")
    return sec, nanosec


def header_message(factory: MessageFactory, stamp_ns: int, frame_id: str) -> Any:
    """Return a ``std_msgs/Header``; raise ConversionError if the stamp exceeds it."""
    sec, nanosec = stamp_parts(stamp_ns)
    stamp = factory.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return factory.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def pose_message(factory: MessageFactory, position: FloatArray, orientation: FloatArray) -> Any:
    """Return a ``geometry_msgs/Pose`` of (3,) m and (4,) x y z w."""
    at = numbers_message(factory, "geometry_msgs/msg/Point", position)
    turn = numbers_message(factory, "geometry_msgs/msg/Quaternion", orientation)
    return factory.make("geometry_msgs/msg/Pose", position=at, orientation=turn)


def uncertain_pose_message(
    factory: MessageFactory, position: FloatArray, orientation: FloatArray, covariance: FloatArray
) -> Any:
    """Return a ``geometry_msgs/PoseWithCovariance``, of a covariance of 36 numbers."""
    pose, known = pose_message(factory, position, orientation), factory.fixed(covariance.ravel())
    return factory.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=known)


def numbers_message(factory: MessageFactory, type_name: str, values: FloatArray) -> Any:
    """Return a message of the fields x, y, z and, of four numbers, w."""
    return factory.make(type_name, **dict(zip("xyzw", values.tolist(), strict=False)))


def float32(values: FloatArray) -> NDArray[np.float32]:
    """Return values in single precision."""
    # A value beyond the range becomes infinite, which the receiver rejects by name; it is no fault of this code.
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
