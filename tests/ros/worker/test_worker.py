# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node.config import Config
from ba_node.estimate import Cloud, Estimate, Poses, SolveReport, Status
from ba_node.measurements import Keyframe, Measurement
from ba_node.messages.report import Report
from ba_node.ros.worker.inbox import Inbox
from ba_node.ros.worker.worker import Notice, Outcome, Output, Worker


class FakeMap:
    """What the worker asks of the map."""

    session_id = 0

    def __init__(self, backend: FakeBackend) -> None:
        self._backend = backend
        self.rejected: Counter[str] = Counter()
        self.index, self.stamp_ns = 0, 0
        self.warnings: tuple[str, ...] = ()

    @property
    def solved_count(self) -> int:
        return len(self._backend.window) - len(self._backend.unsolved)

    @property
    def keyframe_count(self) -> int:
        return len(self._backend.window)

    def is_solved(self, session_id: int, keyframe_id: int) -> bool | None:
        known = [keyframe for keyframe in self._backend.window if keyframe.keyframe_id == keyframe_id]
        if session_id != 0 or not known:
            return None
        return all(known[0] is not other for other in self._backend.unsolved)


class FakeBackend:
    """A back-end whose solve takes as long as the test wants."""

    def __init__(self) -> None:
        self.added: list[Measurement] = []
        self.refused: deque[Measurement] = deque(maxlen=5)
        self.held: list[Keyframe] = []
        self.report = SolveReport()
        self.holds: Keyframe | None = None
        self.refuses: Keyframe | None = None
        self.rejection_notes: deque[str] = deque(maxlen=5)
        self.unsolved: list[Keyframe] = []
        self.window: list[Keyframe] = []
        self.complete = True
        self.at_once = 1000
        self.flushed = 0
        self.fail: str = ""
        self.status = Status.CONVERGED
        self.config = Config()
        self.map = FakeMap(self)
        self.while_solving: Callable[[Callable[[Any], bool]], None] = lambda _: None

    @property
    def ready(self) -> bool:
        return bool(self.unsolved) and self.complete

    def add(self, measurement: Measurement) -> None:
        if self.fail == "add":
            raise RuntimeError("broken add")
        assert isinstance(measurement, Keyframe)
        if measurement is self.holds:
            self.held = [measurement]
            return
        if self.refuses is not None:
            self.refused.append(self.refuses)
            self.refuses = None
        if any(measurement.keyframe_id == keyframe.keyframe_id for keyframe in self.window):
            self.map.rejected["duplicate_keyframe"] += 1
            note = f"keyframe {measurement.keyframe_id}; dropped (duplicate_keyframe = {self.map.rejected.total()})"
            self.rejection_notes.append(note)
            self.refused.append(measurement)
            return
        self.added.append(measurement)
        self.unsolved.append(measurement)
        self.window.append(measurement)

    @property
    def due(self) -> tuple[int, int] | None:
        newest = self.unsolved[: self.at_once]
        return (newest[-1].session_id, newest[-1].keyframe_id) if newest else None

    def flush(self) -> None:
        self.complete = True
        self.flushed += 1

    def solve(self, on_iteration: Callable[[Any], bool]) -> Estimate | None:
        if self.fail == "solve":
            raise RuntimeError("broken solve")
        self.while_solving(on_iteration)
        newest = self.unsolved[: self.at_once][-1]
        self.unsolved = self.unsolved[self.at_once :]
        n = len(self.window)
        poses = Poses(
            np.array([k.keyframe_id for k in self.window], np.uint64),
            np.zeros(n, np.int64),
            np.zeros((n, 3)),
            np.zeros((n, 4)),
        )
        empty = Cloud(np.empty(0, np.uint64), np.empty((0, 3)), np.empty(0, np.float32), np.empty(0, np.int32))
        report = SolveReport(newest_keyframe_id=newest.keyframe_id, status=self.status)
        return Estimate(newest.stamp_ns, "odom", poses, poses, empty, report)


