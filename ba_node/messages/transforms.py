# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make messages of poses with their covariance and of odometry, and read /tf_static."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.estimate import Estimate, Transform
from ba_node.measurements import CameraRig
from ba_node.messages.factory import MessageFactory, header_message, numbers_message, uncertain_pose_message
from ba_node.messages.topics import TOPICS

# Variance of what is not known, m^2 and rad^2.
_UNKNOWN = 1e6
# Places of a frame that differ by no more are one: m, and entries of the rotation.
_SAME = 1e-4
_VECTOR = "geometry_msgs/msg/Vector3"


def covariance_messages(factory: MessageFactory, estimate: Estimate) -> list[Any]:
    """Return a ``geometry_msgs/PoseWithCovarianceStamped`` for each refined keyframe; all zeros where unknown."""
    assert estimate.covariance is not None
    poses, covariance = estimate.refined, np.nan_to_num(estimate.covariance, nan=0.0)
    return [
        factory.make(
            TOPICS["pose_with_covariance"].type_name,
            header=header_message(factory, int(poses.stamp_ns[k]), estimate.frame_id),
            pose=uncertain_pose_message(factory, poses.position[k], poses.orientation[k], covariance[k]),
        )
        for k in range(len(poses))
    ]


def odometry_message(factory: MessageFactory, estimate: Estimate, base_frame: str) -> Any:
    """Return a ``nav_msgs/Odometry`` of the newest refined keyframe, with the mean velocity since the one before.

    The velocity is seen from the body. Its covariance is that of the difference of two poses that err by themselves,
    which is more than it is, as their errors are alike.
    """
    poses = estimate.refined[-2:]
    known = np.full((len(poses), 6, 6), np.nan) if estimate.covariance is None else estimate.covariance[-2:]
    rotation, position = geometry.matrix_from_quaternion(poses.orientation), poses.position
    twist, sigma = np.zeros(6), np.full((6, 6), np.nan)
    lapse_s = 1e-9 * float(poses.stamp_ns[-1] - poses.stamp_ns[0])
    if lapse_s > 0.0:
        step = rotation[1].T @ (position[1] - position[0])
        twist = np.concatenate([step, geometry.so3_log(rotation[0].T @ rotation[1])]) / lapse_s
        seen = np.kron(np.eye(2), rotation[1].T)
        sigma = seen @ known.sum(axis=0) @ seen.T / lapse_s**2
    linear, angular = (numbers_message(factory, _VECTOR, part) for part in (twist[:3], twist[3:]))
    return factory.make(
        TOPICS["odometry"].type_name,
        header=header_message(factory, int(poses.stamp_ns[-1]), estimate.frame_id),
        child_frame_id=base_frame,
        pose=uncertain_pose_message(factory, position[-1], poses.orientation[-1], _or_unknown(known[-1])),
        twist=factory.make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=factory.make("geometry_msgs/msg/Twist", linear=linear, angular=angular),
            covariance=factory.fixed(_or_unknown(sigma)),
        ),
    )


def _or_unknown(covariance: FloatArray) -> FloatArray:
    """Return the 36 numbers of a covariance; where it is not known, and 0 for what was held, those of no knowledge."""
    known = bool(np.isfinite(covariance).all() and covariance.any())
    return np.asarray(covariance if known else _UNKNOWN * np.eye(6)).ravel()


class StaticTree:
    """What /tf_static says: where each frame sits in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Transform]] = {}
        self.moved: set[str] = set()  # frames that were said to sit in two places

    def add(self, message: Any) -> None:
        """Take in a ``tf2_msgs/TFMessage``; a frame that is named again sits where it is said last."""
        for stamped in message.transforms:
            t, q = stamped.transform.translation, stamped.transform.rotation
            quaternion = np.array([q.x, q.y, q.z, q.w])
            position = np.array([t.x, t.y, t.z])
            if np.isfinite(position).all() and np.isfinite(quaternion).all() and np.linalg.norm(quaternion) > 0.0:
                placed = Transform(geometry.matrix_from_quaternion(quaternion), position)
                self._place(_name(stamped.child_frame_id), _name(stamped.header.frame_id), placed)

    def _place(self, frame: str, parent: str, placed: Transform) -> None:
        before = self._parents.get(frame)
        if before is not None:
            off = before[1].inverse().after(placed)
            far = np.abs(off.translation).max() > _SAME or np.abs(off.rotation - np.eye(3)).max() > _SAME
            self.moved |= {frame} if far or before[0] != parent else set()
        self._parents[frame] = (parent, placed)

    def find(self, base: str, frame: str) -> Transform | None:
        """Return base from frame, None while the way from one to the other is not known."""
        up, down = self._way_up(_name(base)), self._way_up(_name(frame))
        common = next((name for name in down if name in up), None)
        return None if common is None else up[common].inverse().after(down[common])

    def place(self, rig: CameraRig, base: str) -> tuple[CameraRig, tuple[str, ...]]:
        """Return a rig with its cameras where they sit in a frame, and the cameras that no way leads to.

        With any of these the rig is returned as it came.
        """
        found = [self.find(base, name) for name in rig.names]
        places = [place for place in found if place is not None]
        if len(places) < len(found):
            missing = dict.fromkeys(name for name, place in zip(rig.names, found, strict=True) if place is None)
            return rig, tuple(missing)
        orientation = geometry.quaternion_from_matrix(np.array([place.rotation for place in places]))
        position = np.array([place.translation for place in places])
        return dataclasses.replace(rig, frame_id=base, position=position, orientation=orientation), ()

    def _way_up(self, frame: str) -> dict[str, Transform]:
        """Return ancestor from frame, for the frame itself and all its ancestors, nearest first."""
        way = {frame: Transform(np.eye(3), np.zeros(3))}
        while frame in self._parents:
            parent, placed = self._parents[frame]
            if parent in way:
                break  # a circle, which tf does not allow
            way[parent] = placed.after(way[frame])
            frame = parent
        return way


def _name(frame: str) -> str:
    """Return a frame's name without the leading slash of ROS 1."""
    return frame.removeprefix("/")
