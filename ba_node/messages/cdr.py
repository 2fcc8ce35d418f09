# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write what is many things in one message as little-endian CDR: what DDS sends and MCAP files hold.

A path of 1000 poses is 6000 Python objects: 20 ms to build, during which nothing else is answered; a cloud is copied
four times on its way through a message object; map -> odom goes out 20 times a second and more. Here a row of an array
is a pose, a point, or the end of a line, and the array is the message but for its head.

Numbers are aligned to their size, counted from behind the 4 bytes that name the encoding. So a
``geometry_msgs/PoseStamped`` is

    sec int32, nanosec uint32, length of the name uint32, name and a zero, gap to a multiple of 8,
    x, y, z, qx, qy, qz, qw float64

and the gap depends on where it begins: at a multiple of 8, but for the first pose of a path, which may begin 4 later.
"""

from __future__ import annotations

import functools
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.estimate import Correction, Poses
from ba_node.messages.factory import NS_PER_S, stamp_parts

_ENCODING = b"\x00\x01\x00\x00"
# Values of sensor_msgs/PointField.
_POINT_FIELD = {"<f4": 7, "<u4": 6}


class Cdr:
    """A message that grows. Its stamps raise ConversionError if their seconds exceed 32 bits."""

    def __init__(self) -> None:
        self._parts: list[bytes | memoryview] = []
        self._size = 0

    def pack(self, layout: str, *values: float) -> None:
        """Append numbers, given by the letters of ``struct``, each aligned to its size; ``3d`` is three of them."""
        self._append(_numbers(layout, self._size % 8).pack(*values))

    def text(self, text: str) -> None:
        """Append a string."""
        data = text.encode() + b"\x00"
        self.pack("I", len(data))
        self._append(data)

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a ``std_msgs/Header``."""
        self.pack("iI", *stamp_parts(stamp_ns))
        self.text(frame_id)

    def sequence(self, rows: NDArray[Any]) -> None:
        """Append a sequence of little-endian numbers, or of rows of them, of one kind, (n, ...)."""
        self.pack("I", len(rows))
        if len(rows):
            self._align(rows.dtype.itemsize)
            self._append(np.ascontiguousarray(rows).data.cast("B"))

    def poses(self, poses: Poses, frame_id: str) -> None:
        """Append a sequence of ``geometry_msgs/PoseStamped``."""
        self.pack("I", len(poses))
        for some in (poses[:1], poses[1:]):
            self._append(_stamped(some, frame_id, self._size % 8).tobytes())

    def data(self) -> bytes:
        """Return the message."""
        return b"".join([_ENCODING, *self._parts])

    def _align(self, size: int) -> None:
        if self._size % size:
            self._append(bytes(-self._size % size))

    def _append(self, data: bytes | memoryview) -> None:
        self._parts.append(data)
        self._size += len(data)


@functools.cache
def _numbers(layout: str, begin: int) -> struct.Struct:
    """Return the numbers of a layout, with the gaps between them if it begins at a place modulo 8."""
    out, size = "<", begin
    for letter in re.sub(r"(\d+)(.)", lambda found: found[2] * int(found[1]), layout):
        width = struct.calcsize(f"<{letter}")
        gap = -size % width
        out += "x" * gap + letter
        size += gap + width
    return struct.Struct(out)


def refined_message(poses: Poses, stamp_ns: int, frame_id: str, session_id: int) -> bytes:
    """Return a ``ba_msgs/RefinedKeyframes``."""
    # In one call, as those of :func:`pose_messages`: poses wait for nothing else when they leave.
    n, name = len(poses), frame_id.encode() + b"\x00"
    columns = (poses.keyframe_id, "<u8"), (poses.stamp_ns, "<i8"), (poses.position, "<f8"), (poses.orientation, "<f8")
    parts = [part for values, kind in columns for part in (values.size, np.asarray(values, kind).tobytes())]
    head = _ENCODING, *stamp_parts(stamp_ns), len(name), name, session_id
    return _refined_layout(len(name), n).pack(*head, *parts)


