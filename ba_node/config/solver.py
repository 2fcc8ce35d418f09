# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare the options of a solve: choices and numbers that make up a method, see docs/methods.md.

Those of :class:`SolverConfig` are parameters of the node too, where some have another default.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

from ba_node.config.declaration import Choice, ConfigError, Tune, declared, option

_INC = "D = 1/step, the steps of the search for the best forward differences"

# Named methods. What each chooses stands in core/methods.py.
METHODS = (
    Choice("auto", "the default: local_irls"),
    Choice("lma_cd", "Levenberg-Marquardt with Cholesky decomposition, a baseline", "Sections 3.2.2, 3.2.3"),
    Choice("bal", "Levenberg-Marquardt with PCG and M = B to the letter, a baseline (Agarwal et al. 2010)", "Alg. 7"),
    Choice("bal_scaled", "bal with PCG in units of the root of diag(H), and M of the matrix on which it works"),
    Choice("inm", "inexact Newton: a scaled region, no damping", "Alg. 5"),
    Choice("tnm", "truncated Newton: damping, no region", "Alg. 7, 8"),
    Choice("dinm", "damped inexact Newton: damping and a scaled region", "Alg. 9"),
    Choice("adinm", "dinm that eliminates points or cameras, whichever is better conditioned", "Alg. 10"),
    Choice("local_dinm", "dinm with local parameterisation", "Section 4.2"),
    Choice("irls_huber", "local_dinm with Huber's loss", "Alg. 11, 4.21"),
    Choice("irls_tq", "local_dinm with a truncated quadratic, led up to by graduated non-convexity", "Alg. 11, 4.22"),
    Choice(
        "local_irls",
        "local DINM/IRLS with Marquardt's damping, inner iterations, and exact steps where they cost less",
        "Section 4.2, Alg. 11",
    ),
)
# The losses of the methods that are named after theirs.
METHOD_LOSSES = {"irls_huber": "huber", "irls_tq": "truncated_quadratic"}
# The functions are those of core/loss.py.
LOSSES = (
    Choice("squared", "Psi = x^2, w = 1", "2.26"),
    Choice("huber", "Psi = x^2 up to c, then 2 c x - c^2; w = min(1, c/x)", "4.21"),
    Choice("truncated_quadratic", "Psi = min(x^2, c^2); w = 1 up to c, then 0", "4.22", ("tq",)),
    Choice("cauchy", "Psi = c^2 log(1 + x^2/c^2); w = 1/(1 + x^2/c^2)"),
    Choice("geman_mcclure", "Psi = x^2/(1 + x^2/c^2); w = 1/(1 + x^2/c^2)^2"),
)
# Losses that pull at next to nothing far out, and have to be led up to (core/annealing.py).
PLATEAUS = ("truncated_quadratic", "geman_mcclure")


