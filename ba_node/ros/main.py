# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the node as a process: `ros2 run ba_node ba_node` or `python -m ba_node.ros.main --ros-args ...`."""

from __future__ import annotations

import gc
import signal
import sys
import traceback
from contextlib import contextmanager
from typing import TYPE_CHECKING

import rclpy
from rclpy.exceptions import InvalidNamespaceException, InvalidNodeNameException
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation

from ba_node.config import ConfigError
from ba_node.ros import arguments
from ba_node.ros.executor import NodeExecutor
from ba_node.ros.node import NODE_NAME, BaNode

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from types import FrameType

USAGE_ERROR = 2
# One after the other: then it is not a single message or request that is at fault.
_MAX_FAULTS = 20
# How long a thread keeps the interpreter from another, s. With Python's 5 ms the solver's thread waits until the
# executor has nothing to do, and the other way round.
_SWITCH_INTERVAL_S = 0.0005
_ARGUMENT_ERRORS = (
    rclpy_implementation.RCLError,
    rclpy_implementation.RCLInvalidROSArgsError,
    rclpy_implementation.UnknownROSArgsError,
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code, 2 if parameters or arguments are wrong.

    Args:
        args: the program and its arguments; None for those of the process.
    """
    given = list(sys.argv if args is None else args)
    with _one_interrupt():
        try:
            rclpy.init(args=given)
        except _ARGUMENT_ERRORS as error:
            return _refuse(str(error))
        try:
            return _run(given)
        finally:
            rclpy.try_shutdown()


def _run(given: list[str]) -> int:
    if arguments.asks_for_help(given):
        print(arguments.USAGE, end="")
        return 0
    if reason := arguments.objection(given):
        return _refuse(reason)
    try:
        node = BaNode()
    except (ConfigError, InvalidNodeNameException, InvalidNamespaceException) as error:
        return _refuse(str(error))
    except Exception:
        if rclpy.ok():
            raise
        return 0  # a signal came while the node was being made
    executor = NodeExecutor()
    executor.add_node(node)
    for text in arguments.idle_files(given, node.get_fully_qualified_name()):
        node.get_logger().warning(text)
    node.start()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    # Modules, messages and the node stay for good: looking through them took the collector 14 ms at a time.
    gc.collect()
    gc.freeze()
    try:
        _spin(executor, node)
    finally:
        node.stop()
        executor.shutdown()
        node.destroy_node()
    print(f"stopped: {node.keyframes_refined} keyframes refined", flush=True)
    return 0


def _spin(executor: NodeExecutor, node: BaNode) -> None:
    """Run callbacks until the context ends. One that raises, as rclpy's own do on a senseless request, is survived."""
    faults = 0
    while rclpy.ok():
        if _spin_once(executor, node):
            faults = 0
            continue
        faults += 1
        if faults == _MAX_FAULTS:
            raise RuntimeError(f"{faults} internal errors one after the other: giving up")


def _spin_once(executor: NodeExecutor, node: BaNode) -> bool:
    """Run one callback; return False if it raised."""
    try:
        # On a signal rclpy first wakes the executor and then ends the context: it may find the executor asleep again.
        executor.spin_once()
    except Exception as error:
        # A signal ends the context at any moment, also between two messages that a callback publishes.
        if isinstance(error, ExternalShutdownException) or not rclpy.ok():
            return True
        node.get_logger().error(f"internal error, going on: {error}\n{traceback.format_exc()}")
        return False
    return True


def _refuse(reason: str) -> int:
    print(f"{NODE_NAME}: {' '.join(reason.split())}", file=sys.stderr)
    return USAGE_ERROR


@contextmanager
def _one_interrupt() -> Iterator[None]:
    """Leave the first SIGINT to rclpy, which ends the context as on SIGTERM; a second one interrupts whatever hangs.

    Python's own handler, which rclpy's calls, would raise KeyboardInterrupt in the middle of any callback.
    """
    interrupts = 0

    def on_interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal interrupts
        interrupts += 1
        if interrupts > 1:
            raise KeyboardInterrupt

    previous = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


if __name__ == "__main__":
    sys.exit(main())
