# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a window, and decide whether the solution is taken; once more without keyframes that alone are wrong.

The first solves of a map begin with a wider loss, if their start is bad. A loss whose pull fades with the residual
hardly sees a keyframe that begins far from where its tracks want it: a front-end that turned a degree too far puts all
its residuals at tens of sigmas, among the wrong ones. While a map is young there is little that holds against it. So
its first iterations take the loss with the scale of the residuals of the worst keyframe (graduated non-convexity, by
one step), and the solve goes on from there. Later, when the map is known, a wide loss would let clusters of outliers
pull, as of moving objects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ba_node.arrays import changed
from ba_node.config import Config, SolverOptions
from ba_node.core import methods, resection, solver
from ba_node.core.problem import Problem
from ba_node.core.result import Iteration, Result
from ba_node.estimate import Refinement
from ba_node.scene.scene import Scene
from ba_node.window import guard
from ba_node.window.merging import Merged, outcome
from ba_node.window.selection import Selection, select
from ba_node.window.trust import Trust

# Residuals of this rank tell how far off a keyframe begins: most may be wrong.
_RANK = 0.3
# How many scales of the loss that must be.
_FAR = 4.0
_ITERATIONS = 3
# A map of more keyframes is known well enough.
_YOUNG = 10
_FADING = ("cauchy", "geman_mcclure")


class Attempt(NamedTuple):
    """A solved window."""

    selection: Selection  # what was solved
    result: Result  # what came of it
    found: Merged  # the same in the scale of the map, see ``merging.outcome``; without a state where it is of no use
    health: dict[str, float]  # figures for the report
    held: str  # why it is not to be taken, empty if it is, or of no use anyway
    without: tuple[int, ...]  # rows of keyframes that were left out as they alone were wrong
    solve_time_s: float  # time in the solver, s


class Following(NamedTuple):
    """What follows a solve while it is made."""

    clock: Callable[[], float]  # s, for the report alone
    on_iteration: Callable[[Iteration], bool] | None = None  # ends the solve by returning False
    on_poses: Callable[[Refinement], None] = lambda _: None  # gets the poses of a solution as soon as it is taken


def attempt(scene: Scene, config: Config, end: int, trust: Trust, following: Following) -> Attempt | str:
    """Solve the newest window among the first ``end`` keyframes, or return why it cannot be solved yet.

    The scene is not changed, but for where keyframes begin that were not refined yet.
    """
    without: tuple[int, ...] = ()
    solve_time_s, (clock, on_iteration, _) = 0.0, following
    while True:
        selection = select(scene, config, end, without)
        if isinstance(selection, str):
            return selection
        options = methods.from_config(config.solver)
        problem = _arrived(scene, selection, options)
        began = clock()
        result = solver.solve(problem, options, clock=clock, on_iteration=on_iteration, weakest=True, in_haste=True)
        solve_time_s += clock() - began
        found = outcome(scene, selection, result, config.solver.kernels)
        if found.state is None:
            return Attempt(selection, result, found, {}, "", without, solve_time_s)
        verdict = guard.decide(config, selection, found, trust)
        if verdict.waits:
            return f"waits for parallax: {verdict.reason}"
        if without or not verdict.keyframes:
            held = trust.hear(verdict.reason, verdict.odd, without, config)
            return Attempt(selection, result, found, verdict.health, held, without, solve_time_s)
        without, trust.cause = verdict.keyframes, verdict.reason


def _arrived(scene: Scene, selection: Selection, options: SolverOptions) -> Problem:
    """Return the problem with a better start: its newest keyframe, where it alone is new, where known points want it.

    See ``core/resection.py``. What is selected, and what a solution is compared with, goes by where it came. Images of
    one camera alone do not hold the scale of the window, which needs the iterations that this saves.
    """
    problem, newest = selection.problem, selection.problem.n_keyframes - 1
    new = (~scene.keyframes.refined[selection.keyframes]).nonzero()[0].tolist()
    if problem.n_keyframes <= _YOUNG or new != [newest] or problem.fixed[newest] or not problem.has_scale:
        return _begun(selection, options)
    return changed(problem, start=resection.resected(problem, options, newest))


def _begun(selection: Selection, options: SolverOptions) -> Problem:
    """Return the problem with a better start, if its own is bad."""
    problem, scale = selection.problem, options.loss_scale_px
    if options.loss not in _FADING or problem.n_keyframes > _YOUNG:
        return problem
    norms = selection.norms.take(selection.used)
    far = norms > _FAR * scale
    keyframe = problem.observations.keyframe
    n = np.bincount(keyframe, minlength=problem.n_keyframes)
    suspect = ~problem.fixed & (np.bincount(keyframe[far], minlength=problem.n_keyframes) > (1.0 - _RANK) * n)
    if not suspect.any():
        return problem
    wide = max(float(np.quantile(norms[keyframe == k], _RANK, method="lower")) for k in np.flatnonzero(suspect))
    if not np.isfinite(wide):
        return problem
    first = solver.solve(problem, dataclasses.replace(options, loss_scale_px=wide, max_iterations=_ITERATIONS))
    if not first.status.usable or not first.state.is_finite():
        return problem
    return dataclasses.replace(problem, start=first.state)
