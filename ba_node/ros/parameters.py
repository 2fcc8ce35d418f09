# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare the parameters of ``config/`` on a node, and keep the two in step."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.parameter import Parameter as RclpyParameter

from ba_node.config import Config, ConfigError, Parameter, Value, declarations, unknown
from ba_node.ros import qos
from ba_node.ros.rclpy_compat.private import part

_TYPES = {
    bool: RclpyParameter.Type.BOOL,
    int: RclpyParameter.Type.INTEGER,
    float: RclpyParameter.Type.DOUBLE,
    str: RclpyParameter.Type.STRING,
}
_INT64_MAX = 2**63 - 1


def describe(parameter: Parameter) -> Any:
    """Return the rclpy descriptor of a parameter."""
    descriptor = ParameterDescriptor(
        name=parameter.name,
        type=_TYPES[parameter.kind].value,
        description=f"{parameter.doc} [{parameter.unit}]" if parameter.unit else parameter.doc,
        read_only=not parameter.live,
    )
    if parameter.choices:
        descriptor.additional_constraints = f"one of: {', '.join(parameter.choices)}"
    low, high = parameter.minimum, parameter.maximum
    if low is None and high is None:
        return descriptor
    if parameter.kind is int:
        bounds = (-_INT64_MAX if low is None else int(low), _INT64_MAX if high is None else int(high))
        descriptor.integer_range = [IntegerRange(from_value=bounds[0], to_value=bounds[1])]
    else:
        limit = sys.float_info.max
        ends = (-limit if low is None else float(low), limit if high is None else float(high))
        descriptor.floating_point_range = [FloatingPointRange(from_value=ends[0], to_value=ends[1])]
    return descriptor


def declare(node: Any, parameters: Sequence[Parameter]) -> dict[str, Value]:
    """Declare parameters that are set at start; return their values by name.

    Raises:
        ConfigError: a parameter file or the command line names a parameter that does not exist or a wrong value.
    """
    found = part(node, "_parameter_overrides", dict, "parameters with names that do not exist go unnoticed") or {}
    names = [parameter.name for parameter in parameters]
    for name in found:
        if name not in names and not node.has_parameter(name) and not name.startswith(qos.OVERRIDES):
            raise ConfigError(unknown(name, names))
    values = {}
    for parameter in parameters:
        given = found[parameter.name].value if parameter.name in found else parameter.default
        number = _as_float(given) if parameter.kind is float else None
        values[parameter.name] = parameter.check(given if number is None else number)
        description = describe(dataclasses.replace(parameter, live=False))
        node.declare_parameter(parameter.name, values[parameter.name], description, ignore_override=True)
    return values


class Parameters:
    """The parameters of a node: declared once, then changed as a whole or not at all.

    Args:
        node: the rclpy node.
        changed: called with the new Config after a change was made.

    Raises:
        ConfigError: a parameter file or the command line names a parameter that does not exist or a wrong value.
    """

    def __init__(self, node: Any, changed: Callable[[Config], None]) -> None:
        self._changed = changed
        self._node = node
        self._declared = {parameter.name: parameter for parameter in declarations()}
        # rclpy has no public way to see overrides of parameters that nobody declared, and those are the typing errors.
        found = part(node, "_parameter_overrides", dict, "parameters with names that do not exist go unnoticed")
        self._overrides: dict[str, Any] = {} if found is None else found
        self.config = Config().with_values(
            {
                name: given.value
                for name, given in self._overrides.items()
                if not node.has_parameter(name) and not name.startswith(qos.OVERRIDES)
            }
        )
        # Declared with checked values: rclpy itself would refuse an int for a double, which YAML makes of "5".
        for name, value in self.config.values().items():
            node.declare_parameter(name, value, describe(self._declared[name]), ignore_override=found is not None)
        if found is None:
            self.config = self.config.with_values({name: node.get_parameter(name).value for name in self._declared})
        # Requests come here first: rclpy's answer to an unknown name does not say the name.
        self._set = node.set_parameters_atomically
        node.set_parameters_atomically = self._on_request
        node.add_pre_set_parameters_callback(self._coerce)
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def check_overrides(self) -> None:
        """Refuse overrides of the QoS of topics and policies that are not there; to be called when all topics are.

        Raises:
            ConfigError: an override names none of them.
        """
        there = [name for name in self._node.get_parameters_by_prefix("") if name.startswith(qos.OVERRIDES)]
        for name in self._overrides:
            if name.startswith(qos.OVERRIDES) and name not in there:
                raise ConfigError(unknown(name, there))

    def _on_request(self, given: list[Any]) -> Any:
        """Take a set of changes or refuse it; what can be set at start only may be given the value that it has."""
        unknown_names = [item.name for item in given if not self._node.has_parameter(item.name)]
        if unknown_names:
            reason = unknown(unknown_names[0], list(self._node.get_parameters_by_prefix("")))
            return SetParametersResult(successful=False, reason=reason)
        fixed = [item for item in self._coerce(given) if self._node.describe_parameter(item.name).read_only]
        for item in fixed:
            value = self._node.get_parameter(item.name).value
            if type(item.value) is not type(value) or item.value != value:
                reason = f"parameter {item.name} = {value!r} is read-only: start the node with -p {item.name}:=..."
                return SetParametersResult(successful=False, reason=reason)
        names = {item.name for item in fixed}
        changes = [item for item in given if item.name not in names]
        return self._set(changes) if changes else SetParametersResult(successful=True)

    def _coerce(self, given: list[Any]) -> list[Any]:
        """Turn what stands for doubles into doubles: ints, and 1e-9, which is a string in YAML."""
        return [
            RclpyParameter(item.name, RclpyParameter.Type.DOUBLE, _as_float(item.value))
            if self._kind(item.name) is float and _as_float(item.value) is not None
            else item
            for item in given
        ]

    def _kind(self, name: str) -> type | None:
        return self._declared[name].kind if name in self._declared else None

    def _own(self, given: list[Any]) -> dict[str, object]:
        return {item.name: item.value for item in given if item.name in self._declared}

    def _validate(self, given: list[Any]) -> Any:
        """Accept or reject a set of changes, without side effects."""
        try:
            self.config.with_values(self._own(given))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, given: list[Any]) -> None:
        changes = self._own(given)
        if changes:
            self.config = self.config.with_values(changes)
            self._changed(self.config)


def _as_float(value: object) -> float | None:
    """Return the number that a value is or spells, None if it is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None
