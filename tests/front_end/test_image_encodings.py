# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every usual encoding gives the same grey values; what cannot be read says why."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from ba_node.front_end.images import depth_of, grey_of
from ba_node.front_end.records import FrontEndError

GREY = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (48, 64), dtype=np.uint8), (0, 0), 2.0)


def message(pixels: Any, encoding: str, *, pad: int = 0, big: bool = False) -> SimpleNamespace:
    """Return an image with padded rows."""
    if big:
        pixels = pixels.byteswap()
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    rows = np.hstack([rows, np.zeros((len(rows), pad), np.uint8)])
    return SimpleNamespace(
        height=pixels.shape[0], width=pixels.shape[1], step=rows.shape[1], encoding=encoding, is_bigendian=int(big),
        data=rows.tobytes(),
    )  # fmt: skip


COLOUR = np.repeat(GREY[..., None], 3, axis=2)
WITH_ALPHA = np.dstack([COLOUR, np.full_like(GREY, 255)])


@pytest.mark.parametrize(
    ("pixels", "encoding"),
    [(GREY, "mono8"), (GREY, "8UC1"), (COLOUR, "rgb8"), (COLOUR, "bgr8"), (WITH_ALPHA, "rgba8"), (WITH_ALPHA, "bgra8")],
)
@pytest.mark.parametrize("pad", [0, 5])
def test_8_bit(pixels: Any, encoding: str, pad: int) -> None:
    assert np.abs(grey_of(message(pixels, encoding, pad=pad)).astype(int) - GREY).max() <= 1


@pytest.mark.parametrize("big", [False, True])
def test_16_bit_is_stretched(big: bool) -> None:
    deep = 3000 + 20 * GREY.astype(np.uint16)
    found = grey_of(message(deep, "mono16", big=big)).astype(float)
    assert np.corrcoef(found.ravel(), GREY.ravel())[0, 1] > 0.99
    assert found.min() == 0
    assert found.max() == 255


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", ["mono16", "rgb16", "bayer_rggb16"])
def test_bytes_in_the_wrong_order_are_named(encoding: str, big: bool) -> None:
    deep = 3000 + 20 * GREY.astype(np.uint16)
    deep = np.repeat(deep[..., None], 3, axis=2) if encoding == "rgb16" else deep
    sent = message(deep, encoding, big=big)
    grey_of(sent)
    sent.is_bigendian = int(not big)
    with pytest.raises(FrontEndError, match="bytes of each pixel exchanged: set is_bigendian"):
        grey_of(sent)
    # Noise and values of 8 bits are neither.
    noise = np.random.default_rng(1).integers(0, 65536, (48, 64)).astype(np.uint16)
    for pixels in (noise, GREY.astype(np.uint16), GREY.astype(np.uint16) << 8, np.full((48, 64), 7, np.uint16)):
        assert grey_of(message(pixels, "mono16", big=big)).shape == (48, 64)


@pytest.mark.parametrize(("pattern", "red"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))])
def test_bayer_patterns(pattern: str, red: tuple[int, int]) -> None:
    # A red surface: only the red pixels of the mosaic are bright, and grey is 0.3 of that everywhere.
    mosaic = np.zeros((48, 64), np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2] = 200
    inner = grey_of(message(mosaic, f"bayer_{pattern}8"))[4:-4, 4:-4]
    assert np.median(inner) == pytest.approx(0.299 * 200, abs=3)


def test_compressed() -> None:
    data = cv2.imencode(".png", GREY)[1].tobytes()
    assert np.array_equal(grey_of(SimpleNamespace(format="mono8; png compressed", data=data)), GREY)


def test_depths() -> None:
    mm = np.full((48, 64), 1500, np.uint16)
    mm[0, 0] = 0
    assert depth_of(message(mm, "16UC1"))[5, 5] == pytest.approx(1.5)
    metres = np.full((48, 64), 2.5, np.float32)
    metres[0, 0] = np.nan
    found = depth_of(message(metres, "32FC1"))
    assert found[5, 5] == pytest.approx(2.5)
    assert found[0, 0] == 0.0


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (message(GREY, "hsv8"), "encoding 'hsv8'"),
        (message(GREY.astype(np.float32), "32FC1"), "a depth image"),
        (SimpleNamespace(**{**vars(message(GREY, "mono8")), "height": 99}), "expected 64 bytes a row and 6336 in all"),
        (SimpleNamespace(**{**vars(message(GREY, "mono8")), "step": 10}), "10 bytes a row"),
        (SimpleNamespace(format="jpeg", data=b"nonsense"), "cannot be decoded"),
        (SimpleNamespace(format="jpeg", data=b""), "cannot be decoded"),
    ],
)
def test_what_cannot_be_read(broken: Any, words: str) -> None:
    with pytest.raises(FrontEndError, match=words):
        grey_of(broken)
