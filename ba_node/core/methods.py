# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say what each named method chooses for the one loop of ``solver.py``; their names stand in config/solver.py."""

from __future__ import annotations

import dataclasses
import functools

from ba_node.config import PLATEAUS, SolverConfig, SolverOptions

# What "auto" stands for.
DEFAULT = "local_irls"

# What the methods of the thesis have in common. They stop by |g| or the objective alone, so function_tolerance is 0.
_THESIS = SolverOptions(
    parameterisation="global",
    damping="none",
    damping_policy="nielsen",
    initial_damping=10.0,
    gain_model="damped",
    initial_radius=1.0,
    linear_solver="pcg",
    preconditioner="none",
    inner_iterations=0,
    max_linear_iterations=2000,
    function_tolerance=0.0,
)
_LMA_CD = dataclasses.replace(_THESIS, damping="identity", linear_solver="cholesky")
_BAL = dataclasses.replace(_THESIS, damping="diag", preconditioner="b_literal", initial_damping=1e-4)
# With 1 a point far away jumps through a camera's plane in the first step, and whether anything follows is rounding.
_INM = dataclasses.replace(_THESIS, trust_region="inc", initial_radius=0.01)
_TNM = dataclasses.replace(_THESIS, damping="inc")
_DINM = dataclasses.replace(_THESIS, damping="identity", trust_region="inc")
# S on the side of the points is too badly conditioned for PCG alone: its blocks differ as the points' distances do.
# There the region holds the points, and those far away move by many metres: it must not be what holds the others back.
_ADINM = dataclasses.replace(
    _DINM, schur="adaptive", preconditioner="schur_block", max_linear_iterations=3000, initial_radius=1e4
)
_LOCAL = dataclasses.replace(_DINM, parameterisation="local")
# Where damping alone holds points back, the gradient falls with mu: a tenth of it is two steps gained.
_LOCAL_DINM = dataclasses.replace(_LOCAL, initial_damping=1.0)
_HUBER = dataclasses.replace(_LOCAL, loss="huber")
# Without M most of its few iterations at each level are spent on what PCG has not reached.
_TQ = dataclasses.replace(_LOCAL, loss="truncated_quadratic", annealing="gnc", preconditioner="schur_block")

# Local DINM/IRLS as a window wants it: D of the damping is Marquardt's, which has no unit, so that nothing needs to be
# known of the scene, and so is D of the region, which binds where damping has fallen low; what costs less is solved
# exactly, the limit t_eps -> 0; points follow each step.
_LOCAL_IRLS = SolverOptions(trust_region="diag", q_eps=0.1)

_CHOICES = {
    "lma_cd": _LMA_CD,
    "bal": _BAL,
    "bal_scaled": dataclasses.replace(_BAL, preconditioner="b_block"),
    "inm": _INM,
    "tnm": _TNM,
    "dinm": _DINM,
    "adinm": _ADINM,
    "local_dinm": _LOCAL_DINM,
    "irls_huber": _HUBER,
    "irls_tq": _TQ,
    DEFAULT: _LOCAL_IRLS,
}
METHODS: dict[str, SolverOptions] = {
    name: dataclasses.replace(options, method=name) for name, options in _CHOICES.items()
}
METHODS = {"auto": METHODS[DEFAULT], **METHODS}
# Where a window's solve may stop, unless the parameters say; that of other methods than the default later, as their
# damping falls from large values, and a first step that gains little says nothing.
_QUICK, _PATIENT = 1e-3, 1e-5


def options(name: str) -> SolverOptions:
    """Return the choices of a named method.

    Raises:
        ValueError: there is no such method.
    """
    if name not in METHODS:
        raise ValueError(f"method {name!r} does not exist: choose one of {', '.join(METHODS)}")
    return METHODS[name]


@functools.lru_cache(maxsize=16)
def from_config(config: SolverConfig) -> SolverOptions:
    """Return what the parameters ``solver.*`` ask for, and what their method chooses where they leave it open."""
    method = options(config.method)
    changes = dataclasses.asdict(config) | {"method": method.method}
    if config.linear_solver == "auto" or method.linear_solver == "pcg":
        changes["linear_solver"] = method.linear_solver
    if config.loss == "auto":
        changes["loss"] = method.loss if method.loss != "squared" else "cauchy"
    if config.function_tolerance < 0.0:
        changes["function_tolerance"] = _QUICK if method.method == DEFAULT else _PATIENT
    return dataclasses.replace(method, **changes, annealing="gnc" if changes["loss"] in PLATEAUS else "none")
