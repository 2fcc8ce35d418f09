# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine the cameras of a whole map beside its poses and points, see ``core/calibration.py``."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray
from ba_node.config import CalibrationConfig, SolverOptions
from ba_node.core import calibration, solver
from ba_node.core.calibration import Calibration
from ba_node.core.problem import Problem, State
from ba_node.window.selection import Selection


def calibrated(
    selection: Selection,
    held: BoolArray,
    stamp_ns: NDArray[np.int64],
    options: SolverOptions,
    config: CalibrationConfig,
) -> tuple[Selection, Calibration]:
    """Return a selection whose problem begins at the solution for refined cameras, and these.

    ``held`` (n_kf,) are the keyframes that are fixed where the front-end's steps hold the scale; ``stamp_ns`` (n_kf,).
    """
    given = selection.problem
    if given.n_factors:
        given = dataclasses.replace(given, fixed=held)

    def solve(problem: Problem, chosen: SolverOptions) -> State:
        result = solver.solve(problem, chosen)
        return result.state if result.status.usable and result.state.is_finite() else problem.start

    stamp_s = (stamp_ns - stamp_ns[0]) * 1e-9
    problem, state, found = calibration.calibrate(given, stamp_s, options, config, solve)
    # The observations that sit the solve out are to be classified by the same cameras.
    everything = dataclasses.replace(given, observations=selection.observations)
    whole = calibration.with_calibration(everything, state, found, stamp_s)
    moved = dataclasses.replace(
        selection, problem=dataclasses.replace(problem, start=state), observations=whole.observations
    )
    return moved, found
