# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Set options of a solver from text, by their bare names or by those of the parameters ``solver.*``."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from ba_node.config import (
    PLATEAUS,
    ConfigError,
    SolverOptions,
    Value,
    declared,
    parse_assignment,
    split_assignment,
)
from ba_node.core import methods
from ba_node.core.native_kernels import missing

_GROUP = "solver."
_OPTIONS = {option.name: option for option in declared(SolverOptions)}
_BY_ALIAS = {alias: option for option in _OPTIONS.values() for alias in option.aliases}


def option_names() -> tuple[str, ...]:
    """Return the bare names that can be set."""
    return tuple(name for name in _OPTIONS if name != "method")


def solver_options(method: str, assignments: Iterable[str]) -> SolverOptions:
    """Return the options of a named method with changes ``name=value``.

    A name is a field of SolverOptions, another name of it, or a parameter ``solver.*``.

    Raises:
        ConfigError: a method, name or value that does not exist or is out of range, choices that contradict each other,
            or kernels that are not there.
    """
    changes: dict[str, Any] = dict(_read(text) for text in assignments)
    method = str(changes.pop("method", method))
    if method not in methods.METHODS:
        raise ConfigError(f"method {method!r} does not exist{_nearest(method, methods.METHODS)}")
    options = methods.options(method)
    _require_scale(options, changes)
    if changes.get("loss") in PLATEAUS and options.loss not in PLATEAUS:
        changes.setdefault("annealing", "gnc")
    options = dataclasses.replace(options, **changes)
    options.check()
    reason = missing(options)
    if options.kernels == "native" and reason:
        raise ConfigError(f"option kernels = 'native': {reason}; take numpy or auto")
    return options


def _require_scale(options: SolverOptions, changes: Mapping[str, Value]) -> None:
    """Refuse a robust loss without a scale for a method that has none of its own."""
    loss = changes.get("loss", "squared")
    if loss != "squared" and options.loss == "squared" and "loss_scale_px" not in changes:
        raise ConfigError(
            f"option loss = {loss!r} without loss_scale_px (gamma): method {options.method} has none, as its loss is"
            " squared; add the residual, in sigmas, where the loss shall leave the square, for example gamma=1"
        )


def _read(text: str) -> tuple[str, Value]:
    name, value = split_assignment(text, "damping=diag")
    if name.startswith(_GROUP):
        name, parsed = parse_assignment(text)
        return name.removeprefix(_GROUP), parsed
    option = _OPTIONS.get(name) or _BY_ALIAS.get(name)
    if option is None:
        raise ConfigError(f"option {name!r} does not exist{_nearest(name, option_names())}")
    return option.name, option.read(value)


def _nearest(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    listed = f"hoose one of {', '.join(names)}"
    return f"; did you mean {near[0]!r}? C{listed}" if near else f": c{listed}"