@functools.lru_cache(maxsize=64)
def _refined_layout(name: int, n: int) -> struct.Struct:
    """Return the layout of a ``ba_msgs/RefinedKeyframes`` of so many poses, with a name of so many bytes."""
    out, size = f"<4siII{name}s{-name % 4}xI", 16 + name + -name % 4
    for count in (n, n, 3 * n, 4 * n):
        gap = -(size + 4) % 8 if count else 0
        out += f"I{gap}x{8 * count}s"
        size += 4 + gap + 8 * count
    return struct.Struct(out)


def pose_messages(poses: Poses, frame_id: str) -> list[bytes]:
    """Return a ``geometry_msgs/PoseStamped`` for each pose."""
    name = frame_id.encode() + b"\x00"
    layout = _pose_layout(len(name))
    values = zip(poses.stamp_ns.tolist(), poses.position.tolist(), poses.orientation.tolist(), strict=True)
    return [layout.pack(_ENCODING, *stamp_parts(ns), len(name), name, *place, *turn) for ns, place, turn in values]


@functools.cache
def _pose_layout(size: int) -> struct.Struct:
    """Return the layout of a ``geometry_msgs/PoseStamped`` by itself, with a name of so many bytes."""
    return struct.Struct(f"<4siII{size}s{-(12 + size) % 8}x7d")


def path_message(poses: Poses, stamp_ns: int, frame_id: str) -> bytes:
    """Return a ``nav_msgs/Path``."""
    out = Cdr()
    out.header(stamp_ns, frame_id)
    out.poses(poses, frame_id)
    return out.data()


def tf_message(transform: Correction, parent: str, stamp_ns: int) -> bytes:
    """Return a ``tf2_msgs/TFMessage`` with one transform, from its parent frame."""
    out = Cdr()
    out.pack("I", 1)
    out.header(stamp_ns, parent)
    out.text(transform.odom_frame)
    out.pack("7d", *transform.position.tolist(), *transform.orientation.tolist())
    return out.data()


def cloud_message(points: NDArray[np.void], stamp_ns: int, frame_id: str, *, dense: bool) -> bytes:
    """Return a ``sensor_msgs/PointCloud2`` of one row of records of little-endian float32 and uint32 fields, (n,).

    ``dense``: no coordinate is NaN or infinite.
    """
    layout, size = points.dtype.fields, points.dtype.itemsize
    assert layout is not None
    out = Cdr()
    out.header(stamp_ns, frame_id)
    out.pack("3I", 1, len(points), len(layout))
    for name, (kind, offset, *_) in layout.items():
        out.text(name)
        out.pack("IBI", offset, _POINT_FIELD[kind.str], 1)
    out.pack("?2I", False, size, size * len(points))
    out.sequence(points.view(np.uint8))
    out.pack("?", dense)
    return out.data()


def _stamped(poses: Poses, frame_id: str, begin: int) -> NDArray[np.uint8]:
    """Return the bytes of each pose as a row, for a pose that begins at a place modulo 8."""
    sec, nanosec = np.divmod(poses.stamp_ns, NS_PER_S)
    wrong = np.flatnonzero(sec != sec.astype(np.int32))
    if len(wrong):
        stamp_parts(int(poses.stamp_ns[wrong[0]]))
    name = Cdr()
    name.text(frame_id)
    head = np.frombuffer(name.data()[len(_ENCODING) :], np.uint8)
    numbers = 8 + len(head) + -(begin + 8 + len(head)) % 8
    rows = np.zeros((len(poses), numbers + 56), np.uint8)
    rows[:, :4] = sec.astype("<i4")[:, None].view(np.uint8)
    rows[:, 4:8] = nanosec.astype("<u4")[:, None].view(np.uint8)
    rows[:, 8 : 8 + len(head)] = head
    pose = np.concatenate([poses.position, poses.orientation], axis=1).astype("<f8")
    rows[:, numbers:] = pose.view(np.uint8)
    return rows
