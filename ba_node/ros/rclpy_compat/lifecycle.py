# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make rclpy's lifecycle node fit for use: requests that make no sense are answered, and failures are told.

In Jazzy an invalid request raises out of the executor and is never answered (rclpy issue 1209), and so is a parameter
of a type that does not exist; what a transition raises is swallowed without a word. Here a request is answered with
success = false and a line in the log, and a transition that raises is logged and ends in a state from which the node
can be configured anew.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from ba_node.ros.log import Severity, fault, log, printable
from ba_node.ros.rclpy_compat.private import RCLError, part

_SET = "rcl_interfaces/SetParametersResult"


class RefusedError(ValueError):
    """A transition that cannot be made as things are; the text is one line that says what to do."""


def _guarded(method: str, name: str = "") -> Callable[[ManagedNode, Any], Any]:
    """Return what rclpy calls for a transition: runs a method of the node, and says how it went."""

    def run(node: ManagedNode, _state: Any) -> Any:
        try:
            getattr(node, method)()
        except RefusedError as error:
            log(node, Severity.ERROR, f"{name or method} refused: {error}")
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            text = f"{name or method} failed: {type(error).__name__}: {error}"
            log(node, Severity.ERROR, f"{text}\n{traceback.format_exc()}")
            return TransitionCallbackReturn.ERROR
        log(node, Severity.INFO, f"{name or method}: done")
        return TransitionCallbackReturn.SUCCESS

    return run


class ManagedNode(LifecycleNode):  # type: ignore[misc]  # rclpy is not typed
    """A lifecycle node whose transitions are the methods below; each may raise."""

    def __init__(self, node_name: str, **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        self._machine = part(self, "_state_machine", object, "a refused transition is told without what is possible")
        for service in self.services:
            if service.srv_name.endswith("/change_state"):
                self._answer, service.callback = service.callback, self._on_request
            service.callback = answering(self, service.srv_name, service.srv_type.Response, service.callback)

    def configure(self) -> None:
        """Acquire everything."""
        raise NotImplementedError

    def activate(self) -> None:
        """Begin to work."""
        raise NotImplementedError

    def deactivate(self) -> None:
        """Stop work, keep everything."""
        raise NotImplementedError

    def cleanup(self) -> None:
        """Release everything, also what a configure that raised has left. Must be safe at any time, repeatedly."""
        raise NotImplementedError

    @property
    def state(self) -> str:
        """Return the label of the state: unconfigured, inactive, active or finalized."""
        return "in an unknown state" if self._machine is None else str(self._machine.current_state[1])

    def request(self, transition: str) -> bool:
        """Make a transition from within (configure, activate, ...); return False, with a log line, if it fails."""
        try:
            done = getattr(self, f"trigger_{transition}")() == TransitionCallbackReturn.SUCCESS
        except RCLError:
            done = False
        if not done:
            self._tell(transition)
        return bool(done)

    on_configure, on_activate = _guarded("configure"), _guarded("activate")
    on_deactivate, on_cleanup = _guarded("deactivate"), _guarded("cleanup")
    on_shutdown = _guarded("cleanup", "shutdown")
    # After a transition that raised: rclpy then goes back to unconfigured.
    on_error = _guarded("cleanup", "cleanup after the error")

    def _on_request(self, request: Any, response: Any) -> Any:
        """Answer a request of `ros2 lifecycle set`."""
        try:
            response = self._answer(request, response)
        except RCLError:
            response.success = False
        if not response.success:
            self._tell(request.transition.label or str(request.transition.id))
        return response

    def _tell(self, transition: str) -> None:
        text = f"transition {transition!r} was refused or failed; the node is {self.state}"
        if self._machine is not None:
            possible = sorted({item[1] for item in self._machine.available_transitions})
            text += f", from where it can {' or '.join(possible) or 'go nowhere'}"
        log(self, Severity.WARNING, text)


def answering(node: Any, name: str, kind: Any, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a callback that answers with a refusal, as far as the type of the response can say one, when it raises."""

    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            log(node, Severity.ERROR, f"{name} was answered with a refusal: {traceback.format_exc()}")
            return _refusal(kind, request, printable(fault(error)))

    return answer


def _refusal(kind: Any, request: Any, reason: str) -> Any:
    """Return a response without success: rclpy's types have it in different places."""
    response = kind()
    types = response.get_fields_and_field_types()
    if "failure_reason" in types:
        response.failure_reason = reason
    if types.get("result") == _SET:
        response.result.reason = reason
    if types.get("results") == f"sequence<{_SET}>":
        reason += "; those of the request before the one at fault are set"
        response.results = [SetParametersResult(successful=False, reason=reason) for _ in request.parameters]
    return response