@dataclass(frozen=True)
class SolverConfig:
    """How a window is solved: the options that are parameters of the node."""

    method: str = option("auto", "Named method. See docs/methods.md.", choices=METHODS)
    linear_solver: str = option(
        "auto",
        "How the reduced system S p = rhs is solved; an exact step that leaves the trust region is cut off there.",
        choices=(
            Choice(
                "auto", "the method's own, that of local_irls being what costs least by the structure of the problem"
            ),
            Choice("cholesky", "exactly: dense or sparse, whichever costs less", "Section 3.2.2", ("cd",)),
            Choice("dense", "exactly: S as a whole, LAPACK's Cholesky"),
            Choice("sparse", "exactly: S by blocks, sparse Cholesky"),
            Choice("pcg", "by conjugate gradients (Steihaug): an inexact Newton step", "Alg. 1, 3, 4"),
        ),
    )
    kernels: str = option(
        "auto",
        "Which kernels work: native (C++), numpy, or auto, which takes native where it is built and can do the method.",
        choices=(
            Choice("auto", "native where it has everything that is asked for, else numpy"),
            Choice("native", "C++: local parameterisation, squared, Huber or Cauchy, points eliminated"),
            Choice("numpy", "numpy and scipy: everything"),
        ),
        aliases=("backend",),
    )
    threads: int = option(
        1,
        "Threads of the C++ kernels, 0 for one a core. Results are the same, bit for bit, for any number;"
        " one leaves the other cores to the front-end.",
        within=(0, 256),
    )
    loss: str = option(
        "squared",
        "Robust loss: cost Psi of a residual of norm x and its IRLS weight w, with the scale c = loss_scale_px.",
        choices=LOSSES,
        node={
            "default": "auto",
            "doc": "Robust loss on each residual; auto: that of an irls_* method, Cauchy's for all others.",
            "allowed": (*LOSSES, Choice("auto")),
        },
    )
    loss_scale_px: float = option(
        1.0,
        "Residual, in units of sigma, where the robust loss leaves the square.",
        within=(1e-6, 1e6),
        aliases=("loss_scale", "gamma"),
        node={"default": 2.0},
        tune=Tune(0.5, 10.0),
    )
    max_iterations: int = option(
        50,
        "Cap on outer iterations of a solve, rejected ones included.",
        within=(1, 100_000),
        node={"default": 12},
        tune=Tune(2, 50, ("accuracy", "latency")),
    )
    max_linear_iterations: int = option(
        500, "Cap on PCG steps in one outer iteration.", within=(1, 1_000_000), aliases=("cap",)
    )
    function_tolerance: float = option(
        1e-6,
        "Stop when an accepted step lowers the objective by less than this share.",
        within=(0.0, 1.0),
        node={
            "default": -1.0,
            "minimum": -1.0,
            "doc": "Stop when an accepted step lowers the objective by less than this share; -1: 1e-3 of local_irls"
            " (auto), 1e-5 of all others, whose first steps are small.",
        },
    )
    gradient_tolerance: float = option(1e-9, "Stop when the norm of the gradient falls below this.", within=(0.0, 1e12))
    cheirality: str = option(
        "keep",
        "Points on or behind the camera plane: keep their plain residual, give them a constant cost, or drop them.",
        choices=(
            Choice("keep", "its plain residual, as the published results on BAL data count"),
            Choice("constant", "as much as a residual of 100, and it pulls at nothing"),
            Choice("drop", "nothing, if it is behind at the start"),
        ),
        node={"default": "constant"},
    )


