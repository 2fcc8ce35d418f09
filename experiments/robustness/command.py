# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replay recordings gone wrong and tell whether harm was done: error before and after, verdict, cause named.

Faults are those of experiments/robustness/faults, by every rig and amount; outliers are of three kinds, by share and
rig, against the same recording without them. --only takes names of faults, or faults, outliers, sound. Written to DIR:
results.jsonl, a line a recording (what is in it is not run again: take another DIR after a change of the code),
results.json with the figures of this call, report.md and images/.

Exit code: 0 no harm, 3 a recording with a fault became worse than it came in.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import progress_bar

EXAMPLE = "ba robustness --only camera_turned outliers --seeds 1 --out out/robustness"
HARM = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--out", type=Path, default=Path("out/robustness"), metavar="DIR", help="folder (default: out/robustness)"
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these faults or tables")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="recordings of each kind (default: 3)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")


def run(args: argparse.Namespace) -> int:
    """Run what is missing and write the page."""
    from experiments.robustness.page import page  # noqa: PLC0415
    from experiments.robustness.plots import draw  # noqa: PLC0415
    from experiments.robustness.runs import NameChoiceError, run_all, tasks, write_rows  # noqa: PLC0415

    if args.seeds < 1:
        raise NameChoiceError(f"--seeds {args.seeds}: expected 1 or more")
    wanted = tasks(args.seeds, args.only)
    with progress_bar("robustness", "recordings") as progress:
        rows = run_all(wanted, args.out, max(1, args.jobs), progress)
    text = page(rows)
    print(text)
    draw(args.out / "images", rows)
    (args.out / "report.md").write_text(text, encoding="utf-8")
    write_rows(args.out / "results.json", rows)
    print(f"written: {args.out / 'report.md'}")
    return HARM if any(row.get("verdict") in ("harm", "crash") for row in rows) else 0
