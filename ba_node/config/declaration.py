# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare an option: a field of a dataclass with its default, unit, range, choices and meaning.

Everything else (YAML, descriptors of the node, docs, help, ``--set``) is a loop over :func:`declared`.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any, get_type_hints

from ba_node.kept import kept_property

Value = bool | int | float | str


class ConfigError(ValueError):
    """An option that is unknown, of the wrong type, out of range, or in conflict with another."""


@dataclass(frozen=True)
class Choice:
    """One value of an option that is chosen by name."""

    name: str  # how it is asked for
    doc: str = ""  # what it is
    source: str = ""  # equation, algorithm or table of the thesis; empty if it is not from there
    aliases: tuple[str, ...] = ()  # other names for it


@dataclass(frozen=True)
class Tune:
    """The range in which an option is worth tuning, and for what."""

    low: float
    high: float
    presets: tuple[str, ...] = ("accuracy",)  # sets of parameters that it belongs to: accuracy, latency
    log: bool = True  # by its logarithm: half and twice as much are as far away


@dataclass(frozen=True)
class Parameter:
    """One declared option."""

    # for example ``max_iterations``; that of a parameter of the node has its group in front, ``solver.max_iterations``
    name: str
    kind: type  # bool, int, float or str
    default: Value  # value when nothing is set
    doc: str  # what it does, one sentence
    unit: str = ""  # physical unit, empty if it has none; by default that in which the name ends
    minimum: float | None = None  # smallest allowed number, None if unbounded
    maximum: float | None = None  # largest allowed number, None if unbounded
    allowed: tuple[Choice, ...] = ()  # what it may be, if it is chosen by name; empty if not
    aliases: tuple[str, ...] = ()  # other names of the option
    tune: Tune | None = None  # where it is worth tuning; None if it is not, or chosen by name
    live: bool = True  # True if a change takes effect at the next solve, False if only at start

    @kept_property
    def choices(self) -> tuple[str, ...]:
        """Return the names that it may be, empty if it is not chosen by name."""
        return tuple(choice.name for choice in self.allowed)

    @property
    def title(self) -> str:
        """Return what messages call it."""
        return f"{'parameter' if '.' in self.name else 'option'} {self.name}"

    def check(self, value: object) -> Value:
        """Return the value in the declared type, or raise ConfigError. An int is accepted for a float."""
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not self.kind:
            raise ConfigError(
                f"{self.title} = {value!r}: expected {self.kind.__name__},"
                f" got {type(value).__name__} (default {self.default!r})"
            )
        if self.allowed and value not in self.choices:
            raise ConfigError(f"{self.title} = {value!r}: choose one of {', '.join(self.choices)}")
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            self._check_range(value)
        assert isinstance(value, (bool, int, float, str))
        return value

    def _check_range(self, value: float) -> None:
        low = -math.inf if self.minimum is None else self.minimum
        high = math.inf if self.maximum is None else self.maximum
        if not math.isfinite(value) or not low <= value <= high:
            raise ConfigError(
                f"{self.title} = {value!r}: expected a number in [{low:g}, {high:g}]"
                f"{' ' + self.unit if self.unit else ''}"
            )

    def read(self, text: str) -> Value:
        """Return the value that a text from the command line stands for; the alias of a choice stands for its name.

        Raises:
            ConfigError: it cannot be read, or is none that the option may have.
        """
        value: Value = text
        if self.kind is bool:
            if text.lower() not in ("true", "false"):
                raise ConfigError(f"{self.title} = {text!r}: expected true or false")
            value = text.lower() == "true"
        elif self.kind is not str:
            try:
                value = self.kind(text)
            except ValueError:
                raise ConfigError(f"{self.title} = {text!r}: expected {self.kind.__name__}") from None
        return self.check(next((choice.name for choice in self.allowed if value in choice.aliases), value))


def option(
    default: Value,
    doc: str,
    *,
    choices: Iterable[str | Choice] = (),
    within: tuple[float, float] | None = None,
    **details: Any,
) -> Any:
    """Declare a field of a dataclass as an option; ``details`` are attributes of Parameter, ``within`` two of them.

    ``node`` among them says which attributes differ where the option is a parameter of the node.
    """
    allowed = tuple(Choice(choice) if isinstance(choice, str) else choice for choice in choices)
    if within is not None:
        details["minimum"], details["maximum"] = within
    return field(default=default, metadata={"default": default, "doc": doc, "allowed": allowed, **details})


def declared(cls: type, group: str = "") -> tuple[Parameter, ...]:
    """Return the options of a dataclass in order; fields that are not made by :func:`option` are left out.

    Parameters of the node have the name of their group before theirs; options of something else have none.
    """
    kinds = get_type_hints(cls)
    found = []
    for item in fields(cls):
        if not item.metadata:
            continue
        details = {"unit": _unit_of(item.name), **item.metadata}
        of_node = details.pop("node", {})
        if group:
            details |= of_node
        found.append(Parameter(name=f"{group}.{item.name}" if group else item.name, kind=kinds[item.name], **details))
    return tuple(found)


# Units that names end in, and how they are written where it is otherwise.
_UNIT = re.compile(r"_((?:m|s|px|rad|deg|ms|hz|mb)(?:_per_(?:m|rad))?)$")
_WRITTEN = {"hz": "Hz", "mb": "MB"}


def _unit_of(name: str) -> str:
    """Return the unit in which a name ends, empty if in none: m/m for ``sigma_m_per_m``."""
    found = _UNIT.search(name)
    return _WRITTEN.get(found[1], found[1].replace("_per_", "/")) if found else ""


@dataclass(frozen=True)
class Checked:
    """Base of options that raise ConfigError when they are made with a wrong value."""

    def __post_init__(self) -> None:
        for parameter in declared(type(self)):
            # An int given for a float is kept as the float that check() returns.
            object.__setattr__(self, parameter.name, parameter.check(getattr(self, parameter.name)))


def split_assignment(text: str, example: str) -> tuple[str, str]:
    """Return name and value of ``name=value``, or raise ConfigError with an example of what is expected."""
    name, separator, value = text.partition("=")
    if not separator:
        raise ConfigError(f"{text!r}: expected name=value, for example {example}")
    return name, value


# Likeness of two names, 0 to 1, from which on the one may be meant by the other.
_ALIKE = 0.75


def unknown(name: str, known: Iterable[str]) -> str:
    """Return what to say of a parameter that does not exist: which others are like it, if any."""
    names, key = list(known), name.rpartition(".")[2]
    near = [other for other in names if "." not in name and other.rpartition(".")[2] == key]
    near = near or difflib.get_close_matches(name, names, n=1, cutoff=_ALIKE)
    if not near:
        keys = {other.rpartition(".")[2]: other for other in names}
        near = [keys[other] for other in difflib.get_close_matches(key, keys, n=1, cutoff=_ALIKE)]
    what = f"did you mean {' or '.join(map(repr, near))}?" if near else "ba params lists all"
    return f"parameter {name!r} does not exist; {what}"
