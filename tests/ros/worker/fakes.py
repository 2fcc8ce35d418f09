# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A back-end that only counts, and a worker that has it."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from ba_node.config import Config
from ba_node.estimate import Cloud, Estimate, Poses, Refinement, SolveReport, Status
from ba_node.measurements import Keyframe, Measurement
from ba_node.messages.report import Report
from ba_node.ros.worker.inbox import Inbox
from ba_node.ros.worker.worker import Outcome, Output, Worker
from ba_node.scene.scene import Scene


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
        self.scene = Scene(self.config.scene, 0)
        self.early = False
        self.after_poses: Callable[[], None] = lambda: None
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

    def solve(self, on_iteration: Callable[[Any], bool], on_poses: Callable[[Refinement], None]) -> Estimate | None:
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
        estimate = Estimate(newest.stamp_ns, "odom", poses, poses, empty, report)
        if self.early:
            on_poses(estimate.refinement)
        self.after_poses()
        return estimate


class Rig:
    """A worker around a fake back-end, driven by hand or as a thread."""

    def __init__(self, settle_time_s: float = 60.0, size: int = 100) -> None:
        self.backend = FakeBackend()
        self.inbox = Inbox(size)
        self.new = threading.Event()
        self.now_s = 0.0
        self.left: list[tuple[Refinement, float]] = []
        any_backend: Any = self.backend
        self.worker = Worker(
            any_backend,
            self.inbox,
            settle_time_s,
            self.new.set,
            lambda *poses: self.left.append(poses),
            clock=lambda: self.now_s,
        )

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
