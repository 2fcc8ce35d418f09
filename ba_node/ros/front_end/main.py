# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the front-end as a process: `ros2 run ba_node ba_front_end`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rclpy.executors import SingleThreadedExecutor

from ba_node.ros.front_end.node import NODE_NAME, FrontEndNode
from ba_node.ros.main import run


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code, 2 if parameters or arguments are wrong."""
    # That of events has no way for callbacks that ask for more than the message.
    return run(NODE_NAME, FrontEndNode, args, SingleThreadedExecutor)


if __name__ == "__main__":
    sys.exit(main())
