# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from ba_node.estimate import Status
from ba_node.measurements import Keyframe
from ba_node.ros.worker.worker import Notice
from tests.ros.worker.fakes import Rig, reports


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


def test_drops_show_in_the_report() -> None:
    rig = Rig(size=2)
    for number in range(5):
        rig.keyframe(number)
    (report,) = reports(rig.step())
    assert report.dropped == 3


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
