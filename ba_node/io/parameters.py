# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read parameters from YAML, and write them as YAML for ROS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from ba_node.config import Config, ConfigError, Parameter, Value, declarations
from ba_node.io.yaml_file import read_yaml

NODE_NAME = "ba_node"
_ROS_KEY = "ros__parameters"
# Parameters of every ROS node, which a file for the node may hold and which mean nothing here.
_OF_EVERY_NODE = ("use_sim_time", "start_type_description_service", "qos_overrides")


def read_parameters(path: Path | str) -> dict[str, object]:
    """Return the parameters in a YAML file by their full names.

    Both forms are understood: that of ROS (``/**:``, ``ros__parameters:``) and plain names; both nested or dotted.

    Raises:
        ConfigError: the file cannot be read, is not YAML, or holds no mapping of parameters.
    """
    content = read_yaml(path, ConfigError)
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected a mapping of parameters, got {type(content).__name__}")
    kinds = {parameter.name: parameter.kind for parameter in declarations()}
    found: dict[str, object] = {}
    for name, value in _flatten(_of_this_node(path, content)):
        if name.split(".")[0] not in _OF_EVERY_NODE:
            found[name] = _as_float(value) if kinds.get(name) is float else value
    return found


def configure(path: Path | str | None, changes: Mapping[str, object]) -> Config:
    """Return the defaults with what a file says (None for no file), and then with single changes.

    Raises:
        ConfigError: a parameter does not exist or has a wrong value; names the file if it stands there.
    """
    config = Config()
    if path is not None:
        try:
            config = config.with_values(read_parameters(path))
        except ConfigError as error:
            raise ConfigError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    return config.with_values(changes)


def parameters_yaml(config: Config, *, comments: bool = True) -> str:
    """Return all parameters as a file that ``--ros-args --params-file`` and :func:`read_parameters` take."""
    values = config.values()
    return _yaml((one, values[one.name], _comments(one) if comments else (), "") for one in declarations())


def changes_yaml(config: Config) -> str:
    """Return the parameters that differ from their defaults as such a file, the default behind each."""
    values = config.values()
    changed = [one for one in declarations() if values[one.name] != one.default]
    rows = ((one, values[one.name], (), f"  # default {scalar(one.default)}") for one in changed)
    return _yaml(rows) if changed else "{}  # all parameters have their defaults\n"


def plain_yaml(parameters: Sequence[Parameter]) -> str:
    """Return parameters without groups, with their defaults, as a file for ``--params-file``."""
    return _yaml((one, one.default, _comments(one), "") for one in parameters)


def _yaml(rows: Iterable[tuple[Parameter, Value, Sequence[str], str]]) -> str:
    """Return parameters with their values, comments above and what stands behind them."""
    lines, last = ["/**:", f"  {_ROS_KEY}:"], ""
    for parameter, value, above, behind in rows:
        group, _, key = parameter.name.rpartition(".")
        if group != last:
            lines.append(f"    {group}:")
            last = group
        indent = " " * (6 if group else 4)
        lines += [*(f"{indent}# {line}" for line in above), f"{indent}{key}: {scalar(value)}{behind}"]
    return "\n".join(lines) + "\n"


def _comments(parameter: Parameter) -> tuple[str, str]:
    unit = f"[{parameter.unit}] " if parameter.unit else ""
    change = "takes effect at the next solve" if parameter.live else "takes effect at start only"
    return parameter.doc, f"{unit}{allowed(parameter)}; default {scalar(parameter.default)}; {change}"


def _of_this_node(path: Path | str, content: dict[Any, Any]) -> dict[Any, Any]:
    """Return the parameters that ROS would give to this node, those for all nodes first."""
    by_node = {str(key): value for key, value in content.items() if isinstance(value, dict) and _ROS_KEY in value}
    if not by_node:
        return content
    ours = [name for name in by_node if name.rsplit("/", 1)[-1] in ("**", "*", NODE_NAME)]
    if not ours:
        raise ConfigError(f"{path}: parameters of {', '.join(by_node)} only: expected /** or {NODE_NAME}")
    merged: dict[Any, Any] = {}
    for name in sorted(ours, key=lambda name: name.endswith(NODE_NAME)):
        values = by_node[name][_ROS_KEY] or {}
        if not isinstance(values, dict):
            raise ConfigError(f"{path}: {name}: {_ROS_KEY} = {values!r}: expected a mapping of parameters")
        merged.update(dict(_flatten(values)))
    return merged


def _flatten(tree: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, object]]:
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _flatten(value, f"{name}.")
        else:
            yield name, value


def _as_float(value: object) -> object:
    """Return the number that ROS sees in a text such as 1e-4, which YAML 1.1 takes for a string."""
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def scalar(value: Value) -> str:
    """Return a value as YAML has it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 wants a point in a number with an exponent.
        return text.replace("e", ".0e") if "e" in text and "." not in text else text
    if isinstance(value, str) and yaml.safe_load(value) != value:
        return f"'{value}'"
    return str(value)


def allowed(parameter: Parameter) -> str:
    """Return in words what a parameter may be."""
    if parameter.choices:
        return ", ".join(parameter.choices)
    if parameter.kind is bool:
        return "true, false"
    show = "{:.0f}" if parameter.kind is int else "{:g}"
    low, high = ("" if bound is None else show.format(bound) for bound in (parameter.minimum, parameter.maximum))
    if low and high:
        return f"{low} to {high}"
    return f"at least {low}" if low else f"at most {high}" if high else "any"
