# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a window, and decide whether the solution is taken; once more without keyframes that alone are wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from ba_node.config import Config
from ba_node.core import methods, solver
from ba_node.core.result import Iteration, Result
from ba_node.scene.scene import Scene
from ba_node.window import guard
from ba_node.window.graduation import begun
from ba_node.window.merging import Merged, outcome
from ba_node.window.selection import Selection, select
from ba_node.window.trust import Trust


class Attempt(NamedTuple):
    """A solved window.

    Attributes:
        selection: what was solved.
        result: what came of it.
        found: the same in the scale of the map, without a state where it is of no use.
        health: figures for the report.
        held: why it is not to be taken, empty if it is, or of no use anyway.
        without: rows of keyframes that were left out as they alone were wrong.
        solve_time_s: time in the solver, s.
    """

    selection: Selection
    result: Result
    found: Merged
    health: guard.Health
    held: str
    without: tuple[int, ...]
    solve_time_s: float


def attempt(
    scene: Scene,
    config: Config,
    end: int,
    trust: Trust,
    *,
    clock: Callable[[], float],
    on_iteration: Callable[[Iteration], bool] | None,
) -> Attempt | str:
    """Solve the newest window among the first ``end`` keyframes, or return why there is none.

    The scene is not changed, but for where keyframes begin that were not refined yet.
    """
    without: tuple[int, ...] = ()
    solve_time_s = 0.0
    while True:
        selection = select(scene, config, end, without)
        if isinstance(selection, str):
            return selection
        options = methods.from_config(config.solver)
        problem = begun(selection.problem, selection.norms[selection.inlier], options)
        began = clock()
        result = solver.solve(problem, options, clock=clock, on_iteration=on_iteration)
        solve_time_s += clock() - began
        found = outcome(scene, selection, result, config.tracks, config.solver.kernels)
        if found.state is None:
            return Attempt(selection, result, found, guard.Health(), "", without, solve_time_s)
        verdict = guard.decide(config, selection, found, trust)
        if without or not verdict.keyframes:
            held = trust.hear(verdict.reason, verdict.odd, without, config)
            return Attempt(selection, result, found, verdict.health, held, without, solve_time_s)
        without, trust.cause = verdict.keyframes, verdict.reason
