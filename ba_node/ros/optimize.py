# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Offer the action ~/optimize: all keyframes and points that are kept are refined, one goal at a time.

The solver's thread makes a copy of the map and goes on with its windows; a thread of the goal's own solves the copy;
the solver's thread puts the result in, see ``window/full.py``. A goal ends without a result as soon as its map is no
longer the current one: after a reset, another map, or a new session.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import GoalEvent
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile

from ba_node.core.methods import METHODS
from ba_node.core.result import Status
from ba_node.messages.commands import ACTION_TYPES
from ba_node.ros.component import Component, Host
from ba_node.ros.convert import message_class
from ba_node.ros.relay import Relay
from ba_node.window import full, quality

if TYPE_CHECKING:
    from ba_node.backend import Backend
    from ba_node.core.result import Iteration
    from ba_node.estimate import Estimate

_NAME = "optimize"
_GONE = "the map was reset or replaced meanwhile"
_CLEANED_UP = "the node was cleaned up meanwhile"
_RCLError = rclpy_implementation.RCLError
# Feedback comes in bursts where iterations are short.
_FEEDBACK_DEPTH = 100


@dataclass
class _Goal:
    """A goal at work. ``stop`` may be set by any thread, in words that say why."""

    handle: Any
    began_s: float
    stop: str = ""
    result: dict[str, Any] = field(default_factory=dict)

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self.began_s


