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

from ba_node.core import geometry
from ba_node.estimate import Correction, Estimate, Transform
from ba_node.io.ros_types import ROSBAGS_FACTORY as FACTORY
from ba_node.messages.transforms import StaticTree, covariance_messages, tf_message


def test_tf_says_where_odom_stands_in_the_map() -> None:
    orientation = np.array([0.5, 0.5, -0.5, 0.5])
    (stamped,) = tf_message(FACTORY, Correction("odom", np.array([1.0, 2.0, 3.0]), orientation), "map", 5).transforms
    assert (stamped.header.frame_id, stamped.child_frame_id, stamped.header.stamp.nanosec) == ("map", "odom", 5)
    t, q = stamped.transform.translation, stamped.transform.rotation
    assert [t.x, t.y, t.z, q.x, q.y, q.z, q.w] == [1.0, 2.0, 3.0, *orientation]


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
