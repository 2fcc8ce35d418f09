# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.ros.worker.inbox import Inbox


def _tracks(number: int) -> FeatureTracks:
    return FeatureTracks(0, number, 0, np.array([number], np.uint64), np.zeros((1, 2)))


def _guesses(number: int) -> LandmarkGuesses:
    return LandmarkGuesses(0, np.array([number], np.uint64), np.zeros((1, 3)))


def _keyframe(number: int) -> Keyframe:
    return Keyframe(0, number, number, "odom", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def _rig(number: int) -> CameraRig:
    none = np.zeros((0, 4))
    return CameraRig(str(number), (), (), none, (), np.zeros((0, 2), np.int64), np.zeros((0, 3)), none)


MAKERS: tuple[Callable[[int], Measurement], ...] = (_tracks, _guesses, _keyframe, _rig)


def test_gives_back_everything_in_order_of_arrival() -> None:
    inbox = Inbox(100)
    sent = [MAKERS[i % 4](i) for i in range(20)]
    for i, measurement in enumerate(sent):
        inbox.put(measurement, float(i))
    got = inbox.drain(0.0)
    assert [id(arrival.content) for arrival in got] == [id(measurement) for measurement in sent]
    assert [arrival.time_s for arrival in got] == [float(i) for i in range(20)]
    assert inbox.drain(0.0) == []
    assert inbox.dropped == 0


@given(st.lists(st.sampled_from(range(4)), max_size=60), st.integers(1, 20))
def test_drops_the_oldest_of_the_least_precious_kind(kinds: list[int], size: int) -> None:
    inbox = Inbox(size)
    expected: list[tuple[int, int]] = []
    for number, kind in enumerate(kinds):
        inbox.put(MAKERS[kind](number), 0.0)
        expected.append((kind, number))
        if len(expected) > size:
            expected.remove(min(expected))
    got = [arrival.content for arrival in inbox.drain(0.0)]
    types = (FeatureTracks, LandmarkGuesses, Keyframe, CameraRig)
    assert [type(content) for content in got] == [types[kind] for kind, _ in sorted(expected, key=lambda e: e[1])]
    assert inbox.dropped == max(0, len(kinds) - size)


def test_commands_keep_their_place_and_are_never_dropped() -> None:
    inbox = Inbox(1)
    log: list[str] = []
    inbox.put(_keyframe(1), 0.0)
    for name in ("a", "b", "c"):
        inbox.post(lambda _, name=name: log.append(name))  # type: ignore[misc]
    inbox.put(_tracks(2), 0.0)
    first, *commands = [arrival.content for arrival in inbox.drain(0.0)]
    assert isinstance(first, Keyframe)
    assert len(commands) == 3
    assert inbox.dropped == 1


@pytest.mark.parametrize("act", [lambda inbox: inbox.put(_keyframe(1), 0.0), lambda inbox: inbox.close()])
def test_wakes_a_waiting_reader(act: Callable[[Inbox], None]) -> None:
    inbox = Inbox(10)
    waiting = threading.Event()
    done: list[float] = []

    def read() -> None:
        waiting.set()
        inbox.drain(60.0)
        done.append(time.monotonic())

    reader = threading.Thread(target=read)
    reader.start()
    assert waiting.wait(5.0)
    act(inbox)
    reader.join(5.0)
    assert len(done) == 1, "the reader still waits 5 s after it was woken"


def test_times_out_in_silence() -> None:
    start = time.monotonic()
    assert Inbox(10).drain(0.05) == []
    assert time.monotonic() - start >= 0.05


def test_many_writers_lose_nothing() -> None:
    inbox = Inbox(10_000)

    def write(base: int) -> None:
        for i in range(500):
            inbox.put(_keyframe(base + i), 0.0)

    writers = [threading.Thread(target=write, args=(base,)) for base in (0, 500, 1000)]
    for writer in writers:
        writer.start()
    got: list[int] = []
    while len(got) < 1500:
        batch = inbox.drain(5.0)
        assert batch, f"only {len(got)} of 1500 came"
        got += [arrival.content.keyframe_id for arrival in batch if isinstance(arrival.content, Keyframe)]
    for writer in writers:
        writer.join()
    assert sorted(got) == list(range(1500))
