# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What a method is made of: one choice for each part, and numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ba_node.core.choices import PARTS, ChoiceError
from ba_node.core.kernels import Demands
from ba_node.core.objective import Rules


@dataclass(frozen=True)
class SolverOptions:
    """The parts of a method: choices as in choices.py, and numbers. See docs/methods.md for the named ones.

    Attributes:
        method: name for the report.
        rules: parameterisation, loss, cheirality.
        annealing: how a loss with a plateau is led up to.
        damping: D of the damping.
        damping_policy: how mu follows the gain ratio.
        initial_damping: first mu.
        gain_model: which reduction the gain ratio expects.
        trust_region: D of the region.
        initial_radius: first radius, in units of the scaled step.
        schur: which unknowns are eliminated.
        linear_solver: how S p = rhs is solved.
        preconditioner: M of pcg.
        polish_steps: Newton steps of every point alone after each step of the keyframes; 0 for none.
        backend: which kernels work.
        threads: of the C++ kernels; 0 for one a core. Results do not depend on it.
        t_eps: PCG stops at |r| <= min(t_eps, |b|) |b|.
        q_eps: PCG also stops where step i adds less than q_eps / i of what the model has gained; 0 for never.
        max_linear_iterations: cap on PCG steps in one outer iteration.
        max_iterations: cap on outer iterations, rejected ones included.
        function_tolerance: stop when an accepted step lowers the objective by less than this share.
        gradient_tolerance: stop when |g| falls below this (xi1).
        objective_tolerance: stop when the objective falls below this (xi2).
    """

    method: str = "auto"
    rules: Rules = field(default_factory=Rules)
    annealing: str = "none"
    damping: str = "diag"
    damping_policy: str = "fast"
    initial_damping: float = 1e-4
    gain_model: str = "undamped"
    trust_region: str = "none"
    initial_radius: float = 1e4
    schur: str = "points"
    linear_solver: str = "auto"
    preconditioner: str = "schur_block"
    polish_steps: int = 3
    backend: str = "auto"
    threads: int = 1
    t_eps: float = 0.1
    q_eps: float = 0.0
    max_linear_iterations: int = 500
    max_iterations: int = 50
    function_tolerance: float = 1e-6
    gradient_tolerance: float = 1e-9
    objective_tolerance: float = 0.0

    @property
    def demands(self) -> Demands:
        """Return what the method asks of the kernels; without a region the scaled space is that of the damping."""
        space = self.damping if self.trust_region == "none" else self.trust_region
        return Demands(self.schur, self.preconditioner, space, self.threads)

    def check(self) -> None:
        """Raise ChoiceError if a choice does not exist or contradicts another; say which, and what to do."""
        for owner in (self, self.rules):
            for name, value in vars(owner).items():
                if name in PARTS and value not in PARTS[name].names:
                    PARTS[name].resolve(value)
                    raise ChoiceError(f"option {name} = {value!r} is another name: write {PARTS[name].resolve(value)}")
        rules = self.rules
        if rules.loss != "squared" and not (math.isfinite(rules.loss_scale) and rules.loss_scale > 0.0):
            raise ChoiceError(
                f"loss = {rules.loss} with loss_scale = {rules.loss_scale}: a robust loss needs the residual, in"
                " sigmas, where it leaves the square; set loss_scale to a number > 0"
            )
        if self.trust_region != "none" and self.linear_solver not in ("auto", "pcg"):
            raise ChoiceError(
                f"trust_region = {self.trust_region} with linear_solver = {self.linear_solver}: only pcg"
                " stops at the boundary of a region; take linear_solver = pcg or trust_region = none"
            )
        if self.annealing == "gnc" and rules.loss != "truncated_quadratic":
            raise ChoiceError(
                f"annealing = gnc with loss = {rules.loss}: the surrogates are those of the truncated quadratic; take"
                " loss = truncated_quadratic or annealing = none"
            )
