# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Set options of a solver from text, by their bare names or by those of the parameters ``solver.*``."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any

from ba_node.config import ConfigError, Value, parse_assignment
from ba_node.core import methods
from ba_node.core.choices import PARTS, ChoiceError
from ba_node.core.native_kernels import missing
from ba_node.core.objective import Rules
from ba_node.core.options import SolverOptions

# Numbers that may be zero; the others must be above it.
_MAY_BE_ZERO = (
    "t_eps",
    "q_eps",
    "function_tolerance",
    "gradient_tolerance",
    "objective_tolerance",
    "initial_damping",
    "polish_steps",
)
_GROUP = "solver."
# Where the parameter of the node has another name than the option.
_RENAMED = {"loss_scale_px": "loss_scale"}
# Other names: those of choices.py, and those of the thesis for numbers.
_ALIASES = {alias: part.option for part in PARTS.values() for alias in part.aliases} | {
    "gamma": "loss_scale",
    "cap": "max_linear_iterations",
}
_RULES = tuple(item.name for item in dataclasses.fields(Rules))
_OPTIONS = tuple(item.name for item in dataclasses.fields(SolverOptions) if item.name not in ("method", "rules"))


def option_names() -> tuple[str, ...]:
    """Return the bare names that can be set."""
    return _RULES + _OPTIONS


def solver_options(method: str, assignments: Iterable[str]) -> SolverOptions:
    """Return the options of a named method with changes.

    Args:
        method: name of the method.
        assignments: ``name=value``, the name being a field of SolverOptions or Rules or a parameter ``solver.*``;
            the latter must also be in the range of the parameter.

    Raises:
        ConfigError: a method, name or value that does not exist or is out of range, choices that contradict each other,
            or kernels that are not there.
    """
    changes: dict[str, Value] = {}
    for text in assignments:
        name, value = _read(text)
        changes[name] = value
    method = str(changes.pop("method", method))
    if method not in methods.METHODS:
        raise ConfigError(f"method {method!r} does not exist{_nearest(method, methods.METHODS)}")
    options = methods.options(method)
    _require_scale(options, changes)
    rules = dataclasses.replace(options.rules, **_taken(changes, _RULES))
    options = dataclasses.replace(options, rules=rules, **_taken(changes, _OPTIONS))
    try:
        options.check()
    except ChoiceError as error:
        raise ConfigError(str(error)) from None
    reason = missing(rules, options.demands)
    if options.backend == "native" and reason:
        raise ConfigError(f"option backend = 'native': {reason}; take numpy or auto")
    return options


def describe(options: SolverOptions) -> dict[str, Value]:
    """Return all options by their bare names."""
    named = dataclasses.asdict(options)
    rules: dict[str, Value] = named.pop("rules")
    return {**named, **rules}


def _require_scale(options: SolverOptions, changes: Mapping[str, Value]) -> None:
    """Refuse a robust loss without a scale for a method that has none of its own."""
    loss = changes.get("loss", "squared")
    if loss != "squared" and options.rules.loss == "squared" and "loss_scale" not in changes:
        raise ConfigError(
            f"option loss = {loss!r} without loss_scale (gamma): method {options.method} has none, as its loss is"
            " squared; add the residual, in sigmas, where the loss shall leave the square, for example gamma=1"
        )


def _taken(changes: dict[str, Value], names: Iterable[str]) -> dict[str, Any]:
    """Remove some of the changes and return them."""
    return {name: changes.pop(name) for name in names if name in changes}


def _read(text: str) -> tuple[str, Value]:
    name, separator, raw = text.partition("=")
    if not separator:
        raise ConfigError(f"{text!r}: expected name=value, for example damping=diag")
    if name.startswith(_GROUP):
        name, value = parse_assignment(text)
        bare = name.removeprefix(_GROUP)
        return _RENAMED.get(bare, bare), value
    name = _ALIASES.get(name, name)
    if name in PARTS:
        try:
            return name, PARTS[name].resolve(raw)
        except ChoiceError as error:
            raise ConfigError(str(error)) from None
    if name not in option_names():
        raise ConfigError(f"option {name!r} does not exist{_nearest(name, option_names())}")
    return name, _number(name, raw)


def _number(name: str, raw: str) -> int | float:
    default = describe(SolverOptions())[name]
    kind = int if isinstance(default, int) else float
    low = 0 if name in _MAY_BE_ZERO else 1 if kind is int else 5e-324
    try:
        value = kind(raw)
    except ValueError:
        raise ConfigError(f"option {name} = {raw!r}: expected {kind.__name__}") from None
    if not math.isfinite(value) or value < low:
        raise ConfigError(f"option {name} = {raw}: expected a finite number {'>= 0' if low == 0 else '> 0'}")
    return value


def _nearest(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    listed = f"hoose one of {', '.join(names)}"
    return f"; did you mean {near[0]!r}? C{listed}" if near else f": c{listed}"
