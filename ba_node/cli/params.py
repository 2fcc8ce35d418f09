# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Print every parameter of the node and of `ba replay` with its default."""

from __future__ import annotations

import argparse

from ba_node.cli.console import write_result

EXAMPLE = "ba params > my.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--yaml", action="store_true", help="as a parameter file of ROS, with comments (default)")
    form.add_argument("--markdown", action="store_true", help="as a table")


def run(args: argparse.Namespace) -> int:
    """Print."""
    from ba_node.config import Config  # noqa: PLC0415
    from ba_node.io.parameters import parameters_markdown, parameters_yaml  # noqa: PLC0415

    write_result(args.json, Config().values())
    print(parameters_markdown() if args.markdown else parameters_yaml(Config()), end="")
    return 0
