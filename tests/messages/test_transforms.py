# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.estimate import Cloud, Estimate, Poses, SolveReport, Transform
from ba_node.io.ros_types import ROSBAGS_FACTORY as FACTORY
from ba_node.messages.transforms import StaticTree, covariance_messages, odometry_message


def test_covariances_are_row_major_and_zero_where_unknown(estimate: Estimate) -> None:
    covariance = np.arange(5 * 36, dtype=float).reshape(5, 6, 6)
    covariance[2] = np.nan
    messages = covariance_messages(FACTORY, dataclasses.replace(estimate, covariance=covariance))
    assert len(messages) == 5
    for k, message in enumerate(messages):
        expected = np.zeros(36) if k == 2 else covariance[k].ravel()
        assert list(message.pose.covariance) == expected.tolist()
        assert message.pose.pose.position.x == estimate.refined.position[k, 0]
        assert message.header.frame_id == "map"


def test_odometry_is_the_newest_keyframe_with_the_mean_velocity_in_the_body() -> None:
    """A body that looks along y goes 2 m along it in half a second and turns left by 0.1 rad."""
    turns = np.array([[0.0, 0.0, 0.5 * np.pi], [0.0, 0.0, 0.5 * np.pi + 0.1]])
    orientation = geometry.quaternion_from_matrix(geometry.so3_exp(turns))
    poses = Poses(
        np.arange(2, dtype=np.uint64), np.array([0, 5 * 10**8]), np.array([[1.0, 1, 0], [1, 3, 0]]), orientation
    )
    variance = np.array([[1e-4, 4e-4, 9e-4, 1e-6, 1e-6, 1e-6], [1e-4, 4e-4, 9e-4, 4e-6, 4e-6, 4e-6]])
    estimate = estimate_of(poses, np.array([np.diag(row) for row in variance]))
    message = odometry_message(FACTORY, estimate, "base_link")
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 5 * 10**8)
    assert message.pose.pose.position.y == 3.0
    assert np.array_equal(message.pose.covariance, np.diag(variance[1]).ravel())
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    found = [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z]
    # Seen from where it looks now, 0.1 rad left of the way.
    np.testing.assert_allclose(found, [4.0 * np.cos(0.1), -4.0 * np.sin(0.1), 0.0, 0.0, 0.0, 0.2], atol=1e-12)
    cov = np.reshape(message.twist.covariance, (6, 6))
    # Along the way it errs as y of the map does: twice 4e-4 m^2, over a quarter of a square second.
    c, s = np.cos(0.1), np.sin(0.1)
    along = np.array([c, -s])
    np.testing.assert_allclose(along @ cov[:2, :2] @ along, 32e-4, rtol=1e-12)
    np.testing.assert_allclose(np.diagonal(cov)[2:], [72e-4, 2e-5, 2e-5, 2e-5], rtol=1e-12)


def test_odometry_says_where_nothing_is_known() -> None:
    poses = Poses(np.array([3], np.uint64), np.array([7]), np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]))
    for covariance in (None, np.full((1, 6, 6), np.nan), np.zeros((1, 6, 6))):
        message = odometry_message(FACTORY, estimate_of(poses, covariance), "base")
        for found in (message.pose.covariance, message.twist.covariance):
            assert np.array_equal(found, 1e6 * np.eye(6).ravel())
        assert message.twist.twist.linear.x == 0.0


def estimate_of(poses: Poses, covariance: FloatArray | None) -> Estimate:
    empty = Cloud(np.empty(0, np.uint64), np.empty((0, 3)), np.empty(0, np.float32), np.empty(0, np.int32))
    return Estimate(int(poses.stamp_ns[-1]), "map", poses, poses, empty, SolveReport(), covariance=covariance)


def said(parent: str, child: str, transform: Transform) -> Any:
    x, y, z = transform.translation
    qx, qy, qz, qw = geometry.quaternion_from_matrix(transform.rotation)
    place = SimpleNamespace(
        translation=SimpleNamespace(x=x, y=y, z=z), rotation=SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
    )
    header = SimpleNamespace(frame_id=parent)
    return SimpleNamespace(transforms=[SimpleNamespace(header=header, child_frame_id=child, transform=place)])


def random_transform(rng: np.random.Generator) -> Transform:
    return Transform(geometry.so3_exp(rng.normal(size=3)), rng.normal(size=3))


@given(parents=st.lists(st.integers(0, 5), min_size=1, max_size=6), seed=st.integers(0, 1000), ends=st.data())
def test_the_way_between_two_frames_is_that_over_the_root(parents: list[int], seed: int, ends: st.DataObject) -> None:
    rng, tree = np.random.default_rng(seed), StaticTree()
    in_root = [Transform(np.eye(3), np.zeros(3))]
    for i, wish in enumerate(parents, start=1):
        parent, placed = wish % i, random_transform(rng)
        tree.add(said(f"f{parent}", f"f{i}", placed))
        in_root.append(in_root[parent].after(placed))
    a, b = (ends.draw(st.integers(0, len(parents))) for _ in range(2))
    found = tree.find(f"f{a}", f"/f{b}")
    assert found is not None
    expected = in_root[a].inverse().after(in_root[b])
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, expected.translation, atol=1e-12)


def test_no_way_is_none() -> None:
    tree = StaticTree()
    tree.add(said("base", "mast", Transform(np.eye(3), np.ones(3))))
    assert tree.find("base", "camera") is None
    assert tree.find("body", "mast") is None
    tree.add(said("mast", "base", Transform(np.eye(3), np.ones(3))))
    assert tree.find("base", "camera") is None, "a circle ends"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_not_heard(bad: float) -> None:
    tree = StaticTree()
    tree.add(said("base", "camera", Transform(np.eye(3), np.array([bad, 0.0, 0.0]))))
    assert tree.find("base", "camera") is None
