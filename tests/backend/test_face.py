# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The face of the back-end: a stream replayed, a map summed up, everything solved, and what is asked of keyframes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.backend import Backend, MapEnded, Optimization
from ba_node.config import Config
from ba_node.estimate import Estimate, Status
from ba_node.measurements import Keyframe
from tests.backend.session_streams import HOUR, N, Played, all_ids, changed, data, groups, joined, messages, stamped


@pytest.mark.slow
def test_a_stream_is_replayed_with_one_solve_a_keyframe() -> None:
    """The same as by hand: a solve before each keyframe that begins, and the rest at the end."""
    backend, by_hand = Backend(Config()), Played(messages())
    events = list(backend.replay(messages()))
    assert [event.keyframe_id for event in events if isinstance(event, Keyframe)] == all_ids()
    estimates = [event for event in events if isinstance(event, Estimate)]
    assert len(estimates) == N
    for mine, theirs in zip(estimates, by_hand.estimates, strict=True):
        assert theirs is not None
        assert mine.trajectory.position.tobytes() == theirs.trajectory.position.tobytes()
    # A keyframe is told of when the map has it, before its own solve.
    assert [type(event) for event in events] == [Keyframe, Estimate] * N


def test_a_map_that_ends_is_summed_up_before_the_next_begins() -> None:
    parts = groups()
    stream = joined([*parts[:8], *(changed(part, session_id=3) for part in parts[8:])])
    backend = Backend(Config())
    events = list(backend.replay(stream))
    (at,) = [i for i, event in enumerate(events) if isinstance(event, MapEnded)]
    ended, after = events[at], events[at + 1]
    assert isinstance(ended, MapEnded) and isinstance(after, Keyframe)
    assert (ended.replaced, after.keyframe_id) == (False, all_ids()[8])
    assert (ended.summary.session_id, ended.summary.keyframes, ended.summary.cameras) == (0, 8, 2)
    assert ended.summary.observations == sum(len(t.track_id) for both in data().tracks[:8] for t in both)
    assert backend.map.summary().keyframes == N - 8
    assert (backend.map.session_id, backend.map.index) == (3, 1)


@pytest.mark.slow
def test_a_lone_keyframe_with_an_absurd_stamp_counts_as_no_map() -> None:
    parts = groups()
    parts[0] = stamped(parts[0], HOUR)
    ended = [event for event in Backend(Config()).replay(joined(parts)) if isinstance(event, MapEnded)]
    assert [event.replaced for event in ended] == [True]


def test_a_keyframe_is_solved_waits_or_is_not_known() -> None:
    backend = Backend(Config())
    for measurement in joined(groups()[:3]):
        backend.add(measurement)
    first, last = all_ids()[0], all_ids()[2]
    assert backend.map.keyframe_count == 3
    assert [backend.map.is_solved(0, key) for key in (first, last)] == [False, False]
    assert backend.map.is_solved(1, first) is None and backend.map.is_solved(0, all_ids()[5]) is None
    backend.flush()
    while backend.ready:
        backend.solve()
    assert [backend.map.is_solved(0, key) for key in (first, last)] == [True, True]
    assert backend.map.solved_count == 3
    assert backend.map.refined_among(all_ids()) <= set(all_ids()[:3])
    given = backend.map.input_keyframes()
    assert [keyframe.keyframe_id for keyframe in given] == all_ids()[:3]
    for ours, theirs in zip(given, data().keyframes[:3], strict=True):
        assert (ours.stamp_ns, ours.frame_id) == (theirs.stamp_ns, theirs.frame_id)
        np.testing.assert_allclose(ours.position, theirs.position, atol=1e-12)
        assert abs(abs(float(ours.orientation @ theirs.orientation)) - 1.0) < 1e-12


@pytest.mark.parametrize("elsewhere", [False, True])
def test_poses_do_not_wait_for_a_check_that_is_made_elsewhere(elsewhere: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is made at once may hold the solve, and comes before it."""
    backend, events = Backend(Config()), list[str]()
    if elsewhere:
        backend.setup.elsewhere = lambda _: None

    def look(*_: object) -> str:
        events.append("look")
        return ""

    monkeypatch.setattr(backend.setup, "look", look)
    for measurement in joined(groups()[:3]):
        backend.add(measurement)
    backend.flush()
    estimate = backend.solve(on_poses=lambda _: events.append("poses"))
    assert estimate is not None and estimate.report.status.usable, "poses were taken"
    assert events == (["poses", "look"] if elsewhere else ["look", "poses"])


@pytest.mark.slow
def test_everything_is_solved_in_one_call_as_in_three() -> None:
    one, three = Played(messages()), Played(messages())
    estimate = one.optimize()
    begun = three.begin_optimization()
    assert isinstance(begun, Optimization) and three.is_current(begun)
    begun.solve(three.config.solver)
    merged = three.merge(begun)
    assert estimate is not None and merged is not None
    assert estimate.report.status is Status.CONVERGED
    assert estimate.trajectory.position.tobytes() == merged[0].trajectory.position.tobytes()
    statistics = begun.statistics()
    assert statistics["keyframes"] + int(begun.selection.problem.fixed.sum()) == N
    assert statistics["objective_after"] <= statistics["objective_before"]
    three.reset()
    assert not three.is_current(begun) and three.merge(begun) is None


def test_nothing_is_optimised_where_there_is_nothing() -> None:
    backend = Backend(Config())
    assert backend.optimize() is None
    assert backend.begin_optimization() == "no camera rig yet: nothing is known about the cameras"


@pytest.mark.slow
@pytest.mark.parametrize("reason", ["", "stopped after 2 s"])
def test_a_result_is_given_other_words(reason: str) -> None:
    begun = Played(messages()).begin_optimization()
    assert isinstance(begun, Optimization)
    begun.solve(Config().solver, "lma_cd", 2)
    other = begun.with_result(reason=reason)
    assert (other.result.reason, other.result.method, begun.result.reason == reason) == (reason, "lma_cd", False)
    assert dataclasses.replace(other.result, reason="") == dataclasses.replace(begun.result, reason="")
