# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A black rim of images that are rectified, or of a fisheye lens, is found and kept out of patches."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest

from ba_node.estimate import Transform
from ba_node.front_end import FrontEnd, Images
from ba_node.front_end.features import corners
from ba_node.front_end.rim import Rim
from tests.front_end import world
from tests.front_end.following import PLAIN, follow

SIDE = 21
WIDTH, HEIGHT = world.SIZE


def circle(shift_px: int = 0) -> Any:
    """Return where a lens shows something, (h, w)."""
    x, y = np.meshgrid(np.arange(WIDTH) - WIDTH // 2 - shift_px, np.arange(HEIGHT) - HEIGHT // 2)
    return x * x + y * y < 140**2


def behind(one: Images) -> Images:
    """Return images as they are behind a lens with a circle of its own each; noise beside it."""
    rng = np.random.default_rng(one.stamp_ns // world.STEP_NS)
    grey = tuple(
        np.where(circle(8 * i), image, rng.integers(0, 8, image.shape)).astype(np.uint8)
        for i, image in enumerate(one.grey)
    )
    return dataclasses.replace(one, grey=grey)


def distance_px(uv: Any, shift_px: int) -> Any:
    """Return how far pixels are within the circle."""
    return 140.0 - np.linalg.norm(uv - [WIDTH // 2 + shift_px, HEIGHT // 2], axis=1)


def test_a_rim_is_what_is_black_at_the_border_in_all_images() -> None:
    image = np.random.default_rng(0).integers(40, 200, (HEIGHT, WIDTH)).astype(np.uint8)
    image[:, :20] = 5  # the rim
    image[100:140, 100:140] = 0  # a hole in a wall
    image[50:53, -3:] = 0  # a shadow
    rim = Rim(SIDE)
    clear = rim.clear_of(image)
    assert clear is not None
    assert np.array_equal(clear, np.arange(WIDTH) >= np.full((HEIGHT, 1), 20 + SIDE // 2))
    brighter = image.copy()
    brighter[:, 10:20] = 90
    clear = rim.clear_of(brighter)
    assert clear is not None and np.array_equal(clear[0], np.arange(WIDTH) >= 10 + SIDE // 2)
    # What was bright once is no rim.
    again = rim.clear_of(image)
    assert again is not None and np.array_equal(again, clear)
    brighter[:, :20] = 90
    assert rim.clear_of(brighter) is None and rim.clear_of(image) is None


def test_an_image_without_a_rim_has_none() -> None:
    image = np.full((HEIGHT, WIDTH), 30, np.uint8)
    assert Rim(SIDE).clear_of(image) is None


def test_no_patch_lies_across_the_rim(truth: list[Transform], stereo: list[Images]) -> None:
    """Neither in the first image nor in the second, and the way is as long as it was."""
    pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")
    frames = [behind(one) for one in stereo]
    found = follow(FrontEnd(world.rig(), PLAIN), frames)
    keyframes = [one for one in found if one.keyframe]
    assert len(keyframes) >= 2
    for one in keyframes:
        left, right = one.tracks
        assert min(len(left.track_id), len(right.track_id)) > 60
        for tracks, shift_px in ((left, 0), (right, 8)):
            assert distance_px(tracks.uv, shift_px).min() > SIDE // 2 - 1.0
    ours, theirs = (np.array([pose.translation for pose in of if pose]) for of in ([one.pose for one in found], truth))
    ways = [np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in (ours, theirs)]
    assert ways[0] / ways[1] == pytest.approx(1.0, abs=0.006)


def test_a_rim_costs_no_features(stereo: list[Images]) -> None:
    """They are spread over what may be looked at: on a half of the image as many as on all of it."""
    image, half = stereo[0].grey[0], np.zeros((HEIGHT, WIDTH), bool)
    half[:, : WIDTH // 2] = True
    found = [
        len(corners(image, allowed, np.empty((0, 2)), 100, SIDE // 2 + 2)) for allowed in (np.ones_like(half), half)
    ]
    assert found[1] > 0.85 * found[0] > 60, found


def test_the_picture_of_the_test_has_corners_at_its_rim(stereo: list[Images]) -> None:
    """Otherwise the test above could not fail."""
    strength = cv2.cornerMinEigenVal(behind(stereo[0]).grey[0], 5)
    edge = np.abs(distance_px(np.argwhere(np.ones((HEIGHT, WIDTH)))[:, ::-1], 0)) < 3.0
    assert np.median(strength.ravel()[edge]) > np.median(strength.ravel())
