# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Answer every client: late, from any thread, and whatever happens meanwhile.

rclpy's way to answer later is a coroutine as callback. It keeps its callback group until it ends, so all other
callbacks of the group wait for it, and it is resumed by looking again each time the executor wakes up; when the service
is destroyed meanwhile, the caller never hears. So here the callback returns at once, and what rclpy would send is kept.

What a client waits for is an :class:`Answer`; :class:`DeferredAnswers` knows all of them. Whoever works on one does so
inside ``with answer.guarded()``: what is raised there, in any thread, becomes the answer. Who still waits when the
solver's thread is found dead, or when the node is cleaned up, is answered then.
"""

from __future__ import annotations

import contextlib
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from rclpy.clock import Clock, ClockType

from ba_node.ros.log import Severity, fault, log, printable
from ba_node.ros.rclpy_compat.private import RCLError

T = TypeVar("T")
# Sends success, message and further fields of an answer, on the executor's thread.
Send = Callable[[bool, str, dict[str, Any]], None]

CLEANED_UP = "the node was cleaned up meanwhile"
DEAD = "the solver's thread has ended: start the node anew"
# How often it is looked whether the solver lives, and for what was not told of.
_LOOK_S = 0.5


class DeferredAnswers:
    """Runs things on the executor's thread, in order, and keeps the answers that clients wait for; until cleanup."""

    def __init__(self, node: Any, solver_lives: Callable[[], bool]) -> None:
        self.node = node
        self._solver_lives = solver_lives
        self._actions: deque[Callable[[], None]] = deque()
        self._expected: dict[Answer, None] = {}
        self._lock = threading.Lock()
        self.open = True
        self.left_waiting = 0  # clients that were answered because of a cleanup, when that was
        # Silence is no reason not to look, and /clock may stand still.
        self._timer = node.create_timer(_LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def expect(self, send: Send) -> Answer:
        """Return an answer that a client waits for; at cleanup and after it is sent at once."""
        answer = Answer(self, self.node, send)
        self._expected[answer] = None
        if not self.open:
            answer.send(success=False, message=CLEANED_UP)
        return answer

    def forget(self, answer: Answer) -> None:
        """Forget an answer that nobody waits for any more."""
        self._expected.pop(answer, None)

    def call(self, action: Callable[[], None]) -> None:
        """Have something run on the executor's thread. May be called from any; after cleanup it does nothing."""
        with self._lock:
            if not self.open:
                return
            self._actions.append(action)
            with contextlib.suppress(Exception):  # nobody spins the node, or it ends; else the timer finds it
                self.node.executor.create_task(self._run)

    def close(self) -> None:
        """Answer all who still wait, and go."""
        with self._lock:
            self.open = False
        self._run()
        self.left_waiting = len(self._expected)
        self._give_up(CLEANED_UP)
        self.node.destroy_timer(self._timer)

    def _run(self) -> None:
        """Do what was asked for; a fault in one action costs that one."""
        while self._actions:
            self._do(self._actions.popleft())

    def _do(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            log(self.node, Severity.ERROR, f"{fault(error)}; going on\n{traceback.format_exc()}")

    def _look(self) -> None:
        self._run()
        if self._expected and not self._solver_lives():
            self._give_up(DEAD)

    def _give_up(self, reason: str) -> None:
        for answer in list(self._expected):
            answer.send(success=False, message=reason)


class Answer:
    """An answer that a client waits for: sent once, on the executor's thread."""

    def __init__(self, deferred: DeferredAnswers, node: Any, send: Send) -> None:
        self.sent = False
        self._answers = deferred
        self._node = node
        self._send = send

    def send(self, *, success: bool, message: str, **fields: Any) -> None:
        """Send the answer. If it cannot be sent as it is, the client hears that; if it has gone, that is its business.

        Raises nothing. To be called on the executor's thread.
        """
        if self.sent:
            return
        self.sent = True
        self._answers.forget(self)
        try:
            self._send(success, printable(message), fields)
        except RCLError:
            return
        except Exception as error:
            reason = printable(fault(error))
            log(self._node, Severity.ERROR, f"{reason}; this was the answer: {message}")
            with contextlib.suppress(Exception):
                self._send(False, reason, {})

    def send_later(self, *, success: bool, message: str, **fields: Any) -> None:
        """Send the answer, from any thread."""
        self._answers.call(lambda: self.send(success=success, message=message, **fields))

    @contextlib.contextmanager
    def guarded(self) -> Iterator[None]:
        """Work on the answer, in any thread: what is raised becomes the answer, and goes on."""
        try:
            yield
        except BaseException as error:
            self.send_later(success=False, message=fault(error))
            raise

    def working(self, action: Callable[..., T]) -> Callable[..., T]:
        """Return an action that works on the answer, in any thread: what it raises becomes the answer, and goes on."""

        def guarded(*arguments: Any) -> T:
            with self.guarded():
                return action(*arguments)

        return guarded

    def in_thread(self, action: Callable[[], None], name: str, *, daemon: bool = False) -> None:
        """Work on the answer on a thread of its own; Python does not end before it has ended, unless it is a daemon."""
        threading.Thread(target=self.working(action), name=name, daemon=daemon).start()


class DeferredService:
    """A service that answers later; its response has ``success`` and ``message``.

    ``begin`` is called with each request and the answer to it, and must not block.
    """

    def __init__(self, answers: DeferredAnswers, kind: Any, name: str, begin: Callable[[Any, Answer], None]) -> None:
        self._answers = answers
        self._begin = begin
        self._kind = kind
        self._service = answers.node.create_service(kind, name, lambda request, _response: request)
        self._send = self._service.send_response
        # The executor passes on to it what the callback returns, with the address of the caller.
        self._service.send_response = self._receive

    def destroy(self) -> None:
        """End the service; nobody who still waits hears anything after that."""
        self._answers.node.destroy_service(self._service)

    def _receive(self, request: Any, header: Any) -> None:
        def send(success: bool, message: str, fields: dict[str, Any]) -> None:
            self._send(self._kind.Response(success=success, message=message, **fields), header)
            log(self._answers.node, Severity.INFO if success else Severity.WARNING, message)

        answer = self._answers.expect(send)
        if answer.sent:
            return
        try:
            with answer.guarded():
                self._begin(request, answer)
        except Exception:
            log(self._answers.node, Severity.ERROR, f"{self._service.srv_name}: {traceback.format_exc()}")
