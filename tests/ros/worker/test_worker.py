# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Status
from ba_node.measurements import Keyframe
from ba_node.ros.worker import worker
from ba_node.ros.worker.inbox import Arrival, Inbox
from ba_node.ros.worker.worker import Notice, Worker
from tests.ros.worker.fakes import Rig, reports


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


def test_a_report_between_measurements_counts_what_is_behind_it() -> None:
    rig = Rig()
    rig.keyframe(1)
    rig.inbox.post(lambda backend: backend.solve(lambda _: True, lambda _: None))
    rig.keyframe(2)
    first, last = reports(rig.step())
    assert (first.received, first.solved, first.waiting) == (2, 1, 1)
    assert (last.received, last.solved, last.waiting) == (2, 2, 0)


@pytest.mark.parametrize("solves_end", [True, False])
def test_a_check_gives_way_to_solves_wherever_it_is(solves_end: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where none ends it goes on all the same."""
    monkeypatch.setattr(worker, "_GIVES_WAY_S", 60.0 if solves_end else 0.01)
    rig, done = Rig(), []
    solving, looking, go_on = threading.Event(), threading.Event(), threading.Event()

    def solve(_: Callable[[Any], bool]) -> None:
        solving.set()
        assert go_on.wait(10.0)
        done.append("solved")

    def look() -> None:
        looking.set()  # begins before the solve does, and is in the middle of something then
        while not solving.is_set():
            time.sleep(0.001)
        done.append("looked")
        rig.new.set()

    rig.backend.while_solving = solve
    rig.worker.start()
    try:
        rig.worker.check_elsewhere(SimpleNamespace(run=look))  # type: ignore[arg-type]
        assert looking.wait(10.0)
        rig.keyframe(1)
        assert solving.wait(10.0)
        if solves_end:
            time.sleep(0.05)  # in which the check would end if it did not wait
            go_on.set()
        while len(done) < (2 if solves_end else 1):
            rig.wait_for_output()
        go_on.set()
        assert done == ["solved", "looked"][not solves_end :]
    finally:
        go_on.set()
        assert rig.worker.stop()


@pytest.mark.parametrize("silent", [False, True])
def test_what_was_worked_out_beside_solves_is_taken_in_after_the_next_or_in_a_silence(silent: bool) -> None:
    """It may take as long as two solves: a keyframe that comes meanwhile would wait."""
    rig, done = Rig(), list[str]()
    rig.backend.while_solving = lambda _: done.append("solved")
    rig.backend.take_work = lambda _: done.append("taken")  # type: ignore[attr-defined]
    rig.worker.work_elsewhere(SimpleNamespace(run=lambda: None))  # type: ignore[arg-type]
    rig.worker.step(rig.inbox.drain(10.0))
    assert done == []
    if not silent:
        rig.keyframe(1)
    rig.step()
    assert done == ["solved", "taken"][silent:]


def test_a_solve_does_not_wait_for_an_import_of_what_gives_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever imports a module keeps others from it."""
    monkeypatch.setattr(worker, "_GIVES_WAY_S", 60.0)
    monkeypatch.syspath_prepend(tmp_path)
    rig, importing, solving = Rig(), threading.Event(), threading.Event()
    gate = SimpleNamespace(importing=importing, solving=solving)
    monkeypatch.setitem(sys.modules, "gate_of_test", gate)
    body = "import gate_of_test as gate\ngate.importing.set()\nassert gate.solving.wait(10.0)\n"
    (tmp_path / "wanted_by_both.py").write_text(body + "done = [len(str(i)) for i in range(5)]\n")

    def solve(_: Callable[[Any], bool]) -> None:
        solving.set()
        assert importlib.import_module("wanted_by_both").done == [1] * 5

    rig.backend.while_solving = solve
    rig.worker.start()
    try:
        work = SimpleNamespace(run=lambda: importlib.import_module("wanted_by_both"))
        rig.worker.work_elsewhere(work)  # type: ignore[arg-type]
        assert importing.wait(10.0)
        began = time.monotonic()
        rig.keyframe(1)
        (report,) = reports(rig.wait_for_output())
        assert report.newest_keyframe_id == 1
        assert time.monotonic() - began < 10.0
    finally:
        solving.set()
        assert rig.worker.stop()
        sys.modules.pop("wanted_by_both", None)


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


@pytest.mark.parametrize("early", [True, False])
def test_poses_leave_once_and_before_the_rest_is_worked_out(early: bool) -> None:
    rig, left_before_rest = Rig(), []
    rig.backend.early = early
    rig.backend.after_poses = lambda: left_before_rest.append(len(rig.left))
    rig.keyframe(7, time_s=0.25)
    (report,) = reports(rig.step())
    ((refinement, arrived_s),) = rig.left
    assert left_before_rest == [int(early)]
    assert refinement.poses is not None
    assert (refinement.poses.keyframe_id.tolist(), arrived_s, report.newest_keyframe_id) == ([7], 0.25, 7)


@pytest.mark.parametrize("early", [True, False])
def test_what_was_published_counts_where_the_node_ends_meanwhile(early: bool) -> None:
    rig = Rig()
    rig.backend.early = early
    rig.backend.after_poses = rig.inbox.close
    rig.keyframe(7)
    rig.step()
    assert (len(rig.left), rig.worker.refined) == ((1, 1) if early else (0, 0))


def test_outputs_nobody_fetches_are_bounded() -> None:
    rig = Rig()
    for number in range(200):
        rig.keyframe(number)
        rig.worker.step(rig.inbox.drain(0.0))
    kept = reports(rig.worker.outputs())
    assert len(kept) == 20
    assert kept[-1].newest_keyframe_id == 199


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


def test_a_clock_that_is_set_is_said_while_keyframes_come() -> None:
    backend, inbox = Backend(Config()), Inbox(100)
    one = Worker(backend, inbox, 1.0, lambda: None, lambda _poses, _arrived_s: None)
    for k in range(30):
        stamp_s = 100.0 + 0.5 * k + 60.0 * (k >= 20)
        keyframe = Keyframe(0, k, round(1e9 * stamp_s), "odom", np.array([0.3 * k, 0.0, 0.0]), np.eye(4)[3])
        one.step([Arrival(7.0 + 0.5 * k, keyframe)])
    found = [text for text in backend.report.warnings if "the clock was set" in text]
    assert len(found) == 1 and "jump forward by 60 s at keyframe 20 (" in found[0]
    assert [out.text for out in one.outputs() if isinstance(out, Notice) and "the clock was set" in out.text] == found
