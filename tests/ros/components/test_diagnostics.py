# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""/diagnostics over a real middleware: silence, work, and a solve that fails."""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from ba_node.core import solver
from ba_node.core.result import Result, Status
from ba_node.ros import qos
from ba_node.ros.components.diagnostics import _resident_mb, _since
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]


@pytest.fixture(scope="module")
def data() -> SyntheticData:
    options = SyntheticOptions(seed=5, keyframes=6, length_m=10.0, path="line", outlier_share=0.0, tracks=100)
    return generate(options)


def listening(make_peer: MakePeer, **options: Any) -> Any:
    peer = make_peer(**options)
    take = peer.received["/diagnostics"].append
    peer.node.create_subscription(DiagnosticArray, "/diagnostics", take, qos.reliable(100))
    return peer


def status(peer: Any, subject: str) -> Any:
    """Return the newest status of a subject, None before there is one."""
    arrays = peer.received["/diagnostics"]
    return next((one for one in arrays[-1].status if one.name.endswith(f": {subject}")), None) if arrays else None


def level(peer: Any, subject: str) -> Any:
    found = status(peer, subject)
    return None if found is None else found.level


def values(found: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in found.values}


@pytest.mark.slow
@pytest.mark.dds
def test_silence_is_stale_and_names_who_is_missing(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node = start_node("--ros-args", "-r", "__ns:=/car", "-p", "node.silence_s:=1.5")
    peer = listening(make_peer, namespace="car")
    peer.until(lambda: level(peer, "inputs") == DiagnosticStatus.STALE, "stale inputs")
    found = status(peer, "inputs")
    assert "no keyframe for" in found.message
    assert "nobody publishes /car/keyframes, /car/feature_tracks" in found.message
    assert (found.name, found.hardware_id) == ("/car/ba_node: inputs", "/car/ba_node")
    assert status(peer, "solver").message == "no solve yet"

    peer.advertise()
    peer.listen("report")
    peer.connect()
    peer.play(data)
    peer.until(lambda: values(status(peer, "solver")).get("solves") == str(len(data.keyframes)), "the last solve")
    solver, inputs = values(status(peer, "solver")), values(status(peer, "inputs"))
    assert level(peer, "solver") == DiagnosticStatus.OK, status(peer, "solver").message
    assert (solver["status"], solver["keyframes free"]) == ("CONVERGED", str(len(data.keyframes) - 1))
    assert 0.1 < float(solver["rms [px]"]) < 2.0
    assert 0.8 < float(solver["inlier share"]) <= 1.0
    assert float(inputs["keyframes [Hz]"]) > 0.0
    assert inputs["publishers of /car/keyframes"] == "1"
    assert float(values(status(peer, "memory"))["resident [MB]"]) > 20.0
    assert float(values(status(peer, "latency"))["latency_max [ms]"]) > 0.0
    assert values(status(peer, "queue"))["received"] == str(len(data.keyframes))
    assert len(peer.received["/diagnostics"][-1].status) == 6
    assert node.stop() == 0


def fail_from_the_third() -> None:
    calls, solve = [], solver.solve

    def failing(problem: Any, *arguments: Any, **options: Any) -> Result:
        calls.append(1)
        if len(calls) < 3:
            return solve(problem, *arguments, **options)
        return Result(problem.start, Status.FAILED, "made to fail", "test", ())

    vars(solver)["solve"] = failing


@pytest.mark.slow
@pytest.mark.dds
def test_a_solve_that_fails_is_an_error(start_node: StartNode, make_peer: MakePeer, data: SyntheticData) -> None:
    start_node(prepare=fail_from_the_third)
    peer = listening(make_peer)
    peer.advertise()
    peer.listen("report")
    peer.connect()
    peer.play(data)
    peer.until(lambda: level(peer, "solver") == DiagnosticStatus.ERROR, "an error of the solver")
    assert status(peer, "solver").message == "the last solve failed: made to fail"


@pytest.mark.slow
@pytest.mark.dds
def test_thresholds_are_live(start_node: StartNode, make_peer: MakePeer) -> None:
    start_node()
    peer = listening(make_peer)
    peer.until(lambda: level(peer, "memory") == DiagnosticStatus.OK, "memory")
    assert peer.set("diagnostics.memory_warn_mb", 1.0).successful
    peer.until(lambda: level(peer, "memory") == DiagnosticStatus.WARN, "a warning")
    assert peer.set("diagnostics.memory_error_mb", 2).successful
    peer.until(lambda: level(peer, "memory") == DiagnosticStatus.ERROR, "an error")


@pytest.mark.slow
@pytest.mark.dds
def test_what_is_turned_away_warns(start_node: StartNode, make_peer: MakePeer, data: SyntheticData) -> None:
    start_node("--ros-args", "-p", "diagnostics.recent_s:=1000.0")
    peer = listening(make_peer)
    peer.advertise()
    peer.listen("report")
    peer.connect()
    peer.play(dataclasses.replace(data, keyframes=data.keyframes[:3], tracks=data.tracks[:3]))
    peer.publish(data.keyframes[0])
    peer.play(dataclasses.replace(data, keyframes=data.keyframes[3:], tracks=data.tracks[3:]))
    peer.until(lambda: level(peer, "inputs") == DiagnosticStatus.WARN, "a warning")
    assert "turned away in the last 1000 s: duplicate_keyframe 1" in status(peer, "inputs").message
    assert values(status(peer, "inputs"))["rejected: duplicate_keyframe"] == "1"


def test_counts_since_are_those_of_the_span() -> None:
    history = deque([(0.0, Counter[str]())])
    seen = [_since(history, float(t), 3.0, Counter(a=t)) for t in range(1, 8)]
    assert [before["a"] for _, before in seen] == [0, 0, 0, 1, 2, 3, 4]
    assert [began for began, _ in seen] == [0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0]
    assert len(history) <= 5


def test_memory_is_that_of_this_process() -> None:
    assert 10.0 < _resident_mb() < 100_000.0
