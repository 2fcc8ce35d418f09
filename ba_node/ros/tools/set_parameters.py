# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Set parameters of a running node, all of them or none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from ba_node.config import find
from ba_node.io.parameters import configure, read_parameters
from ba_node.ros.tools.node import node_apart

_FIND_S, _ANSWER_S = 10.0, 10.0


class NoNodeError(ValueError):
    """A node that is not there, or refuses."""


def set_parameters(node_name: str, path: Path) -> list[str]:
    """Set the parameters in a file on a node; return what was done, a sentence each.

    Raises:
        ConfigError: the file cannot be read, or has a wrong value.
        NoNodeError: the node does not answer, or refuses.
    """
    wanted = read_parameters(path)
    values = configure(path, {}).values()
    live = {find(name).name: values[find(name).name] for name in wanted if find(name).live}
    others = [name for name in wanted if not find(name).live]
    said = [f"{node_name}: {name} takes effect at its start only: give it {path} as --params-file" for name in others]
    if not live:
        return [*said, f"{path}: nothing to set on {node_name}"]
    with node_apart("ba_tune") as (node, executor):
        _set(node, executor, node_name, live)
    return [*said, *(f"{node_name}: {name} = {value}" for name, value in live.items())]


def _set(node: Any, executor: Any, node_name: str, values: dict[str, Any]) -> None:
    client = AsyncParameterClient(node, node_name)
    if not client.wait_for_services(timeout_sec=_FIND_S):
        raise NoNodeError(f"{node_name}: no such node answers: start it, or name it as ros2 node list does")
    # All at once: some values are refused beside the old ones of others.
    request = client.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])
    executor.spin_until_future_complete(request, timeout_sec=_ANSWER_S)
    if not request.done() or request.result() is None:
        raise NoNodeError(f"{node_name}: gave no answer in {_ANSWER_S:g} s")
    result = request.result().result
    if not result.successful:
        raise NoNodeError(f"{node_name}: refuses: {result.reason}")
