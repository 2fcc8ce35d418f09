# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""CameraInfo as it comes in practice: parts of a sensor, binned pixels, and matrices that no camera has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node.core import cameras
from ba_node.messages.camera_info import lens_of
from ba_node.messages.factory import ConversionError

K = [700.0, 0.0, 630.0, 0.0, 710.0, 390.0, 0.0, 0.0, 1.0]
D = [-0.1, 0.02, 0.001, -0.002, 0.0]


def info(**changes: Any) -> SimpleNamespace:
    roi = {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0, "do_rectify": False, **changes.pop("roi", {})}
    fields = {"k": np.array(K), "d": np.array(D), "width": 1280, "height": 800, "binning_x": 0, "binning_y": 0}
    return SimpleNamespace(**{**fields, **changes}, roi=SimpleNamespace(**roi))


@pytest.mark.parametrize(
    ("changes", "intrinsics", "size"),
    [
        ({}, [700, 710, 630, 390], [1280, 800]),
        ({"binning_x": 1, "binning_y": 1}, [700, 710, 630, 390], [1280, 800]),
        ({"roi": {"x_offset": 320, "y_offset": 200, "width": 640, "height": 400}}, [700, 710, 310, 190], [640, 400]),
        ({"roi": {"x_offset": 320, "y_offset": 200}}, [700, 710, 310, 190], [960, 600]),
        ({"roi": {"width": 1280, "height": 800}}, [700, 710, 630, 390], [1280, 800]),
        ({"binning_x": 2, "binning_y": 4}, [350, 177.5, 315, 97.5], [640, 200]),
        (
            {"roi": {"x_offset": 320, "y_offset": 200, "width": 640, "height": 400}, "binning_x": 2, "binning_y": 2},
            [350, 355, 155, 95],
            [320, 200],
        ),
        ({"width": 0, "height": 0, "roi": {"x_offset": 30}}, [700, 710, 600, 390], [0, 0]),
        ({"roi": {"do_rectify": True}}, [700, 710, 630, 390], [1280, 800]),
    ],
)
def test_k_is_taken_from_the_sensor_to_the_image(changes: dict[str, Any], intrinsics: Any, size: Any) -> None:
    message = info(**changes)
    lens = lens_of(message)
    np.testing.assert_allclose(lens.intrinsics, intrinsics, rtol=1e-15)
    np.testing.assert_array_equal(lens.image_size, size)
    np.testing.assert_array_equal(lens.distortion, D)
    np.testing.assert_array_equal(message.k, K)
    assert bool(lens.note) == (intrinsics != [700, 710, 630, 390])


def test_a_pixel_of_the_image_is_the_pixel_of_the_sensor_moved_and_divided() -> None:
    """What a sensor sees at a pixel is what the image has at (pixel - offset) / binning."""
    x = np.random.default_rng(1).normal(size=(50, 3)) * [1, 1, 0.1] + [0, 0, 5]
    pixels = []
    for lens in (
        lens_of(info()),
        lens_of(info(roi={"x_offset": 320, "y_offset": 40, "width": 640, "height": 400}, binning_x=2, binning_y=4)),
    ):
        model, params = cameras.parameters("plumb_bob", lens.intrinsics, lens.distortion)
        pixels.append(cameras.project(x, np.array([model], np.uint8), params[None]))
    np.testing.assert_allclose(pixels[1], (pixels[0] - [320, 40]) / [2, 4], rtol=1e-12)


def test_a_definition_without_region_and_binning_is_of_the_whole_sensor() -> None:
    message = info()
    del message.roi, message.binning_x, message.binning_y
    np.testing.assert_array_equal(lens_of(message).intrinsics, [700, 710, 630, 390])


def k_with(**entries: float) -> np.ndarray:
    k = np.array(K)
    for name, value in entries.items():
        k[int(name[1:])] = value
    return k


BAD = [
    ({"k": k_with(k8=0.0)}, "bottom row 0 0 0: expected 0 0 1"),
    ({"k": k_with(k8=2.0)}, "bottom row 0 0 2"),
    ({"k": k_with(k6=1.0)}, "bottom row 1 0 1"),
    ({"k": k_with(k1=3.0)}, r"skew k\[1\] = 3"),
    ({"k": k_with(k3=-3.0)}, r"k\[3\] = -3"),
    ({"k": np.array(K).reshape(3, 3).T}, "transposed"),
    ({"k": np.zeros(9)}, "not calibrated"),
    ({"k": k_with(k0=-700.0)}, "fx = -700"),
    ({"k": k_with(k4=0.0)}, "fy = 0"),
    ({"k": k_with(k0=1e9, k4=1e9)}, r"fx = 1e\+09"),
    ({"k": k_with(k0=0.54, k4=0.55, k2=0.5, k5=0.5)}, "fx = 0.54"),
    ({"k": k_with(k0=4.0, k4=4.0)}, "fx = 4 px where the sensor has 1280 x 800 px"),
    ({"k": k_with(k4=70.0)}, "fx = 700, fy = 70 px"),
    ({"k": k_with(k2=6300.0)}, "principal point cx = 6300 px is far outside"),
    ({"k": k_with(k5=-900.0)}, "principal point cy = -900 px is far outside"),
    ({"k": k_with(k2=np.nan)}, "not finite"),
    ({"k": k_with(k0=np.inf)}, "not finite"),
    ({"k": np.ones(4)}, "k has 4 entries, expected 9"),
    ({"roi": {"x_offset": 900, "width": 640, "height": 400}}, r"640 x 400 px at \(900, 0\) is not on the sensor"),
    ({"roi": {"y_offset": 800}}, "is not on the sensor"),
    ({"binning_x": 1000}, "binning 1000 x 1"),
]


@pytest.mark.parametrize(("changes", "words"), BAD)
def test_what_no_camera_has_is_refused_by_name(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConversionError, match=words):
        lens_of(info(**changes))
