# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Serialise what is many things in one message, as little-endian CDR (what DDS sends and MCAP files hold).

A path of 1000 poses is 6000 Python objects: 20 ms to build, during which nothing else is answered; a cloud is copied
four times on its way through a message object. Here a pose, or a point, is a row of an array, and the array is the
message but for its head.

Numbers are aligned to their size, counted from behind the 4 bytes that name the encoding. So a
``geometry_msgs/PoseStamped`` is

    sec int32, nanosec uint32, length of the name uint32, name and a zero, gap to a multiple of 8,
    x, y, z, qx, qy, qz, qw float64

and the gap depends on where it begins: at a multiple of 8, but for the first pose of a path, which may begin 4 later.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from ba_node.messages.factory import NS_PER_S, stamp_parts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ba_node.estimate import Poses

_ENCODING = b"\x00\x01\x00\x00"
# Values of sensor_msgs/PointField.
_POINT_FIELD = {"<f4": 7, "<u4": 6}


def pose_messages(poses: Poses, frame_id: str) -> list[bytes]:
    """Return a ``geometry_msgs/PoseStamped`` for each pose.

    Raises:
        ConversionError: the seconds of a stamp exceed 32 bits.
    """
    rows = _stamped(poses, frame_id, 0)
    size, data = rows.shape[1], rows.tobytes()
    return [_ENCODING + data[begin : begin + size] for begin in range(0, len(data), size)]


def path_message(poses: Poses, stamp_ns: int, frame_id: str) -> bytes:
    """Return a ``nav_msgs/Path``.

    Raises:
        ConversionError: as of :func:`pose_messages`.
    """
    head = _header(stamp_ns, frame_id)
    head += struct.pack("<I", len(poses))
    first, others = _stamped(poses[:1], frame_id, len(head) % 8), _stamped(poses[1:], frame_id, 0)
    return b"".join([_ENCODING, head, first.tobytes(), others.tobytes()])


def cloud_message(points: NDArray[np.void], stamp_ns: int, frame_id: str, *, dense: bool) -> bytes:
    """Return a ``sensor_msgs/PointCloud2`` of one row.

    Args:
        points: (n,) records of little-endian float32 and uint32 fields.
        stamp_ns: stamp, ns.
        frame_id: frame of the points.
        dense: no coordinate is NaN or infinite.

    Raises:
        ConversionError: the seconds of the stamp exceed 32 bits.
    """
    layout = points.dtype.fields
    assert layout is not None
    head = _header(stamp_ns, frame_id) + struct.pack("<3I", 1, len(points), len(layout))
    for name, (kind, offset, *_) in layout.items():
        # Aligned for the number that follows: offset uint32, datatype uint8, gap, count uint32.
        head += _text(name) + struct.pack("<IB3xI", offset, _POINT_FIELD[kind.str], 1)
    size = points.dtype.itemsize
    head += struct.pack("<?3x3I", False, size, size * len(points), size * len(points))
    return b"".join([_ENCODING, head, points.data if len(points) else b"", struct.pack("<?", dense)])


def _header(stamp_ns: int, frame_id: str) -> bytes:
    """Return a ``std_msgs/Header`` and the gap to a number of 4 bytes."""
    return struct.pack("<iI", *stamp_parts(stamp_ns)) + _text(frame_id)


def _text(text: str) -> bytes:
    """Return a string and the gap to a number of 4 bytes."""
    data = text.encode() + b"\x00"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


def _stamped(poses: Poses, frame_id: str, begin: int) -> NDArray[np.uint8]:
    """Return the bytes of each pose as a row, for a pose that begins at a place modulo 8."""
    sec, nanosec = np.divmod(poses.stamp_ns, NS_PER_S)
    wrong = np.flatnonzero(sec != sec.astype(np.int32))
    if len(wrong):
        stamp_parts(int(poses.stamp_ns[wrong[0]]))
    name = np.frombuffer(_text(frame_id), np.uint8)
    numbers = 8 + len(name) + -(begin + 8 + len(name)) % 8
    rows = np.zeros((len(poses), numbers + 56), np.uint8)
    rows[:, :4] = sec.astype("<i4")[:, None].view(np.uint8)
    rows[:, 4:8] = nanosec.astype("<u4")[:, None].view(np.uint8)
    rows[:, 8 : 8 + len(name)] = name
    pose = np.concatenate([poses.position, poses.orientation], axis=1).astype("<f8")
    rows[:, numbers:] = pose.view(np.uint8)
    return rows
