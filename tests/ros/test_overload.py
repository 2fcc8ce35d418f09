# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A front-end five times as fast as the node, over a real middleware."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import pytest
from rcl_interfaces.srv import GetParameters

from ba_node.core import solver
from ba_node.estimate import Status
from experiments.synthetic import SyntheticOptions, generate

pytestmark = [pytest.mark.dds, pytest.mark.slow]

KEYFRAMES = 60
SOLVE_S = 0.25
PERIOD_S = SOLVE_S / 5


def solve_slowly() -> None:
    """Have every solve take SOLVE_S at least, in a wait that lets go of the interpreter as the kernels do."""
    solve = solver.solve

    def slowly(problem: Any, options: Any, **others: Any) -> Any:
        end = time.monotonic() + SOLVE_S
        result = solve(problem, options, **others)
        while time.monotonic() < end:
            time.sleep(0.01)
        return result

    vars(solver)["solve"] = slowly


@pytest.mark.parametrize("inbox_size", [500, 12], ids=["coalescing", "dropping"])
def test_five_times_the_rate_it_can_hold(
    start_node: Callable[..., Any], make_peer: Callable[..., Any], inbox_size: int
) -> None:
    arguments = ["--ros-args", "-p", f"node.inbox_size:={inbox_size}", "-p", "node.latency_budget_ms:=100"]
    node, peer = start_node(*arguments, prepare=solve_slowly), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    scene = generate(SyntheticOptions(seed=3, keyframes=KEYFRAMES, length_m=30.0, tracks=60))
    peer.publish(scene.rig)
    reports, answers = peer.received["report"], 0
    ask = GetParameters.Request(names=["node.latency_budget_ms"])
    for keyframe, tracks in zip(scene.keyframes, scene.tracks, strict=True):
        due_s = time.monotonic() + PERIOD_S
        peer.publish(dataclasses.replace(keyframe, stamp_ns=time.time_ns()))
        for image in tracks:
            peer.publish(image, keyframe.stamp_ns)
        future = peer.send(GetParameters, "ba_node/get_parameters", ask)
        peer.until(future.done, "an answer while the solver is busy")
        answers += future.result().values[0].double_value == 100.0
        peer.until(lambda due_s=due_s: time.monotonic() >= due_s, "the next keyframe to be due")
    newest = scene.keyframes[-1].keyframe_id

    def settled() -> bool:
        return bool(reports) and reports[-1].received == KEYFRAMES and reports[-1].waiting == 0

    peer.until(settled, "every keyframe to be accounted for")
    last = reports[-1]
    assert answers == KEYFRAMES
    assert last.newest_keyframe_id == newest and Status(last.status).usable, last.reason
    refined = peer.received["refined_keyframes"]
    peer.until(lambda: any(newest in message.keyframe_id for message in refined), "the newest keyframe, refined")
    for report in reports:
        known = report.solved + report.coalesced + report.dropped_keyframes + report.rejected_keyframes
        assert report.received == known + report.waiting, f"{report.received} received, {known} and {report.waiting}"
        # What the worker took is solved with the next; what waits in the inbox is bounded.
        assert report.waiting <= inbox_size
    assert last.coalesced > KEYFRAMES / 2, f"{last.coalesced} of {KEYFRAMES} coalesced"
    assert last.rejected_keyframes == 0
    if inbox_size >= 3 * KEYFRAMES:
        assert (last.dropped, last.dropped_keyframes) == (0, 0)
    else:
        assert last.dropped > 0, "three messages a keyframe, five keyframes a solve: more than the inbox holds"
    # No keyframe waits longer than for the solve that runs when it comes, and its own.
    assert 0.0 < last.latency_p50_s <= last.latency_p95_s <= last.latency_max_s
    assert last.stamp_latency_max_s > 0.0
    assert node.alive
    assert node.stop() == 0, node.err


def test_path_and_points_come_to_who_comes_late(start_node: Callable[..., Any], make_peer: Callable[..., Any]) -> None:
    """Nobody listened to them before, so they were not worked out; and no keyframe comes any more."""
    start_node()
    peer = make_peer()
    peer.advertise()
    peer.listen("report")
    peer.connect()
    scene = generate(SyntheticOptions(seed=3, keyframes=6, length_m=10.0, path="line"))
    peer.publish(scene.rig)
    for keyframe, tracks in zip(scene.keyframes, scene.tracks, strict=True):
        peer.publish(keyframe)
        for image in tracks:
            peer.publish(image)
    reports = peer.received["report"]
    peer.until(lambda: reports and reports[-1].received == 6 and reports[-1].waiting == 0, "the last report")
    n_reports = len(reports)
    for _ in range(2):
        late = make_peer()
        late.listen("points", "path")
        late.until(lambda late=late: late.received["points"] and late.received["path"], "points and path")
        assert len(late.received["path"][-1].poses) == 6
        assert late.received["points"][-1].width > 50
    peer.until(lambda: peer.node.count_subscribers("ba_node/path") == 2, "the others to be known here too")
    assert len(reports) == n_reports, "no solve was made for it"
