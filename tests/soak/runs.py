# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Long runs: the back-end by itself, and the node over DDS."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.measurements import Keyframe
from tests.soak.drive import Drive
from tests.soak.measure import Part, processor_s, resident_mb

if TYPE_CHECKING:
    from tests.ros.harness import NodeProcess, Peer

_BURST = 40


def backend(drive: Drive, keyframes: int, part: int, clock: Callable[[], float] = time.process_time) -> Iterator[Part]:
    """Yield the parts of a run of the back-end, with a message that names no keyframe beside each keyframe."""
    runner = Backend(Config())
    runner.add(drive.rig)
    times: list[float] = []
    for count, frame in enumerate(itertools.islice(drive.frames(), keyframes), start=1):
        began = clock()
        for measurement in frame:
            runner.add(measurement)
        runner.flush()
        estimate = runner.solve()
        times.append(1e3 * (clock() - began))
        assert estimate is not None
        assert np.isfinite(estimate.trajectory.position).all()
        if count % part == 0:
            yield Part(count, resident_mb(), times, float(np.mean(times)))
            times = []


def node(process: NodeProcess, peer: Peer, drive: Drive, keyframes: int, part: int) -> Iterator[Part]:
    """Yield the parts of a run of the node: a keyframe when the one before was solved, and bursts between the parts."""
    peer.publish(drive.rig)
    times: list[float] = []
    before = processor_s(process.pid)
    for count, frame in enumerate(itertools.islice(drive.frames(), keyframes), start=1):
        began = time.monotonic()
        for measurement in frame:
            peer.publish(measurement)
        burst = count % part >= part - _BURST and count % part != part - 1
        if not burst:
            keyframe = frame[0]
            assert isinstance(keyframe, Keyframe)
            peer.await_report(keyframe.session_id, keyframe.keyframe_id)
            times.append(1e3 * (time.monotonic() - began))
            del peer.received["report"][:-1]
        if count % part == 0:
            assert process.alive, process.err[-2000:]
            pid = process.pid
            spent, before = processor_s(pid) - before, processor_s(pid)
            yield Part(count, resident_mb(pid), times, 1e3 * spent / part)
            times = []
