# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make one page of the results of `ba replay`; of several folders side by side, each in a colour of its own.

The page needs nothing else and opens without a network. Each figure is a PNG too, in a folder called as the page.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import require_folder

EXAMPLE = "ba report out/default out/tuned --out compare.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="folder of results of ba replay")
    parser.add_argument(
        "--out", type=Path, metavar="HTML", help="file to write (default: report.html in the first folder, or here)"
    )


def run(args: argparse.Namespace) -> int:
    """Write the page."""
    from ba_node.offline.report import REPORT, write_report  # noqa: PLC0415

    require_folder(args.out)
    path = args.out or (args.folders[0] / REPORT if len(args.folders) == 1 else Path(REPORT))
    print(f"written to {path.parent}: {write_report(args.folders, path)}")
    return 0
