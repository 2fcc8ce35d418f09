# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn images as ROS sends them into grey values and depths, and tell images that show nothing.

Works on attributes with the names of ``sensor_msgs/Image`` and ``sensor_msgs/CompressedImage``, so messages of rclpy
and of recordings are both served.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray
from ba_node.front_end.opencv import cv2
from ba_node.front_end.records import FrontEndError, Grey

# Encoding -> bits and channels of a pixel, and OpenCV's conversion to grey.
_COLOUR = {
    "rgb8": "COLOR_RGB2GRAY",
    "bgr8": "COLOR_BGR2GRAY",
    "rgba8": "COLOR_RGBA2GRAY",
    "bgra8": "COLOR_BGRA2GRAY",
    "8UC3": "COLOR_BGR2GRAY",
    "8UC4": "COLOR_BGRA2GRAY",
    "rgb16": "COLOR_RGB2GRAY",
    "bgr16": "COLOR_BGR2GRAY",
    "rgba16": "COLOR_RGBA2GRAY",
    "bgra16": "COLOR_BGRA2GRAY",
    "yuv422": "COLOR_YUV2GRAY_UYVY",
    "uyvy": "COLOR_YUV2GRAY_UYVY",
    "yuv422_yuy2": "COLOR_YUV2GRAY_YUY2",
    "yuyv": "COLOR_YUV2GRAY_YUY2",
}
# OpenCV names a Bayer pattern by its second row: ROS's rggb is its BG.
_BAYER = {
    "rggb": "COLOR_BayerBG2GRAY",
    "bggr": "COLOR_BayerRG2GRAY",
    "gbrg": "COLOR_BayerGR2GRAY",
    "grbg": "COLOR_BayerGB2GRAY",
}
_GREY = {"mono8": 8, "8UC1": 8, "mono16": 16, "16UC1": 16}
_CHANNELS = (("rgba", 4), ("bgra", 4), ("8UC4", 4), ("yu", 2), ("uy", 2))
# Quantiles of a 16-bit image that become black and white; it rarely uses all of its range.
_DARK, _BRIGHT = 0.01, 0.99
_MM = 0.001
# Rows in which the order of bytes shows, and how much of the range neighbours of one colour differ by in noise.
_ROWS, _NOISE = 16, 0.15


def grey_of(message: Any) -> Grey:
    """Return an image as grey values: (h, w) uint8.

    Takes ``sensor_msgs/Image`` (mono8, mono16, rgb8, bgr8, rgba8, bgra8 and their 16-bit forms, bayer_*8 and *16,
    8UC1 to 8UC4, yuv422) and ``sensor_msgs/CompressedImage`` (whatever OpenCV reads: PNG, JPEG).

    Raises:
        FrontEndError: the encoding is none of these, or the data are too short for it; names what was found.
    """
    if not hasattr(message, "encoding"):
        return _uncompressed(message)
    encoding = str(message.encoding)
    if encoding in _GREY:
        return _to_8_bit(_pixels(message, _GREY[encoding], 1))
    if encoding.startswith("bayer_") and encoding[6:10] in _BAYER:
        bits = 16 if encoding.endswith("16") else 8
        return _to_8_bit(cv2().cvtColor(_pixels(message, bits, 1), getattr(cv2(), _BAYER[encoding[6:10]])))
    if encoding in _COLOUR:
        bits = 16 if encoding.endswith("16") else 8
        channels = next((n for head, n in _CHANNELS if encoding.startswith(head)), 3)
        return _to_8_bit(cv2().cvtColor(_pixels(message, bits, channels), getattr(cv2(), _COLOUR[encoding])))
    known = ", ".join((*_GREY, *_COLOUR, "bayer_*8", "bayer_*16"))
    hint = " (a depth image: give it as depth)" if encoding.startswith("32F") else ""
    raise FrontEndError(f"encoding {encoding!r}{hint}: expected one of {known}")


def depth_of(message: Any) -> NDArray[np.float32]:
    """Return a depth image, (h, w) float32, m, 0 for none: of 16UC1 or mono16 (mm) or 32FC1 (m), REP 118.

    Raises:
        FrontEndError: the encoding is none of these, or the data are too short for it.
    """
    if not hasattr(message, "encoding"):
        return _depth(_decoded(message, _depth_png(message)))
    encoding = str(message.encoding)
    if encoding in ("16UC1", "mono16"):
        return _depth(_pixels(message, 16, 1))
    if encoding == "32FC1":
        return _depth(_pixels(message, 32, 1))
    raise FrontEndError(f"encoding {encoding!r} of a depth image: expected 16UC1 (mm) or 32FC1 (m)")


