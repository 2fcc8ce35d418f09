# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A wrong set-up, over a real middleware: named, and the front-end's poses stand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ba_node.estimate import Status
from tests.check.set_ups import recording

pytestmark = pytest.mark.dds
KEYFRAMES = 8


@pytest.fixture
def peer(make_peer: Callable[..., Any]) -> Any:
    made = make_peer()
    made.advertise()
    made.listen()
    return made


@pytest.mark.slow
def test_wrong_baseline_is_said_and_held(start_node: Callable[..., Any], peer: Any) -> None:
    start_node()
    peer.connect()
    data = recording(wrong="baseline reversed", path="line", keyframes=KEYFRAMES, length_m=10.0)
    for k in range(KEYFRAMES):
        peer.publish_keyframes(data, k)
        peer.await_report(0, data.keyframes[k].keyframe_id)

    def held() -> bool:
        last = peer.received["report"][-1]
        return bool(last.status == Status.HELD and "baseline of camera 1 reversed" in last.reason)

    peer.until(held, "a report that says so")
    assert any("baseline of camera 1 reversed" in text for text in peer.received["report"][-1].warnings)

    def undone() -> bool:
        poses = peer.received["path"][-1].poses if peer.received["path"] else []
        found = np.array([(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in poses])
        given = np.array([keyframe.position for keyframe in data.keyframes])
        return found.shape == given.shape and bool(np.abs(found - given).max() < 1e-9)

    peer.until(undone, "the front-end's path")
