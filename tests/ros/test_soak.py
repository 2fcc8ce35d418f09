# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The short form of `make soak` with the node: keyframes over DDS, by turns and in bursts; memory stays bounded."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.ros.harness import NodeProcess, Peer
from tests.soak import runs
from tests.soak.drive import Drive
from tests.soak.measure import MORE_MB, Part, growth

pytestmark = [pytest.mark.dds, pytest.mark.slow]


def test_node_takes_bursts_and_does_not_grow(
    start_node: Callable[..., NodeProcess], make_peer: Callable[..., Peer]
) -> None:
    process, peer = start_node(), make_peer()
    peer.advertise()
    peer.listen()
    peer.connect()
    parts = list(runs.node(process, peer, Drive(tracks=40, session_rounds=1), 240, 60))
    assert [part.keyframes for part in parts] == [60, 120, 180, 240]
    assert growth(parts, timed=False) == []
    # A report may be made while the second image of the last keyframe is on its way.
    peer.until(lambda: peer.received["report"][-1].waiting == 0, "a report with nothing waiting")
    assert peer.received["report"][-1].received >= 240
    assert process.alive


def test_growth_is_told() -> None:
    parts = [Part(100 * k, 100.0 + k, [1.0], 1.0) for k in range(1, 11)]
    assert growth(parts, timed=True) == []
    assert growth([*parts, Part(1100, 150.0 + MORE_MB, [1.0], 2.0)], timed=True) == [
        "memory: 106 MB, then 170 MB",
        "processor time of a keyframe: 1.00 ms, then 2.00 ms",
    ]
