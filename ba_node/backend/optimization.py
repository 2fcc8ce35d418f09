# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve everything that is kept: on a snapshot of the map, on any thread, while the back-end goes on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from ba_node.config import SolverConfig
from ba_node.core.result import Result
from ba_node.estimate import Iteration
from ba_node.window import full, quality

_TOLD = (
    "method",
    "iterations",
    "objective_before",
    "objective_after",
    "rms_px_before",
    "rms_px_after",
    "keyframes",
    "landmarks",
    "observations",
)


def _no_clock() -> float:
    return 0.0


class Optimization:
    """One solve of everything: made by ``Backend.begin_optimization``, and put into the map by ``Backend.merge``.

    Attributes:
        snapshot: the problem of what was kept when it was made.
        solved: what came of it, None before :meth:`solve`.
    """

    def __init__(self, snapshot: full.Snapshot) -> None:
        """Take a snapshot."""
        self.snapshot = snapshot
        self.solved: full.Solved | None = None

    def solve(
        self,
        config: SolverConfig,
        method: str = "",
        max_iterations: int = 0,
        *,
        clock: Callable[[], float] = _no_clock,
        on_iteration: Callable[[Iteration], bool] | None = None,
    ) -> None:
        """Solve; the map is not touched. A method and a number of iterations take the place of the parameters'.

        The clock (s) is for the report alone; ``on_iteration`` ends the solve by returning False.
        """
        chosen = full.options(config, method, max_iterations)
        self.solved = self.snapshot.solve(chosen, clock=clock, on_iteration=on_iteration)

    @property
    def result(self) -> Result:
        """Return what the solver gave back."""
        assert self.solved is not None, "solve() comes first"
        return self.solved.result

    def with_result(self, **changes: Any) -> Optimization:
        """Return the same with another result of the solver: other words, for example, for why it stopped."""
        assert self.solved is not None, "solve() comes first"
        other = Optimization(self.snapshot)
        other.solved = self.solved._replace(result=dataclasses.replace(self.result, **changes))
        return other

    def statistics(self) -> dict[str, Any]:
        """Return how the solve went, by the names of a report."""
        assert self.solved is not None, "solve() comes first"
        statistics = quality.statistics(self.snapshot.selection, self.result, self.solved.norms)
        return {name: statistics[name] for name in _TOLD}
