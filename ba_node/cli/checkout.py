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


@dataclass(frozen=True)
class CheckoutCommand:
    """A command of ``ba`` that a checkout has."""

    name: str  # of the command
    module: str  # below ``experiments``; it has SUMMARY, EXAMPLE, add_arguments and run as the files of this folder
    SUMMARY: str  # one line for ``ba --help``, which does not import the module

    def load(self) -> ModuleType:
        """Import the module of the command.

        Raises:
            CheckoutError: the package is installed without its repository.
        """
        if not all((ROOT / name).is_file() for name in ("setup.py", "experiments/__init__.py")):
            raise CheckoutError(f"{self.name} needs a checkout of the repository: experiments are not installed")
        if str(ROOT) not in sys.path:
            sys.path.append(str(ROOT))
        return importlib.import_module(f"experiments.{self.module}")

    def run(self, args: argparse.Namespace) -> int:
        """Run the command."""
        code: int = self.load().run(args)
        return code
