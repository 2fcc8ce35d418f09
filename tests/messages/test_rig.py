# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Rigs from camera_info: extrinsics of p and r, of tf_static, and what is refused."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.messages.factory import ConversionError
from ba_node.messages.rig import rig_from_infos
from ba_node.messages.transforms import StaticTree

LEFT_R = geometry.so3_exp(np.array([0.01, -0.02, 0.005]))
RIGHT_R = geometry.so3_exp(np.array([-0.01, 0.015, 0.0]))


def info(name: str, shift: float, rotation: Any = None) -> SimpleNamespace:
    """Return a camera of 640 x 480 px with p[0, 3] = 400 * shift."""
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=name),
        width=640,
        height=480,
        k=[410.0, 0, 315.0, 0, 412.0, 238.0, 0, 0, 1],
        d=[-0.1, 0.01, 0.0, 0.0, 0.0],
        r=(np.eye(3) if rotation is None else rotation).reshape(-1),
        p=[400.0, 0, 320.0, 400.0 * shift, 0, 400.0, 240.0, 0, 0, 0, 1, 0],
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
    )


def static_tree(*rows: tuple[str, str, list[float], list[float]]) -> StaticTree:
    tree = StaticTree()
    transforms = [
        SimpleNamespace(
            header=SimpleNamespace(frame_id=parent),
            child_frame_id=child,
            transform=SimpleNamespace(
                translation=SimpleNamespace(**dict(zip("xyz", position, strict=True))),
                rotation=SimpleNamespace(**dict(zip("xyzw", orientation, strict=True))),
            ),
        )
        for parent, child, position, orientation in rows
    ]
    tree.add(SimpleNamespace(transforms=transforms))
    return tree


def test_a_rectified_pair_is_p_alone() -> None:
    rig = rig_from_infos([info("left", 0.0, LEFT_R), info("right", -0.12, RIGHT_R)], rectified=True)
    assert np.array_equal(rig.intrinsics, [[400.0, 400.0, 320.0, 240.0]] * 2)
    assert [len(d) for d in rig.distortion] == [0, 0]
    assert np.allclose(rig.position, [[0.0, 0.0, 0.0], [0.12, 0.0, 0.0]], atol=1e-12)
    assert np.allclose(rig.orientation, np.tile([0, 0, 0, 1], (2, 1)))


def test_a_raw_pair_is_turned_by_r() -> None:
    """A point seen through the raw rig, turned by r, has the pixels that p gives it."""
    infos = [info("left", 0.0, LEFT_R), info("right", -0.12, RIGHT_R)]
    rig = rig_from_infos(infos)
    assert np.array_equal(rig.intrinsics[1], [410.0, 412.0, 315.0, 238.0])
    assert rig.distortion[0].tolist() == [-0.1, 0.01, 0, 0, 0]
    point = np.array([0.4, -0.3, 5.0])  # in the left raw camera
    rectified = LEFT_R @ point
    for i, one in enumerate(infos):
        rotation = geometry.matrix_from_quaternion(rig.orientation[i])
        seen = one.r.reshape(3, 3) @ rotation.T @ (point - rig.position[i])
        expected = np.array(one.p).reshape(3, 4) @ np.append(rectified, 1.0)
        found = np.array(one.p).reshape(3, 4)[:, :3] @ seen
        assert np.allclose(found[:2] / found[2], expected[:2] / expected[2], atol=1e-9)


def test_the_way_to_the_body_comes_from_tf_static() -> None:
    tree = static_tree(("base_link", "left", [0.5, 0.0, 1.0], [0.5, -0.5, 0.5, -0.5]))
    rig = rig_from_infos([info("left", 0.0), info("right", -0.12)], rectified=True, tree=tree, base="base_link")
    assert rig.frame_id == "base_link"
    # The optical frame's x axis is the body's -y axis.
    assert np.allclose(rig.position, [[0.5, 0.0, 1.0], [0.5, -0.12, 1.0]], atol=1e-12)


def test_without_a_baseline_in_p_tf_static_places_the_second() -> None:
    tree = static_tree(
        ("base_link", "left", [0.0, 0.1, 0.0], [0, 0, 0, 1]), ("base_link", "right", [0.0, -0.1, 0.0], [0, 0, 0, 1])
    )
    rig = rig_from_infos([info("left", 0.0), info("right", 0.0)], tree=tree, base="base_link")
    assert np.allclose(rig.position, [[0, 0.1, 0], [0, -0.1, 0]])
    with pytest.raises(ConversionError, match="nothing tells where 'right' sits"):
        rig_from_infos([info("left", 0.0), info("right", 0.0)])


def test_one_camera_needs_no_extrinsics() -> None:
    rig = rig_from_infos([info("rgb", 0.0)])
    assert (rig.frame_id, len(rig)) == ("rgb", 1)


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ((info("left", -0.12), info("right", 0.0)), "left and right are swapped"),
        ((info("left", 0.0), info("right", -120.0)), "baseline 120 m"),
    ],
)
def test_what_cannot_be_is_refused(pair: Any, words: str) -> None:
    with pytest.raises(ConversionError, match=words):
        rig_from_infos(pair)


def test_a_rectified_image_needs_p() -> None:
    one = info("left", 0.0)
    one.p = [0.0] * 12
    with pytest.raises(ConversionError, match="p of 'left' is all zero"):
        rig_from_infos([one], rectified=True)


def test_a_frame_that_was_said_to_sit_in_two_places_is_known() -> None:
    one, other = ("base", "cam", [0.1, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]), ("base", "cam", [0.2, 0, 0], [0.0, 0, 0, 1.0])
    assert static_tree(one, one).moved == set(), "said again"
    tree = static_tree(one, other)
    place = tree.find("base", "cam")
    assert tree.moved == {"cam"} and place is not None and place.translation[0] == 0.2
    assert static_tree(one, ("mast", *one[1:])).moved == {"cam"}
