# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Patches are cut and aligned alike in C++ and numpy, and both find how a picture was moved."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from ba_node import native
from ba_node.front_end import patches
from ba_node.front_end.frame import soften

SIDE, COUNT = 21, 60
# The finest step of OpenCV's interpolation, px.
_OF_OPENCV_PX = 1.0 / 32.0


@pytest.fixture
def picture() -> Any:
    noise = np.random.default_rng(4).normal(size=(200, 300)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128.0 + 60.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def places() -> Any:
    return np.random.default_rng(5).uniform([30.0, 30.0], [270.0, 170.0], (COUNT, 2))


def without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "kernels", None)


@pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
@pytest.mark.parametrize("rows", [False, True])
def test_both_cut_the_same(picture: Any, rows: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the border too, where values are those of the border."""
    soft = soften(picture)
    at = np.concatenate([places(), [[0.0, 0.0], [299.0, 199.0], [-5.0, 100.0], [2.5, 198.5]]])
    ours = patches.cut(soft, at, SIDE, rows)
    without_kernels(monkeypatch)
    theirs = patches.cut(soft, at, SIDE, rows)
    assert ours.shape == theirs.shape == (COUNT + 4, 11 if rows else SIDE + 2, SIDE + 2)
    steepest = sum(np.abs(np.diff(soft, axis=axis)).max() for axis in (0, 1))
    assert np.abs(ours - theirs).max() < _OF_OPENCV_PX * steepest
    assert np.abs((ours - theirs).mean()) < 0.01


@pytest.mark.parametrize("basis", ["place", "row"])
@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("kernels", ["native", "numpy"])
def test_a_moved_picture_is_found(
    picture: Any, basis: str, bent: bool, kernels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Moved by parts of a pixel, brighter and of less contrast: the same by both, to what OpenCV rounds."""
    if kernels == "native" and native.kernels is None:
        pytest.skip("needs the C++ kernels")
    moved = np.array([0.37, 0.0 if basis == "row" else -0.61])
    shift = np.array([[1.0, 0.0, moved[0]], [0.0, 1.0, moved[1]]])
    there = cv2.warpAffine(picture.astype(np.float32), shift, (300, 200), flags=cv2.INTER_LANCZOS4)
    image = soften(np.clip(0.8 * there + 20.0, 0, 255).astype(np.uint8))
    at = places()
    if kernels == "numpy":
        without_kernels(monkeypatch)
    cut = patches.cut(soften(picture), at, SIDE, rows=basis == "row")
    start = np.tile(np.eye(2), (COUNT, 1, 1))
    bend = np.full((COUNT, 2), 1e-4) if bent else None
    found = patches.align(cut, image, at + np.array([0.9, 0.0]), start, bend)
    good = found.correlation > 0.9
    assert good.mean() > 0.9
    off = (found.uv - at - moved)[good]
    assert np.abs(np.median(off, axis=0)).max() < 0.02, np.median(off, axis=0)
    assert np.median(np.abs(off)) < 0.03


@pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
@pytest.mark.parametrize("prior", [None, np.array([50.0, 20.0]), np.array([0.0, 800.0, 800.0])])
def test_both_find_the_same(picture: Any, prior: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also along rows, with a slant, and where a part of what is looked at lies outside the image."""
    along_rows = prior is not None and len(prior) == 3
    down = np.array([0.01, -0.4]) * (not along_rows)
    matrix = np.array([[1.01, 0.0, 0.3], [0.0, 1.0 - down[0], down[1]]])
    there: Any = cv2.warpAffine(picture, matrix, (300, 200))
    at = np.concatenate([places(), [[4.0, 100.0], [295.0, 90.0], [150.0, 6.0]]])
    cut = patches.cut(soften(picture), at, SIDE, along_rows)
    start = np.tile(np.eye(2), (len(at), 1, 1))
    first = at * [1.01, 1.0 - down[0]] + [0.8, 0.1 * (not along_rows)]
    ours = patches.align(cut, soften(there), first, start, prior=prior)
    without_kernels(monkeypatch)
    theirs = patches.align(cut, soften(there), first, start, prior=prior)
    good = theirs.correlation > 0.9
    assert good.mean() > 0.9
    assert np.abs(ours.uv - theirs.uv)[good].max() < 0.03
    assert np.median(np.abs(ours.uv - theirs.uv)[good]) < 0.5 * _OF_OPENCV_PX
    assert np.abs(ours.slant - theirs.slant)[good].max() < 0.01
    assert np.abs(ours.correlation - theirs.correlation)[good].max() < 0.01
    assert np.allclose(ours.covariance[good], theirs.covariance[good], rtol=0.3, atol=2e-5)


@pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
@pytest.mark.parametrize("along_rows", [False, True])
def test_both_make_the_same_of_a_patch(picture: Any, along_rows: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One look, on whole pixels, where both see the same to rounding."""
    soft, at, start = soften(picture), np.round(places()), np.tile(np.eye(2), (COUNT, 1, 1))
    cut, first = patches.cut(soft, at, SIDE, along_rows), at + np.array([1.0, 0.0])
    ours = patches.align(cut, soft, first, start, iterations=1)
    without_kernels(monkeypatch)
    theirs = patches.align(cut, soft, first, start, iterations=1)
    for name in ("uv", "slant", "correlation"):
        assert np.allclose(getattr(ours, name), getattr(theirs, name), rtol=0.0, atol=1e-3), name
    assert np.allclose(ours.covariance, theirs.covariance, rtol=1e-2, atol=1e-7)


@pytest.mark.parametrize("size", [2, 3])
def test_symmetric_matrices_are_inverted_by_hand(size: int) -> None:
    root = np.random.default_rng(6).normal(size=(20, size, 5))
    matrices = root @ root.transpose(0, 2, 1)
    assert np.allclose(patches.inverses(matrices), np.linalg.inv(matrices), rtol=1e-6)


@pytest.mark.parametrize("kernels", ["native", "numpy"])
def test_what_has_no_texture_or_lies_nowhere_is_not_found(
    picture: Any, kernels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kernels == "native" and native.kernels is None:
        pytest.skip("needs the C++ kernels")
    if kernels == "numpy":
        without_kernels(monkeypatch)
    at = np.array([[50.0, 50.0], [np.nan, 20.0], [1e9, -1e9]])
    plain = np.full((3, SIDE + 2, SIDE + 2), 7.0, np.float32)
    found = patches.align(plain, soften(picture), at, np.tile(np.eye(2), (3, 1, 1)))
    assert not (found.correlation > 0.5).any()
    none = patches.align(
        np.empty((0, SIDE + 2, SIDE + 2), np.float32), soften(picture), np.empty((0, 2)), np.empty((0, 2, 2))
    )
    assert none.uv.shape == (0, 2)
