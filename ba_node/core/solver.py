# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""One loop for every method: damped, trust-region, inexact Newton steps on the reduced system (Algorithms 5, 8 to 11).

Each outer iteration linearises, damps (``H + mu D``), eliminates the points (or the keyframes, or nothing), solves
what is left by Cholesky or by PCG inside ``|D x| <= radius``, substitutes back, and accepts the step by the gain ratio

    rho = (F(u) - F(u + p)) / (-g'p - 1/2 |J p|^2)                   gain_model = undamped
    rho = (F(u) - F(u + p)) / (-g'p - 1/2 |J p|^2 - mu/2 p'D p)      gain_model = damped    (3.90, 3.102, 3.104)

in which F is the true robust objective and the denominator is the model at the step that was really taken, so that it
holds for inexact steps too. rho > 0: the step is taken. The two differ where damping is all that holds a step back, as
that of points far away: there p = -g / mu, the objective falls by |g|^2 / mu, and rho is 1 or 2. Nielsen's policy then
lets mu fall by its most, a third, with the damped model alone.
Radius (Algorithm 2): rho < 1/4: radius / 4; rho > 3/4 on the boundary: radius * 2.
Damping: ``nielsen`` (Algorithm 6): rho > 0: mu *= max(1/3, 1 - (2 rho - 1)^3), nu = 2, else mu *= nu, nu *= 2;
``fast``: the same, but mu / 5 where rho > 1/2 and mu / 2 where rho > 1/4: along a flat valley rho stays a little below
1/2, and Nielsen's mu where it is. Where the step was cut off by a region that bad steps have made a tenth of the first,
mu does not fall: along a curved valley it would go to nothing, and still no step be longer than the region.

With ``inner_iterations`` > 0 each step of the keyframes is followed by that many damped Newton steps of every point
alone, and from the 11th step on by twice as many: few points still move then, and those creep along flat valleys of
their own. A step that was bad only because the points had not followed it is saved by them.

A step that is not finite, or that could not be computed, counts as a rejected one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ba_node.config import ConfigError, SolverOptions
from ba_node.core import covariance, linear, native_kernels, point_priors
from ba_node.core.annealing import Annealing
from ba_node.core.kernels import Kernels
from ba_node.core.numpy_kernels import NumpyKernels
from ba_node.core.problem import Problem, State
from ba_node.core.reduced import ReducedSolver
from ba_node.core.result import Iteration, Result, Status

# The gain ratio of a step that only the inner iterations made good: taken, but not much trusted.
_SAVED_RHO = 0.3
# Steps after which points get twice as many inner iterations.
_EARLY = 10
# Policy fast leaves mu where a region of less than this share of the first cuts steps off.
_NARROW = 0.1
# A loop that has rejected this many steps in a row has nothing left to gain.
_MAX_REJECTED = 25
# Where policy fast stops to lower mu: below, mu diag(H) is lost in rounding, and Cholesky of S begins to break down.
_LEAST_DAMPING = 1e-14


def solve(
    problem: Problem,
    options: SolverOptions,
    *,
    clock: Callable[[], float] = lambda: 0.0,
    on_iteration: Callable[[Iteration], bool] | None = None,
    kernels: Kernels | None = None,
    weakest: bool = False,
    in_haste: bool = False,
) -> Result:
    """Minimise the robust objective of a problem.

    The clock (s) is for the trace alone; ``on_iteration`` gets each row of it, and stops the solve by returning False.
    ``kernels`` work in place of those that the options ask for: for experiments. ``weakest`` asks how far off the least
    determined of the free poses may be. ``in_haste``: the state is waited for, and what else there is to know of the
    end is worked out once somebody asks for it; a step that ends the solve has no gradient in the trace then, but NaN.

    Returns:
        The best state found, with a trace and the reason for stopping; finite always.

    Raises:
        ProblemError: the problem is not well formed.
        ConfigError: a choice does not exist or contradicts another.
    """
    options.check()
    problem.check()
    if problem.point_priors is not None:
        whole = point_priors.as_observations(problem)
        asked = {"weakest": weakest, "in_haste": in_haste}
        result = solve(whole, options, clock=clock, on_iteration=on_iteration, kernels=kernels, **asked)
        return replace(result, state=point_priors.without(result.state, problem))
    if problem.factors and options.schur == "cameras":
        raise ConfigError(
            f"schur = cameras with {problem.n_factors} factors, which couple keyframes with each other: take"
            " schur = points, none or adaptive"
        )
    if len(problem.observations) + problem.n_factors == 0 or (problem.n_points == 0 and problem.fixed.all()):
        return Result(problem.start, Status.SKIPPED, "no observations: nothing to solve", options.method, ())
    with np.errstate(all="ignore"):
        try:
            run = _Run(problem, options, clock, on_iteration, kernels)
            run.in_haste = in_haste
        except native_kernels.KernelsError as error:
            return Result(problem.start, Status.FAILED, str(error), options.method, ())
        result = run.run()
        if weakest and result.status.usable:
            result = replace(result, loosest=partial(_weakest, run, problem, result.state, options))
            # Kernels of several ranks work it out together, or not at all.
            return result if kernels is None else result.settled()
        return result


def _weakest(run: _Run, problem: Problem, state: State, options: SolverOptions) -> tuple[float, float]:
    with np.errstate(all="ignore"):
        run.finish()
        return covariance.weakest(run.kernels, problem, state, options)


class _Run:
    """The state of one solve between its iterations."""

    def __init__(
        self,
        problem: Problem,
        options: SolverOptions,
        clock: Callable[[], float],
        on_iteration: Callable[[Iteration], bool] | None,
        kernels: Kernels | None,
    ) -> None:
        self.options = options
        self.clock, self.began = clock, clock()
        self.on_iteration = on_iteration
        self.kernels = kernels or native_kernels.make(problem, options)
        self.reduced = ReducedSolver(options)
        self.state = problem.start
        self.value = np.inf
        self.mu, self.nu = options.initial_damping, 2.0
        self.radius = options.initial_radius if options.trust_region != "none" else np.inf
        self.rejected = 0
        self.side = ""
        self.stopped = False
        self.in_haste = False
        self.finished = True  # the kernels are linearised at the state
        self.trace: list[Iteration] = []
        self.annealing: Annealing | None = None
        if options.annealing == "gnc":
            self.annealing = Annealing(problem, options)
            self._graduate()

    def run(self) -> Result:
        self.value = self.kernels.linearise(self.state)
        if not (np.isfinite(self.value) and np.isfinite(self.kernels.gradient_norm)):
            return self._result(Status.FAILED, "the objective or its derivatives are not finite at the start")
        self._record(0, 0, True)
        for iteration in range(1, self.options.max_iterations + 1):
            reason = "" if self._annealed() else self._converged()
            if reason:
                return self._result(Status.CONVERGED, reason)
            if self.stopped:
                return self._result(Status.MAX_ITERATIONS, f"stopped by the caller after {iteration - 1} iterations")
            before = self.value
            accepted, solution = self._step()
            arrived = accepted and before - self.value <= self.options.function_tolerance * before
            self.finished = not (arrived and self.in_haste) or self._annealed()
            if accepted and self.finished:
                self.kernels.linearise(self.state)
            if self._annealed():
                self._anneal(accepted)
                self._record(iteration, solution.iterations, accepted)
                continue
            self._record(iteration, solution.iterations, accepted)
            if arrived:
                share = (before - self.value) / before if before > 0 else 0.0
                return self._result(Status.CONVERGED, f"the last step lowered the objective by {share:.1e} of it")
            if self.rejected >= _MAX_REJECTED:
                return self._result(Status.STALLED, f"{self.rejected} steps in a row did not lower the objective")
        return self._result(Status.MAX_ITERATIONS, f"stopped at the cap of {self.options.max_iterations} iterations")

    def finish(self) -> float:
        """Linearise at the end, unless that was done; return the norm of the gradient there."""
        if not self.finished:
            with np.errstate(all="ignore"):
                self.kernels.linearise(self.state)
            self.finished = True
        return self.kernels.gradient_norm

    def _annealed(self) -> bool:
        """Return True while a surrogate stands in for the loss."""
        return self.annealing is not None and self.annealing.active

    def _anneal(self, accepted: bool) -> None:
        """Go on to the next surrogate, or to the loss itself at the best state seen."""
        assert self.annealing is not None
        if accepted:
            self.annealing.see(self.state)
        if not self.annealing.advance(self.rejected, self.state):
            return
        self.rejected = 0
        self._graduate()
        if self.annealing.active:
            self.value = self.kernels.linearise(self.state)
        else:
            self.state, self.value = self.annealing.state, self.annealing.value
            self.kernels.linearise(self.state)

    def _graduate(self) -> None:
        """Let the kernels work with the present surrogate; those in C++ have no loss with a plateau."""
        assert self.annealing is not None and isinstance(self.kernels, NumpyKernels)
        self.kernels.graduate(self.annealing.graduation)

    def _converged(self) -> str:
        if self.kernels.gradient_norm <= self.options.gradient_tolerance:
            return f"the norm of the gradient is {self.kernels.gradient_norm:.1e}"
        if self.value <= self.options.objective_tolerance:
            return f"the objective is {self.value:.1e}"
        return ""

    def _step(self) -> tuple[bool, linear.Solution]:
        """Try one step; update state, damping and radius. Return whether it was taken."""
        system = self.kernels.damp(self.options.damping, self.mu)
        self.side = system.side
        solution = self.reduced.solve(system, self.kernels.diagonals, self.radius)
        if solution.x is None:
            return self._accept_step(-1.0, solution), solution
        inner = self.options.inner_iterations * (1 if len(self.trace) <= _EARLY else 2)
        stepped = self.kernels.step(self.state, system, solution.x, inner)
        rho = -1.0
        predicted = stepped.predicted - (stepped.damping if self.options.gain_model == "damped" else 0.0)
        if np.isfinite(stepped.before_inner) and predicted > 0:
            rho = (self.value - stepped.before_inner) / predicted
        if stepped.objective < min(stepped.before_inner, self.value):
            rho = max(rho, (self.value - stepped.objective) / predicted) if rho > 0 else _SAVED_RHO
        accepted = self._accept_step(rho, solution)
        if accepted:
            self.state, self.value = stepped.state, stepped.objective
        return accepted, solution

    def _accept_step(self, rho: float, solution: linear.Solution) -> bool:
        """Update damping and radius from the gain ratio; return whether the step is taken."""
        accepted = rho > 0.0
        if accepted:
            shrink = max(1.0 / 3.0, 1.0 - (2.0 * rho - 1.0) ** 3)
            if self.options.damping_policy == "fast" and rho > 0.25:
                cut_off = solution.on_boundary and self.radius < _NARROW * self.options.initial_radius
                shrink = 1.0 if cut_off else 0.2 if rho > 0.5 else 0.5
            self.mu, self.nu = max(self.mu * shrink, min(self.mu, _LEAST_DAMPING)), 2.0
        else:
            self.mu, self.nu = self.mu * self.nu, self.nu * 2.0
        if rho < 0.25:
            self.radius *= 0.25
        elif rho > 0.75 and solution.on_boundary:
            self.radius *= 2.0
        self.rejected = 0 if accepted else self.rejected + 1
        return accepted

    def _record(self, iteration: int, linear_iterations: int, accepted: bool) -> None:
        row = Iteration(
            iteration=iteration,
            time_s=self.clock() - self.began,
            objective=self.annealing.value if self.annealing is not None and self.annealing.active else self.value,
            gradient_norm=self.kernels.gradient_norm if self.finished else np.nan,
            linear_iterations=linear_iterations,
            accepted=accepted,
            damping=self.mu if self.options.damping != "none" else 0.0,
            radius=self.radius,
            side=self.side,
        )
        self.trace.append(row)
        if self.on_iteration is not None and not self.on_iteration(row):
            self.stopped = True

    def _result(self, status: Status, reason: str) -> Result:
        if self.annealing is not None and self.annealing.active:
            self.state = self.annealing.state
        found = Result(self.state, status, reason, self.options.method, tuple(self.trace), self.reduced.text)
        return found if self.finished else replace(found, at_end=self.finish)
