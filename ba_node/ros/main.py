# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the node as a process: `ros2 run ba_node ba_node` or `python -m ba_node.ros.main --ros-args ...`."""

from __future__ import annotations

import gc
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import rclpy
from rclpy.exceptions import InvalidNamespaceException, InvalidNodeNameException
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions

from ba_node.config import ConfigError
from ba_node.front_end.records import FrontEndError
from ba_node.io.rig_file import RigError
from ba_node.ros import arguments
from ba_node.ros.log import Severity, fault, log
from ba_node.ros.node import NODE_NAME, BaNode
from ba_node.ros.rclpy_compat.executor import WAIT_S, make_executor
from ba_node.ros.rclpy_compat.private import ARGUMENT_ERRORS

USAGE_ERROR = 2
# One after the other: then it is not a single message or request that is at fault.
_MAX_FAULTS = 20
# How long a thread keeps the interpreter from another, s. With Python's 5 ms the solver's thread waits until the
# executor has nothing to do, and the other way round.
_SWITCH_INTERVAL_S = 0.0005


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code, 2 if parameters or arguments are wrong."""
    return run(NODE_NAME, BaNode, args)


def run(
    name: str, make: Callable[[], Any], args: Sequence[str] | None, executor: Callable[[], Any] = make_executor
) -> int:
    """Run a managed node as a process until SIGINT or SIGTERM; return the exit code.

    Args:
        name: of the program, which begins what it says.
        make: makes the node, which starts, stops and sums up what it did.
        args: the program and its arguments; None for those of the process.
        executor: makes what calls its callbacks.
    """
    given = list(sys.argv if args is None else args)
    with signals() as ended:
        try:
            # rclpy's own handlers end the context at once: nobody who waits for an answer could be told any more.
            rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
        except ARGUMENT_ERRORS as error:
            return _refuse(name, str(error))
        try:
            return _run(name, lambda: (make(), executor()), given, ended)
        finally:
            rclpy.try_shutdown()


def _run(name: str, make: Callable[[], tuple[Any, Any]], given: list[str], ended: Callable[[], bool]) -> int:
    if arguments.asks_for_help(given):
        print(arguments.usage(name), end="")
        return 0
    if reason := arguments.objection(given):
        return _refuse(name, reason)
    try:
        node, executor = make()
    except (ConfigError, FrontEndError, RigError, InvalidNodeNameException, InvalidNamespaceException) as error:
        return _refuse(name, str(error))
    executor.add_node(node)
    for text in arguments.idle_files(given, node.get_fully_qualified_name()):
        log(node, Severity.WARNING, text)
    node.start()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    # Modules, messages and the node stay for good: looking through them took the collector 14 ms at a time.
    gc.collect()
    gc.freeze()
    try:
        spin(executor, node, ended)
    finally:
        node.stop()
        executor.shutdown()
        node.destroy_node()
    print(f"stopped: {node.summary()}", flush=True)
    return 0


def spin(executor: Any, node: Any, ended: Callable[[], bool]) -> None:
    """Run callbacks until a signal. One that raises, as rclpy's own do on a senseless request, is survived."""
    faults = 0
    while rclpy.ok() and not ended():
        if _spin_once(executor, node):
            faults = 0
            continue
        faults += 1
        if faults == _MAX_FAULTS:
            raise RuntimeError(f"{faults} internal errors one after the other: giving up")


def _spin_once(executor: Any, node: Any) -> bool:
    """Run one callback, after a wait that a signal may last out; return False if it raised."""
    try:
        executor.spin_once(WAIT_S)
    except Exception as error:
        # Whoever embeds the node may end the context at any moment, also between two messages of a callback.
        if isinstance(error, ExternalShutdownException) or not rclpy.ok():
            return True
        log(node, Severity.ERROR, f"{fault(error)}, going on\n{traceback.format_exc()}")
        return False
    return True


def _refuse(name: str, reason: str) -> int:
    print(f"{name}: {' '.join(reason.split())}", file=sys.stderr)
    return USAGE_ERROR


@contextmanager
def signals() -> Iterator[Callable[[], bool]]:
    """Note the first SIGINT or SIGTERM, for the executor to find; a second one interrupts whatever hangs.

    Python's own handler would raise KeyboardInterrupt in the middle of any callback.

    Yields:
        What tells whether one came.
    """
    count = 0

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal count
        count += 1
        if count > 1:
            raise KeyboardInterrupt

    previous = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: count > 0
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