class Rig:
    """A worker around a fake back-end, driven by hand or as a thread."""

    def __init__(self, settle_time_s: float = 60.0, size: int = 100) -> None:
        self.backend = FakeBackend()
        self.inbox = Inbox(size)
        self.new = threading.Event()
        self.now_s = 0.0
        any_backend: Any = self.backend
        self.worker = Worker(any_backend, self.inbox, settle_time_s, self.new.set, clock=lambda: self.now_s)

    def keyframe(self, number: int, time_s: float = 0.0) -> None:
        pose = (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
        self.inbox.put(Keyframe(0, number, number, "odom", *pose), time_s)

    def step(self) -> list[Output]:
        self.worker.step(self.inbox.drain(0.0))
        return self.worker.outputs()

    def wait_for_output(self) -> list[Output]:
        assert self.new.wait(10.0), "nothing came out of the worker in 10 s"
        self.new.clear()
        return self.worker.outputs()


def reports(outputs: list[Output], *, of_solves: bool = True) -> list[Any]:
    """Return what was reported of solves, or of what was turned away, the fields of all parts in one."""
    found = [one for one in outputs if isinstance(one, Outcome) and (one.estimate is not None) == of_solves]
    wholes = [Report(one.report, one.queue) for one in found]
    own = [{"rejected": whole.rejected, "warnings": whole.warnings} for whole in wholes]
    return [
        SimpleNamespace(**vars(one.solve) | vars(one.queue) | extra) for one, extra in zip(wholes, own, strict=True)
    ]


def test_solves_once_for_everything_that_waits() -> None:
    rig = Rig()
    for number in range(5):
        rig.keyframe(number, time_s=10.0 + number)
    rig.now_s = 20.0
    (report,) = reports(rig.step())
    assert (report.newest_keyframe_id, report.coalesced, rig.worker.refined) == (4, 4, 5)
    assert report.queue_wait_s == 6.0, "from the arrival of keyframe 4 at 14 s to 20 s"
    rig.keyframe(5, time_s=21.0)
    rig.now_s = 21.5
    (report,) = reports(rig.step())
    assert (report.newest_keyframe_id, report.coalesced, rig.worker.refined) == (5, 4, 6)
    assert report.queue_wait_s == 0.5


def test_a_repeated_keyframe_is_not_counted_again() -> None:
    rig = Rig()
    rig.keyframe(1)
    rig.step()
    rig.keyframe(1)
    rig.keyframe(2)
    outputs = rig.step()
    (report,) = reports(outputs)
    assert (report.coalesced, rig.worker.refined) == (0, 2)
    assert [output.key for output in outputs if isinstance(output, Notice)] == ["duplicate_keyframe"]


def test_tells_each_rejection_once_with_its_note() -> None:
    rig = Rig()
    rig.keyframe(1)
    rig.keyframe(1)
    (notice,) = [output for output in rig.step() if isinstance(output, Notice)]
    assert notice.text == "keyframe 1; dropped (duplicate_keyframe = 1)"
    assert not notice.is_error
    assert rig.step() == []


def test_a_failed_solve_counts_no_keyframe_as_refined() -> None:
    rig = Rig()
    rig.backend.status = Status.FAILED
    rig.keyframe(1)
    (report,) = reports(rig.step())
    assert (report.status, rig.worker.refined) == (Status.FAILED, 0)
    rig.backend.status = Status.CONVERGED
    rig.keyframe(2)
    (report,) = reports(rig.step())
    assert (report.coalesced, rig.worker.refined) == (0, 2), "keyframe 1 was refined with 2, but not for lack of time"


def test_an_exception_costs_one_solve_only() -> None:
    rig = Rig()
    for fault in ("add", "solve"):
        rig.backend.fail = fault
        rig.keyframe(1)
        (notice,) = rig.step()
        assert isinstance(notice, Notice)
        assert notice.is_error
        assert f"RuntimeError: broken {fault}" in notice.text
    rig.backend.fail = ""
    rig.keyframe(2)
    (report,) = reports(rig.step())
    assert (report.newest_keyframe_id, report.rejected) == (2, {"internal_error": 2})


def test_silence_completes_the_newest_keyframe() -> None:
    rig = Rig(settle_time_s=0.05)
    rig.backend.complete = False
    rig.worker.start()
    try:
        rig.keyframe(7)
        (report,) = reports(rig.wait_for_output())
        assert report.newest_keyframe_id == 7
    finally:
        assert rig.worker.stop()


def test_keyframes_that_come_during_a_solve_are_solved_together() -> None:
    rig = Rig()
    solving, go_on = threading.Event(), threading.Event()

    def block(_: Callable[[Any], bool]) -> None:
        solving.set()
        assert go_on.wait(10.0)

    rig.backend.while_solving = block
    rig.worker.start()
    try:
        rig.keyframe(0)
        assert solving.wait(10.0)
        for number in range(1, 7):
            rig.keyframe(number)
        go_on.set()
        found: list[Any] = []
        while len(found) < 2:
            found += reports(rig.wait_for_output())
        assert [report.newest_keyframe_id for report in found] == [0, 6]
        assert found[-1].coalesced == 5
    finally:
        go_on.set()
        assert rig.worker.stop()


def test_goes_on_while_there_is_more_to_solve() -> None:
    rig = Rig()
    rig.backend.at_once = 3
    rig.worker.start()
    try:
        for number in range(8):
            rig.keyframe(number)
        found: list[Any] = []
        while not found or found[-1].newest_keyframe_id != 7:
            found += reports(rig.wait_for_output())
        assert rig.backend.flushed == 0, "it did not wait for silence"
    finally:
        assert rig.worker.stop()


def test_commands_reach_the_backend_between_measurements() -> None:
    rig = Rig()
    rig.keyframe(1)
    seen: list[int] = []
    rig.inbox.post(lambda backend: seen.append(len(backend.added)))  # type: ignore[attr-defined]
    rig.keyframe(2)
    rig.step()
    assert seen == [1]


def test_drops_show_in_the_report() -> None:
    rig = Rig(size=2)
    for number in range(5):
        rig.keyframe(number)
    (report,) = reports(rig.step())
    assert report.dropped == 3


def test_stops_a_long_solve_after_an_iteration() -> None:
    rig = Rig()
    solving = threading.Event()
    iterations = 0

    def iterate(on_iteration: Callable[[Any], bool]) -> None:
        nonlocal iterations
        while on_iteration(None):
            iterations += 1
            solving.set()
            time.sleep(0.001)

    rig.backend.while_solving = iterate
    rig.worker.start()
    rig.keyframe(1)
    assert solving.wait(10.0)
    start = time.monotonic()
    assert rig.worker.stop()
    assert time.monotonic() - start < 2.0
    assert iterations > 0
    assert reports(rig.worker.outputs()) == [], "an interrupted solve is not published"


def test_outputs_nobody_fetches_are_bounded() -> None:
    rig = Rig()
    for number in range(200):
        rig.keyframe(number)
        rig.worker.step(rig.inbox.drain(0.0))
    kept = reports(rig.worker.outputs())
    assert len(kept) == 20
    assert kept[-1].newest_keyframe_id == 199


def test_every_keyframe_is_accounted_for() -> None:
    rig = Rig(size=4)
    for number in range(6):
        rig.keyframe(number)
    rig.keyframe(5)
    (report,) = reports(rig.step())
    # Of seven messages the inbox kept the last four: 3, 4, 5 and 5 again.
    assert (report.received, report.dropped_keyframes, report.rejected_keyframes) == (7, 3, 1)
    assert (report.solved, report.coalesced, report.waiting) == (1, 2, 0)
    rig.backend.at_once = 1
    rig.keyframe(10)
    rig.keyframe(11)
    rig.keyframe(12)
    (report,) = reports(rig.step())
    assert (report.received, report.solved, report.coalesced, report.waiting) == (10, 2, 2, 2)
    rig.backend.window.remove(rig.backend.unsolved.pop())
    (report,) = reports(rig.step())
    assert (report.solved, report.coalesced, report.waiting, report.dropped_keyframes) == (3, 2, 0, 4), (
        "12 is forgotten"
    )


@pytest.mark.parametrize(("budget_ms", "expected"), [(0.0, 20), (1.0, 1), (105.0, 7), (155.0, 12)])
def test_a_latency_budget_ends_a_solve_in_time(budget_ms: float, expected: int) -> None:
    """Iterations of 10 ms, 10 ms after the last one, and 20 ms in the inbox."""
    rig = Rig()
    rig.backend.config = Config().with_values({"node.latency_budget_ms": budget_ms})
    rig.backend.status = Status.MAX_ITERATIONS
    made = 0

    def iterate(on_iteration: Callable[[Any], bool]) -> None:
        nonlocal made
        made = 0
        go_on = on_iteration(None)
        while go_on and made < 20:
            rig.now_s += 0.01
            made += 1
            go_on = on_iteration(None)
        rig.now_s += 0.01

    rig.backend.while_solving = iterate
    for number in range(2):
        rig.keyframe(number, time_s=rig.now_s)
        rig.now_s += 0.02
        begin_s = rig.now_s - 0.02
        (report,) = reports(rig.step())
        took_ms = 1e3 * (rig.now_s - begin_s)
    # From the second solve on it is known what follows the last iteration.
    assert made == expected
    assert took_ms <= max(budget_ms, 40.0) + 1e-6 or budget_ms == 0.0
    assert report.reason == (
        f"the latency budget of {budget_ms:g} ms was spent after 0 iterations" if budget_ms else ""
    )


def test_what_is_turned_away_is_reported_without_a_solve() -> None:
    rig = Rig()
    rig.keyframe(1)
    rig.step()
    rig.now_s = 10.0
    rig.keyframe(1)
    accounts = reports(rig.step(), of_solves=False)
    assert [(one.rejected_keyframes, one.received) for one in accounts] == [(1, 2)]
    # Not more often than once a second, and never twice the same.
    rig.now_s = 10.5
    rig.keyframe(1)
    assert reports(rig.step(), of_solves=False) == []
    assert rig.worker._patience_s() is not None
    rig.now_s = 11.0
    assert [one.rejected_keyframes for one in reports(rig.step(), of_solves=False)] == [2]
    rig.now_s = 20.0
    assert rig.step() == []
    assert rig.worker._patience_s() is None, "all is said"


def test_a_keyframe_that_is_held_waits_until_it_is_turned_away() -> None:
    rig = Rig()
    rig.keyframe(1)
    rig.step()
    pose = (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    odd = Keyframe(0, 2, -1, "odom", *pose)
    rig.backend.holds = odd
    rig.inbox.put(odd, 1.0)
    rig.step()
    rig.keyframe(3)
    (report,) = reports(rig.step())
    assert (report.received, report.solved, report.waiting, report.dropped_keyframes) == (3, 2, 1, 0)
    rig.backend.holds = None
    rig.backend.held = []
    rig.backend.refuses = odd
    rig.keyframe(4)
    (report,) = reports(rig.step())
    assert (report.received, report.solved, report.waiting, report.rejected_keyframes) == (4, 3, 0, 1)


def test_falling_behind_is_said_once_with_what_to_change() -> None:
    rig = Rig()
    rig.backend.while_solving = lambda _: setattr(rig, "now_s", rig.now_s + 0.5)
    said: list[str] = []
    for number in range(0, 60, 3):
        for k in range(3):
            rig.keyframe(number + k, time_s=rig.now_s)
        outputs = rig.step()
        said += [output.text for output in outputs if isinstance(output, Notice)]
    assert len(said) == 1, said
    assert "falling behind for 5 s: 30 keyframes were solved in 10 solves of 500 ms" in said[0]
    assert "lower window.max_keyframes (20)" in said[0]
    assert reports(outputs)[0].warnings == (said[0],)
    for number in range(100, 105):
        rig.keyframe(number)
        (report,) = reports(rig.step())
    assert report.warnings == (), "it keeps up again"
