# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Bring work from other threads to the executor's, and let a service answer later than its callback returns.

rclpy's way to answer later is a coroutine as callback. It keeps its callback group until it ends, so all other
callbacks of the group wait for it, and it is resumed by looking again each time the executor wakes up; when the service
is destroyed meanwhile, the caller never hears. So here the callback returns at once, and what rclpy would send is kept.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections import deque
from typing import TYPE_CHECKING, Any

from rclpy.impl.implementation_singleton import rclpy_implementation

if TYPE_CHECKING:
    from collections.abc import Callable

    from ba_node.ros.component import Component

_RCLError = rclpy_implementation.RCLError
_CLEANED_UP = "the node was cleaned up meanwhile"


class Relay:
    """Runs things on the executor's thread, in order; until the component is cleaned up."""

    def __init__(self, component: Component) -> None:
        """Make what wakes the executor."""
        node = component.host.node
        self._lock = threading.Lock()
        self._actions: deque[Callable[[], None]] = deque()
        self._guard = node.create_guard_condition(self._run)
        component.host.at_cleanup.callback(node.destroy_guard_condition, self._guard)
        component.host.at_cleanup.callback(self._close)
        self._open = True

    def call(self, action: Callable[[], None]) -> None:
        """Have something run on the executor's thread. May be called from any; after cleanup it does nothing."""
        with self._lock:
            if self._open:
                self._actions.append(action)
                self._guard.trigger()

    def _run(self) -> None:
        while self._actions:
            self._actions.popleft()()

    def _close(self) -> None:
        with self._lock:
            self._open = False
            self._actions.clear()


class Answer:
    """The answer that a service owes: given once, on the executor's thread."""

    def __init__(self, response: Any, send: Callable[[Any], None], answered: Callable[[Answer], None]) -> None:
        self.given = False
        self._response = response
        self._send = send
        self._answered = answered

    def give(self, *, success: bool, message: str, **fields: Any) -> None:
        """Fill in the response and send it. If the caller has gone, that is its business."""
        if self.given:
            return
        self.given = True
        for name, value in {"success": success, "message": message, **fields}.items():
            setattr(self._response, name, value)
        self._answered(self)
        with contextlib.suppress(_RCLError):
            self._send(self._response)


class LateService:
    """A service that answers later.

    Args:
        component: whose service it is.
        kind: type of the service; its response has ``success`` and ``message``.
        name: its name.
        begin: called with each request and the answer that is owed for it; must not block.
    """

    def __init__(self, component: Component, kind: Any, name: str, begin: Callable[[Any, Answer], None]) -> None:
        self._begin = begin
        self._host = component.host
        self._owed: set[Answer] = set()
        self._service = self._host.node.create_service(kind, name, lambda request, response: (request, response))
        self._send = self._service.send_response
        # The executor passes on to it what the callback returns, with the address of the caller.
        self._service.send_response = self._receive
        self._host.at_cleanup.callback(self._abandon)

    def _receive(self, call: tuple[Any, Any], header: Any) -> None:
        request, response = call
        answer = Answer(response, lambda filled: self._send(filled, header), self._owed.discard)
        self._owed.add(answer)
        try:
            self._begin(request, answer)
        except Exception as error:
            answer.give(success=False, message=f"internal error: {type(error).__name__}: {error}")
            raise

    def _abandon(self) -> None:
        """Answer those who still wait when the node is cleaned up, and go; with answers on the way, a moment later."""
        owed, self._begin = list(self._owed), _refuse
        for answer in owed:
            answer.give(success=False, message=_CLEANED_UP)
        destroy = functools.partial(self._host.node.destroy_service, self._service)
        if owed:
            self._host.after_cleanup.callback(destroy)
        else:
            destroy()


def _refuse(_request: Any, answer: Answer) -> None:
    answer.give(success=False, message=_CLEANED_UP)
