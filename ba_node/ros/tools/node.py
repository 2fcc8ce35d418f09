# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A node for as long as a tool works, in a ROS context of its own, which leaves the signal handlers alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node


@contextmanager
def node_apart(
    name: str, *, domain: int | None = None, args: Sequence[str] = (), namespace: str = ""
) -> Iterator[tuple[Any, Any]]:
    """Make a node; yield it and the executor that it is in."""
    context = rclpy.Context()
    try:
        rclpy.init(args=list(args), context=context, domain_id=domain)
        options = {"namespace": namespace, "start_parameter_services": False, "enable_rosout": False}
        node = Node(name, context=context, **options)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            yield node, executor
        finally:
            executor.shutdown()
            node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)
