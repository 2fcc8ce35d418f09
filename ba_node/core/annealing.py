# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Lead up to a loss with a plateau: Huber's loss first, then graduated non-convexity (GNC-TLS; surrogates in loss.py).

From a cold start most residuals lie on the plateau of a truncated quadratic, and high up that of Geman and McClure,
where they pull at next to nothing: the solve ends where it began. The convex loss of the same scale comes first, as
the surrogates can win only where good residuals are smaller than bad ones already. Then, for the truncated quadratic,
each step is taken on a surrogate of its own, from the nearly convex one whose graduation is
``mu = c^2 / (2 max|r|^2 - c^2)`` up to one that is the loss for all purposes; then the loss itself takes over from the
best state seen. What is reported meanwhile is the objective of that state under the loss itself: it never rises.
"""

from __future__ import annotations

import math

import numpy as np

from ba_node.config import SolverOptions
from ba_node.core.loss import HUBER
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem, State

# The surrogate of this graduation differs from the loss within 0.5 % of the scale only.
_LAST = 100.0
# Growth of mu a step, as 3 ends a little lower than 10, unless the levels would use up half of the iterations.
_GROWTH = 3.0
# A level whose steps are rejected this often is left.
_MAX_REJECTED = 3
# One of so many iterations is with Huber's loss.
_HUBER_SHARE = 5


class Annealing:
    """The levels of one solve, and the best state seen on them.

    Attributes:
        graduation: mu of the present surrogate, HUBER for Huber's loss, infinite when the loss itself has taken over.
        state: the best state so far.
        value: its objective under the loss itself.
    """

    def __init__(self, problem: Problem, options: SolverOptions) -> None:
        self._objective, self._options = Objective(problem, options), options
        self.state, self.value = problem.start, self._objective.value(problem.start)
        self._left = max(1, options.max_iterations // _HUBER_SHARE)
        self._growth = 1.0
        # With all residuals within the scale there is no plateau to lead off.
        self.graduation = HUBER if math.isfinite(self._first_graduation(problem.start)) else np.inf

    @property
    def active(self) -> bool:
        """Return True while something stands in for the loss."""
        return math.isfinite(self.graduation)

    def see(self, state: State) -> None:
        """Remember a state if it is the best so far."""
        value = self._objective.value(state)
        if value < self.value:
            self.state, self.value = state, value

    def advance(self, rejected: int, state: State) -> bool:
        """Go on to the next level, unless the step was rejected and may be tried again; return True if it did."""
        if 0 < rejected < _MAX_REJECTED:
            return False
        if self.graduation == HUBER:
            self._left -= 1
            if self._left > 0 and not rejected:
                return False
            surrogates = self._options.loss == "truncated_quadratic"
            self.graduation = self._first_graduation(state) if surrogates else np.inf
            levels = max(1, self._options.max_iterations // 2)
            self._growth = max(_GROWTH, (_LAST / self.graduation) ** (1.0 / levels)) if self.active else 1.0
            return True
        self.graduation *= self._growth
        if self.graduation > _LAST:
            self.graduation = np.inf
        return True

    def _first_graduation(self, state: State) -> float:
        """Return mu of the first surrogate at a state, infinite if all residuals are within the scale."""
        norms = np.linalg.norm(self._objective.errors(state), axis=1) / self._objective.problem.observations.sigma_px
        largest = float(np.max(norms[np.isfinite(norms)], initial=0.0))
        share = 2.0 * (largest / self._options.loss_scale_px) ** 2
        return 1.0 / (share - 1.0) if 1.0 < share < np.inf else np.inf
