# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Give a command an option for each that a dataclass declares."""

from __future__ import annotations

import argparse
from typing import Any

from ba_node.config import declared


def add_declared_options(parser: argparse.ArgumentParser, options: type) -> None:
    """Declare an option of the command for each that a dataclass declares."""
    for option in declared(options):
        flag, unit = f"--{option.name.replace('_', '-')}", f", {option.unit}" if option.unit else ""
        text = f"{option.doc} (default: {option.default}{unit})".replace("%", "%%")
        if option.kind is bool:
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, help=text)
        else:
            metavar = None if option.choices else option.kind.__name__.upper()
            parser.add_argument(flag, type=option.kind, choices=option.choices or None, metavar=metavar, help=text)


def declared_options(args: argparse.Namespace, options: type) -> dict[str, Any]:
    """Return those of the options of :func:`add_declared_options` that were given."""
    values = {option.name: getattr(args, option.name) for option in declared(options)}
    return {name: value for name, value in values.items() if value is not None}
