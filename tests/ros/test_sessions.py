# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions over a real middleware: a clock set back, a front-end that restarts, and messages of no use."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.messages.factory import stamp_ns_from_message
from ba_node.ros import qos
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

tf2 = pytest.importorskip("tf2_msgs.msg", reason="needs tf2_msgs: make setup", exc_type=ImportError)

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]
S = 1_000_000_000
HOUR = 3600 * S
N = 10


@pytest.fixture(scope="module")
def data() -> SyntheticData:
    return generate(SyntheticOptions(seed=3, keyframes=N, length_m=10.0, path="line", outlier_share=0.0, tracks=100))


def listening(make_peer: MakePeer) -> Any:
    peer = make_peer()
    peer.advertise()
    peer.listen("report")
    for kind, topic in ((tf2.TFMessage, "/tf"), (DiagnosticArray, "/diagnostics")):
        peer.node.create_subscription(kind, topic, peer.received[topic].append, qos.reliable(1000))
    peer.connect()
    return peer


def group(data: SyntheticData, k: int, session_id: int = 0, shift_ns: int = 0) -> list[Any]:
    keyframe = data.keyframes[k]
    moved = dataclasses.replace(keyframe, session_id=session_id, stamp_ns=keyframe.stamp_ns + shift_ns)
    return [moved, *(dataclasses.replace(image, session_id=session_id) for image in data.tracks[k])]


def send(peer: Any, several: Iterable[Any]) -> None:
    for measurement in several:
        peer.publish(measurement)


def play(peer: Any, data: SyntheticData, rows: Iterable[int], session_id: int = 0, shift_ns: int = 0) -> None:
    """Send keyframes, each once there is a report on the one before."""
    for k in rows:
        send(peer, group(data, k, session_id, shift_ns))
        peer.await_report(session_id, data.keyframes[k].keyframe_id)


def transforms(peer: Any) -> list[int]:
    """Return the stamps of all transforms that have come."""
    return [stamp_ns_from_message(one.header.stamp) for message in peer.received["/tf"] for one in message.transforms]


def finding(peer: Any, subject: str) -> Any:
    arrays = peer.received["/diagnostics"]
    return next((one for one in arrays[-1].status if one.name.endswith(f": {subject}")), None) if arrays else None


@pytest.mark.slow
def test_transforms_go_on_with_the_stamps_of_a_clock_that_was_set_back(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node, peer = start_node(), listening(make_peer)
    peer.publish(data.rig)
    play(peer, data, range(5))
    before = max(transforms(peer))
    send(peer, group(data, 5, shift_ns=-HOUR))
    play(peer, data, range(6, N), shift_ns=-HOUR)
    newest_ns = data.keyframes[N - 1].stamp_ns - HOUR
    n = len(transforms(peer))
    # What was sent before the last report may come after it, on a topic of its own.
    peer.until(lambda: len(found := transforms(peer)) >= n + 5 and found[-5] >= newest_ns, "repeated transforms")
    last = transforms(peer)[-5:]
    assert last == sorted(set(last)), "stamps rise"
    assert newest_ns <= last[0] <= last[-1] <= newest_ns + 30 * S < before
    assert "s older than the newest (scene.max_reorder_s = 10): a new session begins" in node.err
    report = peer.received["report"][-1]
    assert report.keyframes + report.fixed_keyframes == N - 5
    assert (report.waiting, report.rejected_keyframes, report.received) == (0, 0, N)
    assert node.stop() == 0, node.err


@pytest.mark.slow
def test_one_absurd_stamp_is_turned_away_by_name_and_the_map_goes_on(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node, peer = start_node(), listening(make_peer)
    peer.publish(data.rig)
    play(peer, data, range(4))
    bad = group(data, 4)
    send(peer, [dataclasses.replace(bad[0], stamp_ns=0), *bad[1:]])
    play(peer, data, range(5, N))
    report = peer.received["report"][-1]
    assert dict(zip(report.rejected_reason, report.rejected_count, strict=True)) == {
        "bad_stamp": 1, "unknown_keyframe": 2
    }  # fmt: skip
    assert (report.received, report.rejected_keyframes, report.waiting) == (N, 1, 0)
    assert report.solved + report.coalesced == N - 1
    assert any("keyframe 4 is" in text for text in report.warnings)
    assert "keyframe 4 is" in node.err and "bad_stamp = 1" in node.err
    assert max(transforms(peer)) < data.keyframes[-1].stamp_ns + 60 * S
    assert node.stop() == 0, node.err


@pytest.mark.slow
def test_a_restart_with_a_lower_session_is_said_at_once_and_taken_in_soon(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node, peer = start_node(), listening(make_peer)
    peer.publish(data.rig)
    play(peer, data, range(4), session_id=7)
    count = len(peer.received["report"])
    send(peer, group(data, 0, session_id=3))
    peer.until(lambda: len(peer.received["report"]) > count, "a report though nothing is solved")
    report = peer.received["report"][-1]
    assert "stale_session" in report.rejected_reason
    assert (report.solve_count, report.rejected_keyframes) == (peer.received["report"][count - 1].solve_count, 1)

    def warned() -> bool:
        found = finding(peer, "inputs")
        return found is not None and found.level == DiagnosticStatus.WARN and "stale_session" in found.message

    peer.until(warned, "a warning on /diagnostics")
    assert "stale_session" in node.err
    send(peer, group(data, 1, session_id=3))
    play(peer, data, range(2, N), session_id=3)
    report = peer.received["report"][-1]
    assert any("3 keyframes in a row are of session 3, below the current 7" in text for text in report.warnings)
    assert "3 keyframes in a row are of session 3" in node.err
    assert report.status < 3, report.reason
    assert node.stop() == 0, node.err


@pytest.mark.slow
def test_messages_of_no_use_do_not_end_the_map(start_node: StartNode, make_peer: MakePeer, data: SyntheticData) -> None:
    node, peer = start_node(), listening(make_peer)
    peer.publish(data.rig)
    play(peer, data, range(4))
    none = np.empty(0, np.uint64)
    send(peer, [FeatureTracks(9, 3, 0, none, np.empty((0, 2))), LandmarkGuesses(9, none, np.empty((0, 3)))])
    unusable = dataclasses.replace(data.keyframes[4], session_id=9, orientation=np.zeros(4))
    assert isinstance(unusable, Keyframe)
    peer.publish(unusable)
    play(peer, data, range(4, N))
    report = peer.received["report"][-1]
    assert report.keyframes + report.fixed_keyframes == N
    assert list(report.rejected_reason) == ["bad_pose"]
    assert node.stop() == 0, node.err
