# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is said of stamps: a few of another time, a camera that begins later, an odometry of another drive."""

from __future__ import annotations

import pytest

from ba_node.offline.image_times import far_off, of_another, of_odometry

STAMPS = [10**9 + i * 10**8 for i in range(20)]


def later(by_s: float, numbers: range) -> list[int]:
    return [stamp + int(by_s * 1e9) * (i in numbers) for i, stamp in enumerate(STAMPS)]


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (STAMPS, ""),
        (later(30.0, range(10, 20)), ""),  # a pause
        (later(1e6, range(10, 20)), ""),  # half of them: who knows which is wrong
        (
            later(1e6, range(5, 6)),
            "1 of 20 images has a stamp 999999 s ahead of the others, from 1000001500000000 ns on",
        ),
        (later(1e6, range(5, 8)), "3 of 20 images have stamps 999999 s ahead of the others"),
        (later(-1e6, range(3)), "3 of 20 images have stamps 1000000 s behind the others"),
    ],
)
def test_few_stamps_far_from_the_others(stamps: list[int], words: str) -> None:
    told = far_off(stamps)
    assert told.startswith(words) and bool(told) == bool(words)


def test_a_camera_that_begins_later_or_ends_earlier() -> None:
    assert of_another(STAMPS, STAMPS) == of_another(STAMPS, STAMPS[:5] + STAMPS[7:]) == of_another(STAMPS, []) == ""
    assert of_another(STAMPS, STAMPS[15:]) == "it begins 1.5 s later"
    assert of_another(STAMPS, STAMPS[15:-3]) == "it begins 1.5 s later, it ends 0.3 s earlier"


@pytest.mark.parametrize(
    ("span", "words"),
    [
        (None, "it has no poses"),
        ((0, 10**10), ""),
        ((5001 * 10**9, 5002 * 10**9), "it begins 4998.1 s after the last image: other clocks"),
        ((0, 4 * 10**8), "it ends 0.6 s before the first image: other clocks"),
        ((15 * 10**8, 10**10), "it begins 0.5 s after the first image"),
        ((15 * 10**8, 20 * 10**8), "it begins 0.5 s after the first image, it ends 0.9 s before the last image"),
    ],
)
def test_how_far_an_odometry_misses_the_images(span: tuple[int, int] | None, words: str) -> None:
    told = of_odometry(STAMPS, span)
    assert told.startswith(words) and bool(told) == bool(words)
