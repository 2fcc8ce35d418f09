# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make one page of the results of `ba replay`; of several folders side by side, each in a colour of its own.

The page needs nothing else and opens without a network. Each figure is a PNG too, in a folder called as the page.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import progress_bar, require_folder, write_result

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
    with progress_bar("report", "figures") as progress:
        written = write_report(args.folders, path, progress)
    print(f"written to {path.parent}: {written}")
    page = str(path) if path.is_file() else None
    write_result(args.json, {"page": page, "pictures": str(path.with_suffix(""))})
    return 0
