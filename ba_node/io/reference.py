# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read a trajectory to compare with: TUM, KITTI, EuRoC's CSV, or a topic of poses in a recording.

KITTI has no stamps: such a file is compared pose by pose in its order.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core.geometry import quaternion_from_matrix
from ba_node.estimate import Poses
from ba_node.io.bag_files import SUFFIXES
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.io.files import opened
from ba_node.io.trajectory import MAX_BYTES, TrajectoryError, numbered, read_rows, read_tum
from ba_node.messages.factory import stamp_ns_from_message

# Topics of these types hold poses; what gives the stamped poses of a message.
_POSES: dict[str, Callable[[Any], Iterator[tuple[Any, Any]]]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: iter([(message.header, message.pose)]),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: iter([(message.header, message.pose.pose)]),
    "nav_msgs/msg/Odometry": lambda message: iter([(message.header, message.pose.pose)]),
    "nav_msgs/msg/Path": lambda message: ((one.header, one.pose) for one in message.poses),
}
TRUTH_TOPIC = "ground_truth/pose"
# A day at 10 Hz: more is no list of poses of keyframes.
_MAX_MESSAGES = 10**6
# A KITTI file has no stamps: poses are numbered, a second apart.
_SECOND_NS = 1_000_000_000
# A rotation may be off an orthonormal one by this much: what four digits leave.
_ORTHONORMAL = 1e-3


def read_pair(estimate: Path, reference: Path, topic: str = "") -> tuple[Poses, Poses]:
    """Return two trajectories to be paired by stamp; ``topic`` is that of a recording.

    Raises:
        TrajectoryError: one cannot be read, or has no stamps and another number of poses than the other.
        BagError: a recording cannot be read.
    """
    (ours, stamped), (theirs, also) = (_read(path, topic) for path in (estimate, reference))
    if stamped and also:
        return ours, theirs
    if len(ours) != len(theirs):
        raise TrajectoryError(
            f"{estimate if also else reference}: {len(ours)} and {len(theirs)} poses, of which one file has no stamps"
            " (KITTI): such are compared in their order, which needs as many in both"
        )
    if stamped:
        return ours, dataclasses.replace(theirs, stamp_ns=ours.stamp_ns)
    return dataclasses.replace(ours, stamp_ns=theirs.stamp_ns), theirs


def read_poses(path: Path) -> Poses:
    """Return a trajectory of any of the formats, numbered from 0.

    Raises:
        TrajectoryError: it cannot be read.
        BagError: the recording cannot be read, or has several topics of poses.
    """
    return _read(path, "")[0]


def _read(path: Path, topic: str) -> tuple[Poses, bool]:
    """Return a trajectory, and whether it has stamps."""
    if path.is_dir() or path.suffix in SUFFIXES:
        return _read_topic(path, topic), True
    columns = first_line(path)
    if "," in columns:
        return _read_table(path, ",", 8, "stamp[ns],x,y,z,qw,qx,qy,qz,... (EuRoC)"), True
    if is_kitti(path):
        return _read_table(path, None, 12, "the first three rows of a pose (KITTI)"), False
    return read_tum(path), True


def is_kitti(path: Path) -> bool:
    """Return True if a file holds poses without stamps."""
    return path.is_file() and (path.suffix == ".kitti" or len(first_line(path).split()) == 12)


def first_line(path: Path) -> str:
    """Return the first line of a file that is no comment, empty if it has none or cannot be read."""
    try:
        with opened(path, MAX_BYTES, TrajectoryError) as stream:
            lines = (line.decode(errors="replace").strip() for line in itertools.islice(stream, 1000))
            return next((line for line in lines if line and not line.startswith("#")), "")
    except TrajectoryError:
        return ""  # read_tum says what is wrong


def _read_table(path: Path, separator: str | None, width: int, expected: str) -> Poses:
    def row(words: list[str]) -> tuple[int, list[float]]:
        shown = (separator or " ").join(words)[:60]
        try:
            stamp_ns, values = int(words[0]) if separator else 0, [float(word) for word in words[:width]]
        except ValueError:
            raise ValueError(f"{shown!r} is no row of numbers: expected {expected}") from None
        if len(values) < width or (separator is None and len(words) > width) or not np.isfinite(values).all():
            raise ValueError(f"expected {width} finite numbers: {expected}")
        if separator is None:
            _check_rotation(np.array(values).reshape(3, 4)[:, :3])
        return stamp_ns, values

    found = read_rows(path, row, separator)
    if not found:
        raise TrajectoryError(f"{path}: no pose in it: expected lines with {expected}")
    stamps, rows = zip(*found, strict=True)
    values = np.array(rows)
    if separator:
        stamp_ns, position, orientation = np.array(stamps, np.int64), values[:, 1:4], values[:, [5, 6, 7, 4]]
    else:
        matrix = values.reshape(-1, 3, 4)
        stamp_ns, position = _SECOND_NS * np.arange(len(rows)), matrix[:, :, 3]
        orientation = quaternion_from_matrix(matrix[:, :, :3])
    if (np.linalg.norm(orientation, axis=1) == 0.0).any():
        raise TrajectoryError(f"{path}: a quaternion is zero: expected {expected}")
    return numbered(stamp_ns, position, orientation)


def _check_rotation(matrix: FloatArray) -> None:
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if not off <= _ORTHONORMAL:
        raise ValueError(f"its first three columns are no rotation: R R' is off the identity by {off:.2g}")
    if np.linalg.det(matrix) < 0.0:
        raise ValueError("its first three columns mirror space (determinant -1): expected a rotation")


def _read_topic(path: Path, topic: str) -> Poses:
    with BagReader(path) as reader:
        found = {name: kind for name, kind in reader.topics.items() if kind in _POSES}
        wanted = [name for name in found if name.lstrip("/") == topic.lstrip("/")]
        if not topic:
            wanted = [name for name in found if f"/{name}".endswith(f"/{TRUTH_TOPIC}")] or list(found)
        if len(wanted) != 1:
            there = ", ".join(sorted(found)) or "none"
            raise BagError(f"{path}: name the topic of the reference with --reference-topic; topics of poses: {there}")
        poses = poses_on(reader, wanted[0])
    if not len(poses):
        raise BagError(f"{path}: topic {wanted[0]} holds no pose")
    return poses


def poses_on(reader: BagReader, topic: str) -> Poses:
    """Return the poses on a topic of a recording by time, numbered from 0; of equal stamps the last counts.

    Raises:
        BagError: a message cannot be read.
    """
    poses: dict[int, tuple[float, ...]] = {}
    for name, kind, _, data in itertools.islice(reader.messages([topic]), _MAX_MESSAGES):
        for header, pose in _POSES[kind](reader.decode(name, data)):
            position, turn = pose.position, pose.orientation
            row = (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w)
            poses[stamp_ns_from_message(header.stamp)] = row
    stamps = np.array(sorted(poses), np.int64)
    values = np.array([poses[stamp] for stamp in stamps.tolist()], np.float64).reshape(-1, 7)
    return numbered(stamps, values[:, :3], values[:, 3:])
