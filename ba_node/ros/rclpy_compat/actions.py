# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""An action whose goals end later: rclpy runs a goal as a callback, during which the node does nothing else."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer
from rclpy.action.server import GoalEvent, GoalStatus
from rclpy.qos import QoSProfile
from rclpy.task import Future

from ba_node.ros.rclpy_compat.private import part

# Feedback comes in bursts where iterations are short.
_FEEDBACK_DEPTH = 100


class DeferredAction:
    """An action server; all its callbacks, and its methods, are for the executor's thread.

    ``decide`` returns whether a request becomes a goal; ``accept`` gets the handle of each goal, which it passes to
    :meth:`begin`, and later to :meth:`finish`; ``cancel`` that of a goal that is to end.
    """

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        decide: Callable[[Any], Any],
        accept: Callable[[Any], None],
        cancel: Callable[[Any], Any],
    ) -> None:
        self._kind = kind
        self._waiting: dict[bytes, Any] = {}
        self._server = ActionServer(
            node,
            kind,
            name,
            execute_callback=self._wait,
            goal_callback=decide,
            handle_accepted_callback=accept,
            cancel_callback=cancel,
            feedback_pub_qos_profile=QoSProfile(depth=_FEEDBACK_DEPTH),
        )
        self._futures = part(self._server, "_result_futures", dict, "a goal takes a processor while it lasts")

    def begin(self, handle: Any) -> None:
        """Let the client know that its goal is at work."""
        if self._futures is None:
            self._waiting[bytes(handle.goal_id.uuid)] = Future()
            handle.execute()
        else:
            # What handle.execute() does first; then it would hand over to a callback that returns the result.
            handle._update_state(GoalEvent.EXECUTE)

    def finish(self, handle: Any, *, success: bool, result: Any) -> None:
        """Send the result of a goal."""
        key = bytes(handle.goal_id.uuid)
        if self._futures is None:
            self._waiting.pop(key).set_result((success, result))
            return
        event = GoalEvent.SUCCEED if success else GoalEvent.ABORT
        if handle.is_cancel_requested and not success:
            event = GoalEvent.CANCELED
        response = self._kind.Impl.GetResultService.Response(status=_end_state(handle, event), result=result)
        # As rclpy does after its callback; without an executor the result goes out now, before a cleanup goes on.
        future = self._futures[key]
        future._set_executor(None)
        future.set_result(response)

    def destroy(self) -> None:
        """Withdraw the action."""
        self._server.destroy()

    async def _wait(self, handle: Any) -> Any:
        """Have rclpy wait for the result of a goal, where its own way cannot be left."""
        success, result = await self._waiting[bytes(handle.goal_id.uuid)]
        if success:
            handle.succeed()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        return result


def _end_state(handle: Any, event: Any) -> int:
    """Bring a goal to its end and return the state that it has then; one that never began is aborted."""
    for step in (event, GoalEvent.EXECUTE, GoalEvent.ABORT):
        if not handle.is_active:
            break
        with contextlib.suppress(Exception):  # a step that is not allowed from here, or nobody to tell of it
            handle._update_state(step)
    return GoalStatus.STATUS_ABORTED if handle.is_active else int(handle.status)
