# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the methods: each is a set of choices for the one loop of ``solver.py``."""

from __future__ import annotations

import dataclasses

from ba_node.config import SolverConfig
from ba_node.core.objective import Rules
from ba_node.core.solver import SolverOptions

_LOCAL_DINM = SolverOptions(
    method="local_dinm",
    damping="identity",
    damping_policy="nielsen",
    initial_damping=1e3,
    trust_region="inc",
    initial_radius=100.0,
    linear_solver="pcg",
    preconditioner="none",
    polish_steps=0,
    t_eps=0.1,
    max_linear_iterations=2000,
    function_tolerance=0.0,
)

METHODS: dict[str, SolverOptions] = {
    "auto": SolverOptions(),
    "local_dinm": _LOCAL_DINM,
    "irls_huber": dataclasses.replace(_LOCAL_DINM, method="irls_huber", rules=Rules(loss="huber")),
}


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
    rules = Rules(
        parameterisation=chosen.rules.parameterisation,
        loss=config.loss,
        loss_scale=config.loss_scale_px,
        cheirality=config.cheirality,
    )
    return dataclasses.replace(
        chosen,
        rules=rules,
        backend=config.backend,
        max_iterations=config.max_iterations,
        max_linear_iterations=config.max_linear_iterations,
        function_tolerance=config.function_tolerance,
        gradient_tolerance=config.gradient_tolerance,
    )
