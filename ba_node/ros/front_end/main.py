# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the front-end as a process: `ros2 run ba_node ba_front_end`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from ba_node.config import ConfigError
from ba_node.front_end.records import FrontEndError
from ba_node.io.rig_file import RigError
from ba_node.ros import arguments
from ba_node.ros.front_end.node import NODE_NAME, FrontEndNode
from ba_node.ros.main import USAGE_ERROR, signals, spin
from ba_node.ros.rclpy_compat.private import ARGUMENT_ERRORS


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code, 2 if parameters or arguments are wrong."""
    given = list(sys.argv if args is None else args)
    with signals() as ended:
        try:
            rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
            if reason := arguments.objection(given):
                return _refuse(reason)
            node = FrontEndNode()
        except (*ARGUMENT_ERRORS, ConfigError, RigError, FrontEndError) as error:
            return _refuse(str(error))
        try:
            # That of events has no way for callbacks that ask for more than the message.
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            node.start()
            spin(executor, node, ended)
            print(f"stopped: {node.summary()}", flush=True)
            node.cleanup()
            executor.shutdown()
            node.destroy_node()
        finally:
            rclpy.try_shutdown()
    return 0


def _refuse(reason: str) -> int:
    rclpy.try_shutdown()
    print(f"{NODE_NAME}: {' '.join(reason.split())}", file=sys.stderr)
    return USAGE_ERROR


if __name__ == "__main__":
    sys.exit(main())
