# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the methods: each is a set of choices for the one loop of ``solver.py``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ba_node.config import SolverConfig
from ba_node.core.objective import Rules
from ba_node.core.options import SolverOptions


@dataclass(frozen=True)
class Method:
    """A named method.

    Attributes:
        doc: what it is.
        source: algorithm or section of the thesis; empty if it is not from there.
        options: its choices.
    """

    doc: str
    source: str
    options: SolverOptions


# What the methods of the thesis have in common. They stop by |g| or the objective alone, so function_tolerance is 0.
_THESIS = SolverOptions(
    rules=Rules(parameterisation="global"),
    damping="none",
    damping_policy="nielsen",
    initial_damping=10.0,
    gain_model="damped",
    initial_radius=1.0,
    linear_solver="pcg",
    preconditioner="none",
    polish_steps=0,
    max_linear_iterations=2000,
    function_tolerance=0.0,
)
_LMA_CD = dataclasses.replace(_THESIS, damping="identity", linear_solver="cholesky")
_BAL = dataclasses.replace(_THESIS, damping="diag", preconditioner="b_block", initial_damping=1e-4)
_INM = dataclasses.replace(_THESIS, trust_region="inc")
_TNM = dataclasses.replace(_THESIS, damping="inc")
_DINM = dataclasses.replace(_THESIS, damping="identity", trust_region="inc")
# S on the side of the points is too badly conditioned for PCG alone: its blocks differ as the points' distances do.
# There the region holds the points, and those far away move by many metres: it must not be what holds the others back.
_ADINM = dataclasses.replace(
    _DINM, schur="adaptive", preconditioner="schur_block", max_linear_iterations=3000, initial_radius=1e4
)
_LOCAL = dataclasses.replace(_DINM, rules=Rules(parameterisation="local"))
# Where damping alone holds points back, the gradient falls with mu: a tenth of it is two steps gained.
_LOCAL_DINM = dataclasses.replace(_LOCAL, initial_damping=1.0)
_HUBER = dataclasses.replace(_LOCAL, rules=Rules(loss="huber"))
_TQ = dataclasses.replace(_LOCAL, rules=Rules(loss="truncated_quadratic"), annealing="gnc")

_DECLARED: dict[str, Method] = {
    "auto": Method(
        "the node's default: Marquardt steps by the cheapest linear solver, and points that follow each",
        "",
        SolverOptions(q_eps=0.1),
    ),
    "lma_cd": Method("Levenberg-Marquardt with Cholesky decomposition, a baseline", "3.2.2, 3.2.3", _LMA_CD),
    "bal": Method("Levenberg-Marquardt with PCG and M = B, a baseline (Agarwal et al. 2010)", "3.2.3", _BAL),
    "inm": Method("inexact Newton: a scaled region, no damping", "Alg. 5", _INM),
    "tnm": Method("truncated Newton: damping, no region", "Alg. 7, 8", _TNM),
    "dinm": Method("damped inexact Newton: damping and a scaled region", "Alg. 9", _DINM),
    "adinm": Method("dinm that eliminates points or cameras, whichever is better conditioned", "Alg. 10", _ADINM),
    "local_dinm": Method("dinm with local parameterisation", "4.2", _LOCAL_DINM),
    "irls_huber": Method("local_dinm with Huber's loss", "Alg. 11, 4.21", _HUBER),
    "irls_tq": Method(
        "local_dinm with a truncated quadratic, led up to by graduated non-convexity", "Alg. 11, 4.22", _TQ
    ),
}
CATALOGUE: dict[str, Method] = {
    name: dataclasses.replace(method, options=dataclasses.replace(method.options, method=name))
    for name, method in _DECLARED.items()
}
METHODS: dict[str, SolverOptions] = {name: method.options for name, method in CATALOGUE.items()}


def options(name: str) -> SolverOptions:
    """Return the choices of a named method.

    Raises:
        ValueError: there is no such method.
    """
    if name not in METHODS:
        raise ValueError(f"method {name!r} does not exist: choose one of {', '.join(METHODS)}")
    return METHODS[name]


def from_config(config: SolverConfig) -> SolverOptions:
    """Return the choices that the parameters ``solver.*`` ask for."""
    chosen = options(config.method)
    linear_solver = chosen.linear_solver
    if config.linear_solver != "auto" and chosen.trust_region == "none":
        linear_solver = config.linear_solver
    loss = config.loss
    if loss == "auto":
        loss = chosen.rules.loss if chosen.rules.loss != "squared" else "cauchy"
    keeps_loss = loss == chosen.rules.loss
    rules = Rules(
        parameterisation=chosen.rules.parameterisation,
        loss=loss,
        loss_scale=config.loss_scale_px,
        cheirality=config.cheirality,
    )
    return dataclasses.replace(
        chosen,
        rules=rules,
        annealing=chosen.annealing if keeps_loss else "none",
        backend=config.backend,
        linear_solver=linear_solver,
        threads=config.threads,
        max_iterations=config.max_iterations,
        max_linear_iterations=config.max_linear_iterations,
        function_tolerance=config.function_tolerance,
        gradient_tolerance=config.gradient_tolerance,
    )