class Optimize(Component):
    """The action of the node."""

    def __init__(self, host: Host) -> None:
        """Advertise."""
        super().__init__(host)
        self._relay = Relay(self)
        self._goal: _Goal | None = None
        self._cleaned_up = False
        self._type = message_class(ACTION_TYPES[_NAME])
        self._server = ActionServer(
            host.node,
            self._type,
            f"~/{_NAME}",
            execute_callback=_never,
            goal_callback=self._judge,
            handle_accepted_callback=self._accept,
            cancel_callback=self._cancel,
            feedback_pub_qos_profile=QoSProfile(depth=_FEEDBACK_DEPTH),
        )
        host.at_cleanup.callback(self._abandon)

    def _judge(self, request: Any) -> Any:
        """Accept a goal, or reject it and say why in the log: the answer to a goal has no room for it."""
        reason = ""
        if self._cleaned_up:
            reason = _CLEANED_UP
        elif self._goal is not None:
            reason = "another goal is at work: cancel it, or wait for its result"
        elif request.method and request.method not in METHODS:
            reason = f"method = {request.method!r}: choose one of {', '.join(METHODS)}"
        elif not (math.isfinite(request.time_budget_s) and request.time_budget_s >= 0.0):
            reason = f"time_budget_s = {request.time_budget_s}: expected seconds, or 0 for no limit"
        if reason:
            self.host.node.get_logger().warning(f"goal of ~/{_NAME} rejected: {reason}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _accept(self, handle: Any) -> None:
        self._goal = goal = _Goal(handle, time.monotonic())
        # What handle.execute() does first. The rest of it would hand over to a callback that returns the result.
        handle._update_state(GoalEvent.EXECUTE)
        self.host.inbox.post(lambda backend: self._copy(backend, goal))

    def _cancel(self, _handle: Any) -> Any:
        if self._goal is not None:
            self._goal.stop = self._goal.stop or "cancelled; the map is as it was"
        return CancelResponse.ACCEPT

    def _abandon(self) -> None:
        """End a goal when the node is cleaned up, and go; with its result on the way, a moment later."""
        self._cleaned_up = True
        if self._goal is None:
            self._server.destroy()
            return
        self.host.after_cleanup.callback(self._server.destroy)
        self._goal.stop = _CLEANED_UP
        # After a signal there is nobody left to tell, and nothing to tell it with.
        with contextlib.suppress(_RCLError):
            self._finish(self._goal, Status.SKIPPED, self._goal.stop)

    def _copy(self, backend: Backend, goal: _Goal) -> None:
        """Copy the map, on the solver's thread."""
        try:
            taken = full.copy(backend.scene, backend.config)
        except Exception as error:
            self._fail(goal, error)
            raise
        if isinstance(taken, str):
            self._end(goal, Status.SKIPPED, taken)
            return
        # Not a daemon, as the solver's thread is that starts it: Python must not end while the kernels run.
        threading.Thread(target=self._solve, args=(backend, goal, taken), name=_NAME, daemon=False).start()

    def _solve(self, backend: Backend, goal: _Goal, taken: full.Copy) -> None:
        """Solve the copy, on a thread of its own."""
        request = goal.handle.request
        out_of_time = False

        def watch(row: Iteration) -> bool:
            nonlocal out_of_time
            self._relay.call(lambda: self._tell(goal, row, goal.elapsed_s))
            if backend.scene is not taken.scene:
                goal.stop = goal.stop or _GONE
            out_of_time = 0.0 < request.time_budget_s <= goal.elapsed_s
            return not (goal.stop or out_of_time)

        try:
            chosen = full.options(self.host.config.solver, request.method, request.max_iterations)
            solved = taken.solve(chosen, clock=time.perf_counter, on_iteration=watch)
        except Exception as error:
            self._fail(goal, error)
            return
        if out_of_time and solved.result.status is Status.MAX_ITERATIONS:
            text = f"stopped after {request.time_budget_s:g} s"
            solved = solved._replace(result=dataclasses.replace(solved.result, reason=text))
        goal.result = _figures(taken, solved)
        if goal.stop:
            self._end(goal, Status.SKIPPED, goal.stop)
        else:
            self.host.inbox.post(lambda backend: self._merge(backend, goal, taken, solved))

    def _merge(self, backend: Backend, goal: _Goal, taken: full.Copy, solved: full.Solved) -> Estimate | None:
        """Put the result in, on the solver's thread; what it returns is published."""
        try:
            merged = None if goal.stop else backend.merge(taken, solved)
        except Exception as error:
            self._fail(goal, error)
            raise
        result = solved.result
        if merged is None:
            lost = result.status.usable
            self._end(goal, Status.SKIPPED if lost else result.status, (goal.stop or _GONE) if lost else result.reason)
            return None
        estimate, goal.result["followed_keyframes"] = merged
        self._end(goal, result.status, result.reason)
        return estimate

    def _tell(self, goal: _Goal, row: Iteration, elapsed_s: float) -> None:
        """Publish feedback."""
        if goal is self._goal:
            feedback = self._type.Feedback(
                iteration=row.iteration,
                accepted=row.accepted,
                objective=float(row.objective),
                gradient_norm=float(row.gradient_norm),
                linear_iterations=row.linear_iterations,
                elapsed_s=elapsed_s,
            )
            goal.handle.publish_feedback(feedback)

    def _fail(self, goal: _Goal, error: Exception) -> None:
        self._end(goal, Status.FAILED, f"internal error: {type(error).__name__}: {error}")

    def _end(self, goal: _Goal, status: Status, reason: str) -> None:
        """Finish a goal, from any thread."""
        self._relay.call(lambda: self._finish(goal, status, reason))

    def _finish(self, goal: _Goal, status: Status, reason: str) -> None:
        if goal is not self._goal:
            return
        self._goal = None
        handle = goal.handle
        if status.usable:
            handle.succeed()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        text = f"~/{_NAME}: {status.name.lower()}: {reason}"
        (self.host.node.get_logger().info if status.usable else self.host.node.get_logger().warning)(text)
        result = self._type.Result(
            success=status.usable, status=int(status), reason=reason, elapsed_s=goal.elapsed_s, **goal.result
        )
        response = self._type.Impl.GetResultService.Response(status=handle.status, result=result)
        # As rclpy does after its callback; without an executor the result goes out now, before a cleanup goes on.
        future = self._server._result_futures[bytes(handle.goal_id.uuid)]
        future._set_executor(None)
        future.set_result(response)


def _never(_handle: Any) -> None:
    raise AssertionError("goals are executed by the threads of this module")


def _figures(taken: full.Copy, solved: full.Solved) -> dict[str, Any]:
    """Return what the result tells of a solve."""
    figures = quality.figures(taken.selection, solved.result, solved.norms)
    names = ("method", "iterations", "objective_before", "objective_after", "rms_px_before", "rms_px_after")
    return {name: figures[name] for name in (*names, "keyframes", "landmarks", "observations")}
