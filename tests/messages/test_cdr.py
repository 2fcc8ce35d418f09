# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Bytes written here against those of a general encoder, which knows the message definitions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.estimate import Correction, Poses
from ba_node.io.ros_types import ROSBAGS_FACTORY as F
from ba_node.io.ros_types import encode
from ba_node.messages.cdr import cloud_message, path_message, pose_messages, refined_message, tf_message
from ba_node.messages.factory import ConversionError, header_message, pose_message
from ba_node.messages.outputs import POINT_DTYPE

FRAMES = st.text(st.characters(exclude_characters="\x00", exclude_categories=["Cs"]), max_size=12)
STAMPS = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)


def poses_of(stamps: list[int]) -> Poses:
    rng = np.random.default_rng(len(stamps))
    n = len(stamps)
    ids = np.arange(n, dtype=np.uint64)
    return Poses(ids, np.array(stamps, np.int64), rng.normal(size=(n, 3)), rng.normal(size=(n, 4)))


def stamped(poses: Poses, frame_id: str) -> list[Any]:
    return [
        F.make(
            "geometry_msgs/msg/PoseStamped",
            header=header_message(F, stamp, frame_id),
            pose=pose_message(F, position, orientation),
        )
        for stamp, position, orientation in zip(poses.stamp_ns, poses.position, poses.orientation, strict=True)
    ]


@given(st.lists(STAMPS, max_size=4), FRAMES)
def test_poses(stamps: list[int], frame_id: str) -> None:
    poses = poses_of(stamps)
    expected = [encode("geometry_msgs/msg/PoseStamped", message) for message in stamped(poses, frame_id)]
    assert pose_messages(poses, frame_id) == expected


@given(st.lists(st.integers(-(2**63), 2**63 - 1), max_size=4), STAMPS, FRAMES, st.integers(0, 2**32 - 1))
def test_refined_keyframes(stamps: list[int], stamp_ns: int, frame_id: str, session_id: int) -> None:
    poses = poses_of(stamps)
    message = F.make(
        "ba_msgs/msg/RefinedKeyframes",
        header=header_message(F, stamp_ns, frame_id),
        session_id=session_id,
        keyframe_id=poses.keyframe_id,
        stamp_ns=poses.stamp_ns,
        position=poses.position.ravel(),
        orientation=poses.orientation.ravel(),
    )
    found = refined_message(poses, stamp_ns, frame_id, session_id)
    assert found == encode("ba_msgs/msg/RefinedKeyframes", message)


@given(st.lists(STAMPS, max_size=4), STAMPS, FRAMES)
def test_path(stamps: list[int], stamp_ns: int, frame_id: str) -> None:
    poses = poses_of(stamps)
    message = F.make("nav_msgs/msg/Path", header=header_message(F, stamp_ns, frame_id), poses=stamped(poses, frame_id))
    assert path_message(poses, stamp_ns, frame_id) == encode("nav_msgs/msg/Path", message)


@given(STAMPS, FRAMES, FRAMES)
def test_where_odom_stands_in_the_map(stamp_ns: int, parent: str, child: str) -> None:
    transform = Correction(child, np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.5, -0.5, 0.5]))
    stamped = F.make(
        "geometry_msgs/msg/TransformStamped",
        header=header_message(F, stamp_ns, parent),
        child_frame_id=child,
        transform=F.make(
            "geometry_msgs/msg/Transform",
            translation=F.make("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0),
            rotation=F.make("geometry_msgs/msg/Quaternion", x=0.5, y=0.5, z=-0.5, w=0.5),
        ),
    )
    message = F.make("tf2_msgs/msg/TFMessage", transforms=[stamped])
    assert tf_message(transform, parent, stamp_ns) == encode("tf2_msgs/msg/TFMessage", message)


@given(st.integers(0, 4), STAMPS, FRAMES, st.booleans())
def test_cloud(n: int, stamp_ns: int, frame_id: str, dense: bool) -> None:
    records = np.random.default_rng(n).integers(0, 256, (n, POINT_DTYPE.itemsize), np.uint8).view(POINT_DTYPE)[:, 0]
    layout = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("rms_px", 12, 7), ("views", 16, 6)]
    message = F.make(
        "sensor_msgs/msg/PointCloud2",
        header=header_message(F, stamp_ns, frame_id),
        height=1,
        width=n,
        fields=[
            F.make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=kind, count=1)
            for name, offset, kind in layout
        ],
        is_bigendian=False,
        point_step=20,
        row_step=20 * n,
        data=records.view(np.uint8),
        is_dense=dense,
    )
    assert cloud_message(records, stamp_ns, frame_id, dense=dense) == encode("sensor_msgs/msg/PointCloud2", message)


@pytest.mark.parametrize("stamp_ns", [2**31 * 10**9, -(2**31) * 10**9 - 1, 2**63 - 1])
def test_a_stamp_that_does_not_fit_is_named(stamp_ns: int) -> None:
    poses = poses_of([0, stamp_ns])
    for make in (lambda: pose_messages(poses, "map"), lambda: path_message(poses, 0, "map")):
        with pytest.raises(ConversionError, match=f"stamp {stamp_ns} ns does not fit"):
            make()
    with pytest.raises(ConversionError, match=f"stamp {stamp_ns} ns does not fit"):
        cloud_message(np.zeros(1, POINT_DTYPE), stamp_ns, "map", dense=True)
