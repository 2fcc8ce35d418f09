# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replay the recordings of a baseline, and see that no figure became worse.

A baseline lists recordings and figures of their reports with unit, direction and tolerance. --new makes one, --update
takes over the figures of now. In CI: `ba regress bags/regress.yaml`.

Exit code: 0 nothing is worse, 2 the baseline or a recording cannot be read, 3 something is worse or missing.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from ba_node.cli.console import coloured, progress_bar, require_folder, table, write_result

EXAMPLE = "ba regress bags/regress.yaml\n  ba regress mine.yaml --new drive_1.mcap drive_2.mcap"
ATTENTION = 3
_HEAD = ("recording", "figure", "baseline", "now", "change", "allowed", "")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("baseline", type=Path, metavar="BASELINE.yaml")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--new", type=Path, nargs="+", metavar="RECORDING", help="write a new baseline of these")
    what.add_argument("--update", action="store_true", help="write the figures of now into the baseline")


def run(args: argparse.Namespace) -> int:
    """Compare, or write a baseline."""
    from ba_node.offline import regress  # noqa: PLC0415

    require_folder(args.baseline)
    if args.new:
        cases = regress.new_cases(args.baseline, args.new, time.perf_counter)
        regress.write_baseline(args.baseline, cases)
        print(f"{args.baseline}: {len(cases)} recordings, {sum(len(case.figures) for case in cases)} figures")
        write_result(args.json, {"recordings": len(cases)})
        return 0
    cases = regress.read_baseline(args.baseline)
    with progress_bar("regress", "recordings") as progress:
        rows = regress.run(args.baseline, cases, time.perf_counter, progress)
    print(table(_HEAD, [_cells(row) for row in rows]))
    found = [vars(row.figure) | {"recording": row.recording, "now": row.now, "verdict": row.verdict} for row in rows]
    write_result(args.json, {"figures": found})
    worse = [row for row in rows if row.verdict in (regress.WORSE, regress.MISSING)]
    if args.update:
        regress.write_baseline(args.baseline, regress.updated(cases, rows))
        print(f"written to {args.baseline}")
        return 0
    for row in worse:
        print(f"ba: warning: {row.recording}: {row.figure.key} is {row.verdict.lower()}", file=sys.stderr)
    return ATTENTION if worse else 0


def _cells(row: Any) -> tuple[str, ...]:
    of = row.figure
    now = "" if row.now is None else f"{row.now:.6g}"
    change = f"{(row.now - of.value) / of.value:+.2%}" if row.now is not None and of.value else ""
    unit = f" [{of.unit}]" if of.unit else ""
    allowed = f"{of.direction} {of.tolerance:.0%}"
    return (row.recording, f"{of.key}{unit}", f"{of.value:.6g}", now, change, allowed, coloured(row.verdict))
