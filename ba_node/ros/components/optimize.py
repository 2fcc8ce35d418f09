# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Offer the action ~/optimize: all keyframes and points that are kept are refined, one goal at a time.

The solver's thread makes a copy of the map and goes on with its windows; a thread of the goal's own solves the copy;
the solver's thread puts the result in, see ``window/full.py``. A goal ends without a result as soon as its map is no
longer the current one: after a reset, another map, or a new session.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rclpy.action import CancelResponse, GoalResponse

from ba_node.backend import Backend, Optimization
from ba_node.config import find
from ba_node.estimate import Estimate, Iteration, Status
from ba_node.messages.topics import ACTIONS
from ba_node.ros.components.base import Component, Host
from ba_node.ros.log import Severity, fault, log
from ba_node.ros.message_factory import message_class
from ba_node.ros.rclpy_compat.actions import DeferredAction
from ba_node.ros.rclpy_compat.deferred import CLEANED_UP, Answer

_NAME = "optimize"
_METHODS = find("solver.method").choices
_GONE = "the map was reset or replaced meanwhile"


@dataclass
class _Goal:
    """A goal at work. ``stop`` may be set by any thread, in words that say why."""

    handle: Any
    began_s: float
    answer: Answer
    stop: str = ""
    result: dict[str, Any] = field(default_factory=dict)

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self.began_s

    def end(self, status: Status, reason: str) -> None:
        """Answer, from any thread."""
        self.answer.send_later(success=status.usable, message=reason, status=status, **self.result)


class Optimize(Component):
    """The action of the node."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._goal: _Goal | None = None
        self._type = message_class(ACTIONS[_NAME].type_name)
        self._server = DeferredAction(host.node, self._type, f"~/{_NAME}", self._decide, self._accept, self._cancel)
        host.at_cleanup.callback(self._stop)
        # Who is answered at cleanup must still hear it.
        host.after_cleanup.callback(self._server.destroy)

    def _decide(self, request: Any) -> Any:
        """Accept a goal, or reject it and say why in the log: the answer to a goal has no room for it."""
        try:
            reason = self._objection(request)
        except Exception as error:
            reason = fault(error)
        if reason:
            log(self.host.node, Severity.WARNING, f"goal of ~/{_NAME} rejected: {reason}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _objection(self, request: Any) -> str:
        reason = ""
        if not self.host.deferred.open:
            reason = CLEANED_UP
        elif self._goal is not None and not self._goal.answer.sent:
            reason = "another goal is at work: cancel it, or wait for its result"
        elif request.method and request.method not in _METHODS:
            reason = f"method = {request.method!r}: choose one of {', '.join(_METHODS)}"
        elif not (math.isfinite(request.time_budget_s) and request.time_budget_s >= 0.0):
            reason = f"time_budget_s = {request.time_budget_s}: expected seconds, or 0 for no limit"
        return reason

    def _accept(self, handle: Any) -> None:
        goal: _Goal

        def send(success: bool, message: str, fields: dict[str, Any]) -> None:
            self._finish(goal, message, {"success": success} | fields)

        answer = self.host.deferred.expect(send)
        self._goal = goal = _Goal(handle, time.monotonic(), answer)
        try:
            with answer.guarded():
                self._server.begin(handle)
                self.host.inbox.post(answer.working(lambda backend: self._copy(backend, goal)))
        except Exception:
            log(self.host.node, Severity.ERROR, f"~/{_NAME}: {traceback.format_exc()}")

    def _cancel(self, handle: Any) -> Any:
        if self._goal is not None and self._goal.handle is handle:
            self._goal.stop = self._goal.stop or "cancelled; the map is as it was"
        return CancelResponse.ACCEPT

    def _stop(self) -> None:
        """End the solve of a goal after its iteration when the node is cleaned up."""
        if self._goal is not None:
            self._goal.stop = CLEANED_UP

    def _copy(self, backend: Backend, goal: _Goal) -> None:
        """Copy the map, on the solver's thread, and solve the copy on another."""
        begin = backend.copied()
        # Not a daemon, as the solver's thread is that starts it: Python must not end while the kernels run.
        goal.answer.in_thread(lambda: self._solve(backend, goal, begin), _NAME)

    def _solve(self, backend: Backend, goal: _Goal, begin: Callable[[], Optimization | str]) -> None:
        """Solve the copy, on a thread of its own."""
        taken = begin()
        if isinstance(taken, str):
            goal.end(Status.SKIPPED, taken)
            return
        taken = self._solved(backend, goal, taken)
        goal.result = taken.statistics()
        if goal.stop:
            goal.end(Status.SKIPPED, goal.stop)
        else:
            self.host.inbox.post(goal.answer.working(lambda backend: self._merge(backend, goal, taken)))

    def _solved(self, backend: Backend, goal: _Goal, taken: Optimization) -> Optimization:
        request = goal.handle.request
        out_of_time = False

        def watch(row: Iteration) -> bool:
            nonlocal out_of_time
            self.host.deferred.call(lambda: self._tell(goal, row, goal.elapsed_s))
            if not backend.is_current(taken):
                goal.stop = goal.stop or _GONE
            out_of_time = 0.0 < request.time_budget_s <= goal.elapsed_s
            return not (goal.stop or goal.answer.sent or out_of_time)

        choices = (self.host.config.solver, request.method, request.max_iterations)
        taken.solve(*choices, clock=time.perf_counter, on_iteration=watch)
        if out_of_time and taken.result.status is Status.MAX_ITERATIONS:
            return taken.with_result(reason=f"stopped after {request.time_budget_s:g} s")
        return taken

    def _merge(self, backend: Backend, goal: _Goal, taken: Optimization) -> Estimate | None:
        """Put the result in, on the solver's thread; what it returns is published."""
        merged = None if goal.stop or goal.answer.sent else backend.merge(taken)
        if merged is None:
            lost = taken.result.status.usable
            reason = (goal.stop or backend.refusal or _GONE) if lost else taken.result.reason
            held = lost and not goal.stop and backend.refusal
            goal.end(Status.HELD if held else Status.SKIPPED if lost else taken.result.status, reason)
            return None
        estimate, goal.result["followed_keyframes"] = merged
        cameras = [] if taken.calibration is None else taken.calibration.lines()
        words = [taken.result.reason, *(f"camera {i}: {text}" for i, text in enumerate(cameras))]
        goal.end(taken.result.status, "; ".join(words))
        return estimate

    def _tell(self, goal: _Goal, row: Iteration, elapsed_s: float) -> None:
        """Publish feedback."""
        if not goal.answer.sent:
            feedback = self._type.Feedback(
                iteration=row.iteration,
                accepted=row.accepted,
                objective=float(row.objective),
                gradient_norm=float(row.gradient_norm),
                linear_iterations=row.linear_iterations,
                elapsed_s=elapsed_s,
            )
            goal.handle.publish_feedback(feedback)

    def _finish(self, goal: _Goal, reason: str, fields: dict[str, Any]) -> None:
        """Send the result of a goal; what raises before it has left may be tried again with fewer fields."""
        success = fields["success"]
        status = fields.pop("status", Status.FAILED if self.host.deferred.open else Status.SKIPPED)
        result = self._type.Result(reason=reason, status=int(status), elapsed_s=goal.elapsed_s, **fields)
        self._server.finish(goal.handle, success=success, result=result)
        severity = Severity.INFO if success else Severity.WARNING
        log(self.host.node, severity, f"~/{_NAME}: {status.name.lower()}: {reason}")
