# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the running node: described, set to each bound and beyond, to a wrong type and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter as RclpyParameter

from ba_node.config import Config, Parameter, declarations

pytestmark = pytest.mark.dds


def _set(peer: Any, values: dict[str, Any]) -> Any:
    """Set parameters together, and return the result."""
    parameters = [RclpyParameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    request = SetParametersAtomically.Request(parameters=parameters)
    return peer.call(SetParametersAtomically, "ba_node/set_parameters_atomically", request).result


def _good(parameter: Parameter) -> list[Any]:
    if parameter.kind is bool:
        return [False, True]
    if parameter.kind is str:
        return list(parameter.choices)
    return [parameter.kind(bound) for bound in (parameter.minimum, parameter.maximum) if bound is not None]


def _bad(parameter: Parameter) -> list[Any]:
    wrong_type: list[Any] = [1 if parameter.kind in (bool, str) else "one"]
    if parameter.choices:
        return [*wrong_type, "no such choice"]
    bounds = [(parameter.minimum, -1), (parameter.maximum, 1)]
    return wrong_type + [
        parameter.kind(bound + sign * max(1, abs(bound))) for bound, sign in bounds if bound is not None
    ]


def _consistent(changes: dict[str, Any]) -> bool:
    try:
        Config().with_values(changes)
    except ValueError:
        return False
    return True


@pytest.mark.slow
def test_walk(start_node: Callable[..., Any], make_peer: Callable[..., Any]) -> None:
    node, peer = start_node(), make_peer()
    names = [parameter.name for parameter in declarations()]
    request = DescribeParameters.Request(names=names)
    described = peer.call(DescribeParameters, "ba_node/describe_parameters", request).descriptors
    for parameter, descriptor in zip(declarations(), described, strict=True):
        name, default = parameter.name, parameter.default
        assert descriptor.description.startswith(parameter.doc), name
        assert descriptor.read_only == (not parameter.live), name
        for value in _bad(parameter):
            result = _set(peer, {name: value})
            assert not result.successful, f"{name} = {value!r}"
            assert result.reason, f"{name} = {value!r}"
        for value in _good(parameter):
            result = _set(peer, {name: value})
            taken = _consistent({name: value}) if parameter.live else value == default
            assert result.successful == taken, f"{name}: {result.reason}"
        if parameter.live:
            result = _set(peer, {name: default})
            assert result.successful, f"{name}: {result.reason}"
    answers = peer.call(GetParameters, "ba_node/get_parameters", GetParameters.Request(names=names)).values
    values = dict(
        zip(
            names,
            (RclpyParameter.from_parameter_msg(_message(n, v)).value for n, v in zip(names, answers, strict=True)),
            strict=True,
        )
    )
    assert values == Config().values(), "all are back to their defaults"
    assert node.stop() == 0


def _message(name: str, value: Any) -> Any:
    (message,) = SetParameters.Request(parameters=[RclpyParameter(name).to_parameter_msg()]).parameters
    message.value = value
    return message
