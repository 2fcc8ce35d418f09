# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Commands whose code is not installed: it stands in ``experiments``, beside the package in a checkout."""

from __future__ import annotations

import argparse
import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]


class CheckoutError(ValueError):
    """There are no experiments beside the package."""


def present() -> bool:
    """Return True if the package is used from a checkout of its repository."""
    return all((ROOT / name).is_file() for name in ("setup.py", "experiments/__init__.py"))


def load(name: str, what: str) -> ModuleType:
    """Import a module of ``experiments``, such as ``thesis.steps``; ``what`` the user asked for is for the error.

    Raises:
        CheckoutError: the package is installed without its repository.
    """
    if not present():
        raise CheckoutError(f"{what} needs a checkout of the repository: experiments are not installed with ba_node")
    if str(ROOT) not in sys.path:
        sys.path.append(str(ROOT))
    return importlib.import_module(f"experiments.{name}")


@dataclass(frozen=True)
class CheckoutCommand:
    """A command of ``ba`` that a checkout has."""

    name: str  # of the command
    module: str  # below ``experiments``; it has SUMMARY, EXAMPLE, add_arguments and run as the files of this folder
    SUMMARY: str  # one line for ``ba --help``, which does not import the module

    def load(self) -> ModuleType:
        """Import the module of the command, or raise CheckoutError."""
        return load(self.module, self.name)

    def run(self, args: argparse.Namespace) -> int:
        """Run the command."""
        code: int = self.load().run(args)
        return code
