# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Search the steps of ``inc`` scaling (3.38): those whose forward differences agree best with the analytic Jacobian.

For each kind of parameter and each power of ten h the error is the mean over observations and columns of::

    |(F(u + h e) - F(u)) / h - J e|,   relative to the mean of |J e|

It falls with h while the curvature of F rules (~ h) and rises again when rounding does (~ eps |F| / h). The step at the
bottom therefore measures how strongly F bends along a parameter: the sensitivity that the scaling is to even out.
Where F is linear in a parameter, as it is in f, k1 and k2, there is no curvature and no bottom: the error falls as long
as h grows, every step up to any size fits, and the search determines nothing.

All keyframes move at once, and all points: an observation depends on one of each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.config import SolverOptions
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem

FloatArray = NDArray[np.float64]

POWERS = tuple(range(0, -15, -1))
KINDS = ("rotation", "translation", "f", "k1", "k2", "point")
# At the largest step a linear parameter has an error of rounding; any other one is off by several digits.
_LINEAR = 1e-9


@dataclass(frozen=True)
class StepErrors:
    """What the search found for one kind of parameter."""

    kind: str  # of KINDS
    errors: FloatArray  # (len(POWERS),) relative error of forward differences with each step

    @property
    def linear(self) -> bool:
        """Return True if the residual is linear in it, so that no step is the best."""
        return bool(self.errors[0] < _LINEAR)

    @property
    def step(self) -> float | None:
        """Return the best step, None if there is none."""
        return None if self.linear else float(10.0 ** POWERS[int(np.argmin(self.errors))])


def search_steps(problem: Problem, parameterisation: str) -> list[StepErrors]:
    """Return the errors for each kind of parameter of a problem at its start.

    Args:
        problem: with free intrinsics for f, k1, k2 to take part.
        parameterisation: local or global.
    """
    objective = Objective(problem, SolverOptions(parameterisation=parameterisation))
    with np.errstate(all="ignore"):
        columns = {"rotation": range(3), "translation": range(3, 6)}
        if problem.free_intrinsics:
            columns |= {"f": range(6, 7), "k1": range(7, 8), "k2": range(8, 9)}
        found = [_keyframe_errors(objective, kind, columns[kind]) for kind in KINDS[:-1] if kind in columns]
        return [*found, _point_errors(objective)]


def _keyframe_errors(objective: Objective, kind: str, columns: range) -> StepErrors:
    problem = objective.problem
    lin = objective.linearise(problem.start)
    still = np.zeros((problem.n_points, 3))
    errors = np.zeros((len(POWERS), len(columns)))
    for j, column in enumerate(columns):
        for i, power in enumerate(POWERS):
            step = np.zeros((problem.n_keyframes, lin.d_keyframe.shape[2]))
            step[:, column] = 10.0**power
            moved = objective.linearise(objective.retract(problem.start, step, still)).residual
            errors[i, j] = _error((moved - lin.residual) / 10.0**power, lin.d_keyframe[:, :, column])
    return StepErrors(kind, errors.mean(axis=1))


def _point_errors(objective: Objective) -> StepErrors:
    problem = objective.problem
    lin = objective.linearise(problem.start)
    still = np.zeros((problem.n_keyframes, lin.d_keyframe.shape[2]))
    errors = np.zeros((len(POWERS), 3))
    for j in range(3):
        for i, power in enumerate(POWERS):
            step = np.zeros((problem.n_points, 3))
            step[:, j] = 10.0**power
            moved = objective.linearise(objective.retract(problem.start, still, step)).residual
            errors[i, j] = _error((moved - lin.residual) / 10.0**power, lin.d_point[:, :, j])
    return StepErrors("point", errors.mean(axis=1))


def _error(numeric: FloatArray, analytic: FloatArray) -> float:
    scale = float(np.mean(np.abs(analytic)))
    return float(np.mean(np.abs(numeric - analytic))) / scale if scale > 0.0 else np.inf
