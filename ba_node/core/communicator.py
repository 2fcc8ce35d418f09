# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What ranks tell each other."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, Protocol

from ba_node.arrays import FloatArray


class Communicator(Protocol):
    """Ranks that work on one problem; every rank has to make the same calls in the same order."""

    rank: int  # of this process, from 0
    size: int  # number of ranks
    neighbours: int  # ranks on the machine of this one, itself included

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sum over ranks, bit by bit the same on all."""

    def gather(self, value: Any) -> list[Any] | None:
        """Return the values of all ranks on rank 0, None on others."""

    def broadcast(self, value: Any) -> Any:
        """Return the value of rank 0."""

    def exchange(self, parts: Sequence[Any]) -> list[Any]:
        """Send each rank its part; return what each has sent to this one."""

    def send(self, value: Any, rank: int) -> None:
        """Send another rank something that it receives."""

    def receive(self) -> Any:
        """Return what rank 0 sends, once it does, which may be long."""

    def abort(self, code: int) -> None:
        """End all ranks at once."""

    def finish(self) -> None:
        """Wait for all ranks; the process may end then."""


class Alone:
    """The only rank."""

    rank, size, neighbours = 0, 1, 1

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the values."""
        return values

    def gather(self, value: Any) -> list[Any] | None:
        """Return the only value."""
        return [value]

    def broadcast(self, value: Any) -> Any:
        """Return the value."""
        return value

    def exchange(self, parts: Sequence[Any]) -> list[Any]:
        """Return the only part."""
        return list(parts)

    def send(self, value: Any, rank: int) -> None:
        """Never called: there is no other rank."""
        raise AssertionError(f"no rank {rank} for {type(value).__name__}")

    def receive(self) -> Any:
        """Never called: this is rank 0."""
        raise AssertionError("rank 0 receives nothing")

    def abort(self, code: int) -> None:
        """End this process."""
        sys.exit(code)

    def finish(self) -> None:
        """Wait for nobody."""


def total(communicator: Communicator, matrix: Any) -> Any:
    """Return the sum over ranks of sparse matrices, each of which has few of the sum's entries."""
    parts = communicator.gather(matrix)
    return communicator.broadcast(None if parts is None else sum(parts[1:], parts[0]))