@dataclass(frozen=True)
class SolverOptions(SolverConfig):
    """All options of a solve: what the core works with."""

    parameterisation: str = option(
        "local",
        "How a pose is stepped.",
        choices=(
            Choice("local", "R <- R Exp(dphi), t <- t + R dt", "4.1-4.19"),
            Choice("global", "phi <- phi + dphi, t <- t + dt, on the rotation vector", "3.26-3.28"),
        ),
    )
    loss_per: str = option(
        "observation",
        "Of what the loss is taken.",
        choices=(
            Choice("observation", "of the norm of an observation's residual: both rows share its weight"),
            Choice("component", "of u and of v by itself, each with a weight of its own", "4.20"),
        ),
    )
    annealing: str = option(
        "none",
        "How a loss with a plateau is led up to.",
        choices=(
            Choice("none", "the loss itself from the start"),
            Choice(
                "gnc", "Huber's loss first, then, for the truncated quadratic, graduated non-convexity, a step each"
            ),
        ),
    )
    damping: str = option(
        "diag",
        "D in H + mu D.",
        choices=(
            Choice("none", "H as it is", "3.56, 3.57"),
            Choice("identity", "D = I", "3.55, 3.58", ("I",)),
            Choice("diag", "D = diag(H), each entry at least 1e-6 (Marquardt)", "3.55, 3.58"),
            Choice("inc", _INC, "3.38"),
        ),
    )
    damping_policy: str = option(
        "fast",
        "How mu follows the gain ratio rho.",
        choices=(
            Choice("nielsen", "rho > 0: mu max(1/3, 1 - (2 rho - 1)^3); else mu nu, nu = 2, 4, 8, ...", "Alg. 6"),
            Choice(
                "fast",
                "as nielsen, but mu/5 where rho > 1/2, mu/2 where rho > 1/4, and as it is where a region that bad steps"
                " have made narrow cut the step off",
            ),
        ),
    )
    initial_damping: float = option(1e-4, "First mu.", within=(0.0, 1e100))
    gain_model: str = option(
        "undamped",
        "The reduction that the gain ratio rho expects of a step p.",
        choices=(
            Choice("undamped", "-g'p - 1/2 p'H p, as Nielsen writes the policy"),
            Choice("damped", "-g'p - 1/2 p'(H + mu D)p, that of the equations which p solves", "3.102, 3.104, 3.105"),
        ),
    )
    trust_region: str = option(
        "none",
        "D of the region (no further than the radius in D p), and of the scaled space in which PCG works.",
        choices=(
            Choice("none", "no region; PCG works in the space scaled by D of the damping", "Alg. 7"),
            Choice("identity", "D = I", "3.91", ("I",)),
            Choice("diag", "D = sqrt(diag(H)), so that D p has no unit", "3.94-3.99"),
            Choice("inc", _INC, "3.38, 3.94-3.99"),
        ),
        aliases=("scaling",),
    )
    initial_radius: float = option(
        1e4, "First radius of the region, in units of the scaled step.", within=(1e-100, 1e100)
    )
    schur: str = option(
        "points",
        "Which unknowns are eliminated before the linear solver.",
        choices=(
            Choice("points", "S = B - E C^-1 E'", "3.64-3.67", ("C",)),
            Choice("cameras", "S = C - E' B^-1 E", "3.70-3.73", ("B",)),
            Choice("none", "nothing: H as a whole", "3.61", ("H",)),
            Choice("adaptive", "points where cond(C) < cond(B), else cameras with radius 3m/9n", "Alg. 10"),
            Choice(
                "adaptive_scaled", "the same, with the conditions that the blocks have in the scaled space", "Alg. 10"
            ),
        ),
    )
    preconditioner: str = option(
        "auto",
        "M of PCG, made in the scaled space.",
        choices=(
            Choice("auto", "two_level where S has more than 3000 unknowns and is formed cheaply, else schur_block"),
            Choice("none", "M = I", "Table 3.9", ("I",)),
            Choice("schur_block", "diagonal blocks of S", "Table 3.9"),
            Choice("b_block", "blocks of B (of C where cameras are eliminated), damped", "Table 3.9", ("b",)),
            Choice("schur_diag", "diagonal of S", "Table 3.9"),
            Choice("b_diag", "diagonal of B (of C where cameras are eliminated), damped", "Table 3.9"),
            Choice(
                "two_level",
                "S exactly inside clusters of keyframes that see the same points, and a coarse system of one similarity"
                " (and common intrinsics) for each; S is formed, schur = points",
            ),
            Choice(
                "b_literal", "B as it stands, while PCG works on D^-1 S D^-1 with D = diag(H), not its root", "Alg. 7"
            ),
        ),
    )
    inner_iterations: int = option(
        3,
        "Newton steps of every point alone after a step of the keyframes, twice as many from the 11th on; 0 for none.",
        within=(0, 1000),
        aliases=("polish_steps",),
    )
    t_eps: float = option(
        0.1, "PCG stops at |r| <= min(t_eps, |b|) |b|; on two levels |r| is sqrt(r'M^-1 r).", within=(0.0, 1e100)
    )
    q_eps: float = option(
        0.0,
        "PCG also stops where step i adds less than q_eps / i of what the model has gained; 0 for never.",
        within=(0.0, 1e100),
    )
    objective_tolerance: float = option(0.0, "Stop when the objective falls below this.", within=(0.0, 1e300))

    @property
    def scaled_space(self) -> str:
        """Return which D scales the space of PCG: that of the region, without one that of the damping."""
        return self.damping if self.trust_region == "none" else self.trust_region

    @functools.lru_cache(maxsize=16)  # noqa: B019  few are kept, and they are small
    def check(self) -> None:
        """Raise ConfigError if a choice does not exist or contradicts another; say which, and what to do."""
        for chosen, names in _CHOSEN:
            if getattr(self, chosen.name) not in names:
                chosen.check(getattr(self, chosen.name))
        if self.loss != "squared" and not (math.isfinite(self.loss_scale_px) and self.loss_scale_px > 0.0):
            raise ConfigError(
                f"loss = {self.loss} with loss_scale_px = {self.loss_scale_px}: a robust loss needs the residual, in"
                " sigmas, where it leaves the square; set loss_scale_px to a number > 0"
            )
        if self.preconditioner == "two_level" and self.schur != "points":
            raise ConfigError(
                f"preconditioner = two_level with schur = {self.schur}: clusters are of keyframes; take schur = points"
            )
        if self.annealing == "gnc" and self.loss not in PLATEAUS:
            raise ConfigError(
                f"annealing = gnc with loss = {self.loss}: it leads up to a loss with a plateau; take"
                f" loss = {' or '.join(PLATEAUS)}, or annealing = none"
            )


_CHOSEN = tuple((option, option.choices) for option in declared(SolverOptions) if option.allowed)
