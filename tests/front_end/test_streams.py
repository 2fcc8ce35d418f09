# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Images of one time are put together, and the odometry at it."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end.streams import Frame, OdometryBuffer, Streams

MS = 1_000_000


def fed(streams: Streams, *entries: tuple[str, float]) -> list[Frame]:
    """Put in images at times in ms; return all frames."""
    return [frame for name, ms in entries for frame in streams.put(name, round(ms * MS), f"{name}{ms:g}")]


def pair(**options: int) -> Streams:
    return Streams(("left", "right"), frozenset(), **{"depth": 10, **options})


def test_a_pair_is_complete_whichever_comes_first() -> None:
    assert [f.messages for f in fed(pair(), ("left", 0), ("right", 0))] == [{"left": "left0", "right": "right0"}]
    assert [f.messages for f in fed(pair(), ("right", 0), ("left", 0))] == [{"left": "left0", "right": "right0"}]


def test_the_nearest_is_taken_and_its_offset_told() -> None:
    streams = pair()
    frames = fed(streams, ("right", 80), ("left", 100), ("right", 103), ("left", 200), ("right", 203))
    assert [(f.messages["right"], f.skew_ns) for f in frames] == [("right103", 3 * MS), ("right203", 3 * MS)]
    assert not streams.counted


def test_a_dropped_image_costs_its_partner_alone() -> None:
    streams = pair()
    frames = fed(
        streams, ("left", 0), ("right", 0), ("left", 100), ("left", 200), ("right", 200), ("left", 300), ("right", 300)
    )
    assert [f.stamp_ns // MS for f in frames] == [0, 200, 300]
    assert streams.counted == {"no right": 1}
    assert abs(streams.apart_ns["right"]) == 100 * MS


def test_images_are_counted_where_the_first_camera_misses_some() -> None:
    streams = pair()
    both = [(name, float(ms)) for ms in range(0, 1000, 100) for name in ("left", "right")]
    frames = fed(streams, *(one for one in both if one not in (("left", 400.0), ("left", 700.0))))
    assert [f.stamp_ns // MS for f in frames] == [0, 100, 200, 300, 500, 600, 800, 900]
    assert streams.counted == {"right alone": 2}


def test_a_second_camera_may_be_the_quicker_one() -> None:
    streams = pair()
    fed(streams, *((name, ms) for ms in range(0, 600, 50) for name in (["right"] if ms % 100 else ["left", "right"])))
    assert not streams.counted


def test_a_partner_that_never_comes_is_counted_and_nothing_grows() -> None:
    streams = pair(depth=5)
    assert fed(streams, *(("left", 100.0 * i) for i in range(50))) == []
    assert streams.counted["no right"] >= 44
    assert streams.apart_ns["right"] == 0, "nothing can be near"
    # And it goes on when it comes.
    assert len(fed(streams, ("right", 4900.0))) == 1


def test_an_optional_stream_is_waited_for_a_while() -> None:
    streams = Streams(("left", "right", "mask"), frozenset(("mask",)), 10, patience=3)
    frames = fed(streams, ("left", 0), ("right", 0), ("left", 100), ("right", 100))
    assert frames == []
    assert fed(streams, ("mask", 0))[0].messages["mask"] == "mask0"
    frames = fed(streams, *((name, ms) for ms in (200.0, 300.0, 400.0, 500.0) for name in ("left", "right")))
    assert [sorted(f.messages) for f in frames] == [["left", "right"]] * 2
    assert streams.counted == {"no mask": 2}


def test_one_stream_needs_nobody() -> None:
    assert [f.skew_ns for f in fed(Streams(("image",), frozenset(), 5), ("image", 1), ("image", 2))] == [0, 0]


def test_the_offset_is_that_of_the_pair_not_of_the_mask() -> None:
    frames = fed(Streams(("image", "mask"), frozenset(("mask",)), 5), ("mask", 7), ("image", 1), ("mask", 20))
    assert [f.skew_ns for f in frames] == [0]


def test_odometry_is_interpolated() -> None:
    turn = geometry.so3_exp(np.array([[0.0, 0.0, 0.4]]))[0]
    buffer = OdometryBuffer()
    buffer.add(0, Transform(np.eye(3), np.zeros(3)))
    buffer.add(100 * MS, Transform(turn, np.array([1.0, 2.0, 0.0])))
    half = buffer.at(50 * MS)
    assert half is not None
    assert np.allclose(half.translation, [0.5, 1.0, 0.0])
    assert np.allclose(geometry.so3_log(half.rotation[None])[0], [0.0, 0.0, 0.2], atol=1e-12)
    end = buffer.at(100 * MS)
    assert end is not None and np.array_equal(end.rotation, turn)
    assert buffer.covers(100 * MS) and not buffer.covers(101 * MS)
    assert buffer.at(101 * MS) is None and buffer.at(-MS) is None


def test_odometry_begins_anew_when_time_goes_back() -> None:
    buffer = OdometryBuffer()
    for stamp in (5000, 5100, 100, 200):
        buffer.add(stamp * MS, Transform(np.eye(3), np.full(3, float(stamp))))
    found = buffer.at(150 * MS)
    assert found is not None and found.translation[0] == pytest.approx(150.0)
    buffer.add(190 * MS, Transform(np.eye(3), np.zeros(3)))  # out of order: passed over
    assert buffer.covers(200 * MS)


@pytest.mark.parametrize(("apart_s", "words"), [(0.1, ""), (0.5, "up to 0.50 s apart")])
def test_an_odometry_that_comes_seldom_is_said(apart_s: float, words: str) -> None:
    buffer = OdometryBuffer()
    for i in range(4):
        buffer.add(round(1e9 * apart_s * i), Transform(np.eye(3), np.array([float(i), 0.0, 0.0])))
    assert buffer.at(round(1e9 * apart_s)) is not None and buffer.sparse == "", "no pose between others"
    assert buffer.at(round(1.4e9 * apart_s)) is not None
    assert words in buffer.sparse and bool(words) == bool(buffer.sparse)
