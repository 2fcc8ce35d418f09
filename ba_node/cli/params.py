# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Print every parameter of the node and of `ba replay` with its default, as a parameter file of ROS with comments."""

from __future__ import annotations

import argparse

from ba_node.cli.console import write_result

EXAMPLE = "ba params > my.yaml"


def add_arguments(_: argparse.ArgumentParser) -> None:
    """Declare no options."""


def run(args: argparse.Namespace) -> int:
    """Print."""
    from ba_node.config import Config  # noqa: PLC0415
    from ba_node.io.parameters import parameters_yaml  # noqa: PLC0415

    write_result(args.json, Config().values())
    print(parameters_yaml(Config()), end="")
    return 0
