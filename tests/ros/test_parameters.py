# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The parameters on a real rclpy node, without an executor and without a second process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter as RclpyParameter

from ba_node.config import Config, ConfigError, declarations
from ba_node.ros.parameters import Parameters

MakeNode = Callable[..., Any]


@pytest.fixture
def make_node(domain: int) -> Iterator[MakeNode]:  # noqa: ARG001
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    nodes = []

    def make(**overrides: Any) -> Any:
        given = [RclpyParameter(name.replace("__", "."), value=value) for name, value in overrides.items()]
        nodes.append(Node("parameters", context=context, parameter_overrides=given, enable_rosout=False))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)


def _set(node: Any, **values: Any) -> Any:
    return node.set_parameters_atomically(
        [RclpyParameter(name.replace("__", "."), value=value) for name, value in values.items()]
    )


def _other_value(parameter: Any) -> Any:
    """Return a valid value that is not the default."""
    if parameter.kind is bool:
        return not parameter.default
    if parameter.kind is str:
        return next((choice for choice in parameter.choices if choice != parameter.default), f"my_{parameter.default}")
    value = parameter.kind(parameter.minimum)
    return value if value != parameter.default else parameter.kind(parameter.maximum)


# What must be set together with a parameter at its smallest value.
COMPANIONS = {"scene.max_keyframes": {"window.max_keyframes": 2}}


def test_every_parameter_is_declared_with_default_and_descriptor(make_node: MakeNode) -> None:
    node = make_node()
    Parameters(node, lambda _: None)
    types = {bool: "BOOL", int: "INTEGER", float: "DOUBLE", str: "STRING"}
    for parameter in declarations():
        assert node.get_parameter(parameter.name).value == parameter.default
        descriptor = node.describe_parameter(parameter.name)
        assert descriptor.type == getattr(ParameterType, f"PARAMETER_{types[parameter.kind]}")
        assert descriptor.description.startswith(parameter.doc)
        assert descriptor.read_only == (not parameter.live)
        assert parameter.unit in descriptor.description
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        expected = [] if parameter.minimum is None else [(parameter.minimum, parameter.maximum)]
        assert [(r.from_value, r.to_value) for r in ranges] == expected, parameter.name
        assert all(choice in descriptor.additional_constraints for choice in parameter.choices)


@pytest.mark.parametrize("name", [p.name for p in declarations() if p.live])
def test_each_live_parameter_takes_effect(make_node: MakeNode, name: str) -> None:
    node = make_node()
    seen: list[Config] = []
    parameters = Parameters(node, seen.append)
    value = _other_value(next(p for p in declarations() if p.name == name))
    changes = {name: value, **COMPANIONS.get(name, {})}
    result = _set(node, **changes)
    assert result.successful, result.reason
    assert seen == [Config().with_values(changes)]
    assert parameters.config == seen[0]
    assert node.get_parameter(name).value == value


@pytest.mark.parametrize("name", [p.name for p in declarations() if not p.live])
def test_each_read_only_parameter_is_set_at_start_only(make_node: MakeNode, name: str) -> None:
    value = _other_value(next(p for p in declarations() if p.name == name))
    node = make_node(**{name: value})
    parameters = Parameters(node, lambda _: None)
    assert parameters.config.values()[name] == value
    # As when the output of `ros2 param dump` is loaded.
    assert _set(node, **{name: value}).successful
    result = _set(node, **{name: Config().values()[name]})
    assert not result.successful
    assert f"parameter {name} = {value!r} is read-only: start the node with -p {name}:=" in result.reason
    assert node.get_parameter(name).value == value


def test_a_set_with_a_fixed_parameter_is_taken_or_refused_as_a_whole(make_node: MakeNode) -> None:
    node = make_node()
    parameters = Parameters(node, lambda _: None)
    assert _set(node, node__inbox_size=500, window__max_keyframes=7).successful
    assert parameters.config.window.max_keyframes == 7
    assert not _set(node, node__inbox_size=501, window__max_keyframes=8).successful
    assert parameters.config.window.max_keyframes == 7


def test_an_unknown_name_is_answered_with_the_nearest(make_node: MakeNode) -> None:
    node = make_node()
    Parameters(node, lambda _: None)
    result = _set(node, window__max_keyframe=7)
    assert not result.successful
    assert result.reason == "parameter 'window.max_keyframe' does not exist; did you mean 'window.max_keyframes'?"


def test_a_number_that_yaml_takes_for_a_string_is_taken_for_double(make_node: MakeNode) -> None:
    """`ros2 param set` and `load` send 1e-9 as a string, since YAML 1.1 wants 1.0e-9."""
    node = make_node()
    parameters = Parameters(node, lambda _: None)
    assert _set(node, solver__gradient_tolerance="1e-7").successful
    assert parameters.config.solver.gradient_tolerance == 1e-7
    result = _set(node, solver__gradient_tolerance="small")
    assert not result.successful
    assert not _set(node, solver__gradient_tolerance=True).successful


def test_int_is_taken_for_double(make_node: MakeNode) -> None:
    node = make_node(solver__loss_scale_px=2)
    parameters = Parameters(node, lambda _: None)
    assert node.get_parameter("solver.loss_scale_px").value == 2.0
    assert _set(node, solver__loss_scale_px=3).successful
    assert parameters.config.solver.loss_scale_px == 3.0
    assert isinstance(node.get_parameter("solver.loss_scale_px").value, float)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("window.max_keyfames", 5, "did you mean 'window.max_keyframes'"),
        ("window.max_keyframes", 1, "expected a number in [2, 100000]"),
        ("window.max_keyframes", 2.5, "expected int, got float"),
        ("window.max_keyframes", [1, 2], "expected int"),
        ("solver.loss", "cubic", "choose one of squared, huber"),
        ("tracks.outlier_px", float("nan"), "expected a number in"),
    ],
)
def test_wrong_values_at_start_name_the_parameter(make_node: MakeNode, name: str, value: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Parameters(make_node(**{name: value}), lambda _: None)
    assert name in str(caught.value)
    assert words in str(caught.value)


def test_a_rejected_set_changes_nothing(make_node: MakeNode) -> None:
    node = make_node()
    seen: list[Config] = []
    parameters = Parameters(node, seen.append)
    result = _set(node, window__max_keyframes=7, solver__loss="cubic")
    assert not result.successful
    assert "solver.loss" in result.reason
    assert "choose one of squared, huber" in result.reason
    assert seen == []
    assert parameters.config == Config()
    assert node.get_parameter("window.max_keyframes").value == Config().window.max_keyframes


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"window.max_keyframes": 6000}, "more than are kept (scene.max_keyframes = 5000)"),
        ({"scene.max_keyframes": 15}, "parameter window.max_keyframes = 20: more than are kept"),
        ({"solver.method": "irls_tq", "solver.loss": "squared"}, "method 'irls_tq' is named after the loss"),
    ],
)
def test_contradictions_are_refused(make_node: MakeNode, changes: dict[str, Any], words: str) -> None:
    node = make_node()
    parameters = Parameters(node, lambda _: None)
    result = _set(node, **changes)
    assert not result.successful
    assert words in result.reason
    assert parameters.config == Config()
    with pytest.raises(ConfigError, match=r"lower the first|leave solver.loss at"):
        Config().with_values(changes)


def test_parameters_of_rclpy_itself_are_left_alone(make_node: MakeNode) -> None:
    node = make_node(use_sim_time=False)
    seen: list[Config] = []
    Parameters(node, seen.append)
    assert _set(node, use_sim_time=False).successful
    assert seen == []