def _depth(pixels: NDArray[Any]) -> NDArray[np.float32]:
    if pixels.dtype == np.uint16:
        return pixels.astype(np.float32) * np.float32(_MM)
    return np.nan_to_num(pixels.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def _depth_png(message: Any) -> int:
    """Return where the picture begins in a compressed depth image (compressed_depth_image_transport has a header)."""
    return 12 if "compressedDepth" in str(message.format) else 0


def _uncompressed(message: Any) -> Grey:
    image = _decoded(message, 0)
    if image.ndim == 3:
        image = cv2().cvtColor(image, cv2().COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2().COLOR_BGR2GRAY)
    return _to_8_bit(image)


def _decoded(message: Any, begin: int) -> NDArray[Any]:
    data = np.frombuffer(bytes(message.data)[begin:], np.uint8)
    image = cv2().imdecode(data, cv2().IMREAD_UNCHANGED) if len(data) else None
    if image is None:
        raise FrontEndError(f"compressed image ({message.format}, {len(data)} bytes) cannot be decoded")
    return np.asarray(image)


def _pixels(message: Any, bits: int, channels: int) -> NDArray[Any]:
    """Return the pixels of a raw image: (h, w) or (h, w, channels), uint8, uint16 or float32."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * bits // 8
    data = np.frombuffer(message.data, np.uint8) if not isinstance(message.data, np.ndarray) else message.data
    step = step or row
    if height < 1 or width < 1 or step < row or len(data) < step * (height - 1) + row:
        raise FrontEndError(
            f"image of {width} x {height} px in {message.encoding}, {step} bytes a row: expected"
            f" {row} bytes a row and {row * height} in all, found {len(data)}"
        )
    if step % row == 0 and step > row and width > 1:
        raise FrontEndError(
            f"image of {width} x {height} px with {step} bytes a row: {step // row} times what {message.encoding} has;"
            " check its encoding"
        )
    rows = np.lib.stride_tricks.as_strided(data.view(np.uint8), (height, row), (step, 1))
    kind = np.dtype({8: "u1", 16: "u2", 32: "f4"}[bits])
    as_sent = kind.newbyteorder(">" if message.is_bigendian else "<")
    pixels: NDArray[Any] = np.ascontiguousarray(rows).view(as_sent).astype(kind, copy=False)
    if bits == 16:
        _require_order(pixels.reshape(height, -1)[:: max(height // _ROWS, 1)], 2 * channels, message)
    return pixels.reshape((height, width) if channels == 1 else (height, width, channels))


def _require_order(rows: NDArray[Any], apart: int, message: Any) -> None:
    """Raise FrontEndError if 16-bit pixels are smooth with their bytes exchanged, and noise as they are."""
    as_given, exchanged = (_roughness(one.astype(np.float32), apart) for one in (rows, rows.byteswap()))
    if as_given > _NOISE and exchanged < as_given / 2.0:
        raise FrontEndError(
            f"{message.encoding} with is_bigendian = {int(message.is_bigendian)} is noise, and an image with the bytes"
            " of each pixel exchanged: set is_bigendian to what the pixels are"
        )


def _roughness(rows: NDArray[np.float32], apart: int) -> float:
    """Return by how much values differ that are so many apart (mean), as a share of the range of all."""
    if rows.shape[1] <= apart:
        return 0.0
    low, high = np.quantile(rows, (_DARK, _BRIGHT))
    return float(np.abs(rows[:, apart:] - rows[:, :-apart]).mean() / max(high - low, 1.0))


def _to_8_bit(pixels: NDArray[Any]) -> Grey:
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    low, high = np.quantile(pixels[::4, ::4], (_DARK, _BRIGHT))
    scaled = (pixels.astype(np.float32) - low) * (255.0 / max(high - low, 1.0))
    grey: Grey = np.clip(scaled, 0.0, 255.0).astype(np.uint8)
    return grey


def read_mask(path: Path | str) -> BoolArray:
    """Return the mask in a picture, (h, w), False where it is black; raise FrontEndError if there is none."""
    data = np.fromfile(path, np.uint8) if Path(path).is_file() else np.empty(0, np.uint8)
    picture = cv2().imdecode(data, cv2().IMREAD_GRAYSCALE) if len(data) else None
    if picture is None:
        raise FrontEndError(f"mask {path}: no picture that can be read")
    return np.asarray(picture > 0)
