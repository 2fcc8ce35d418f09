# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ranks that are threads of this process, so that what they tell each other needs no MPI."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ba_node.core.communicator import Alone, Communicator

T = TypeVar("T")


class Meeting:
    """What threads tell each other by."""

    def __init__(self, size: int) -> None:
        self.board: list[Any] = [None] * size
        self.barrier = threading.Barrier(size, timeout=60.0)
        self.letters: list[SimpleQueue[Any]] = [SimpleQueue() for _ in range(size)]


class Threads(Alone):
    """Ranks that are threads of this process."""

    def __init__(self, rank: int, meeting: Meeting) -> None:
        self.rank = rank
        self.size = self.neighbours = len(meeting.board)
        self._board, self._barrier, self._letters = meeting.board, meeting.barrier, meeting.letters

    def gather(self, value: Any) -> list[Any] | None:
        self._board[self.rank] = value
        self._barrier.wait()
        found = list(self._board)
        self._barrier.wait()
        return found if self.rank == 0 else None

    def broadcast(self, value: Any) -> Any:
        if self.rank == 0:
            self._board[0] = value
        self._barrier.wait()
        found = self._board[0]
        self._barrier.wait()
        return found

    def sum(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        parts = self.gather(np.array(values))
        total: NDArray[np.float64] = self.broadcast(None if parts is None else np.sum(parts, axis=0))
        return total.copy()

    def exchange(self, parts: Sequence[Any]) -> list[Any]:
        told = self.broadcast(self.gather(list(parts)))
        return [of[self.rank] for of in told]

    def send(self, value: Any, rank: int) -> None:
        self._letters[rank].put(value)

    def receive(self) -> Any:
        return self._letters[self.rank].get(timeout=60.0)

    def abort(self, code: int) -> None:  # noqa: ARG002
        self._barrier.abort()

    def finish(self) -> None:
        self._barrier.wait()


def on_threads(size: int, work: Callable[[Communicator], T]) -> list[T]:
    """Return what some work gives on each of so many ranks; raise the first error that is not of waiting in vain."""
    meeting = Meeting(size)

    def run(rank: int) -> T | BaseException:
        try:
            return work(Threads(rank, meeting))
        except BaseException as error:  # raised again below
            meeting.barrier.abort()
            return error

    with ThreadPoolExecutor(size) as pool:
        found = list(pool.map(run, range(size)))
    errors = [one for one in found if isinstance(one, BaseException)]
    if errors:
        raise next((one for one in errors if not isinstance(one, threading.BrokenBarrierError)), errors[0])
    return [one for one in found if not isinstance(one, BaseException)]
