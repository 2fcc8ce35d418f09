# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Repeat experiments of the thesis behind the methods: its tables and figures, with ours beside the thesis's.

Say which by table (3.8), figure (fig-3.16) or name, see --list; --all for all, in about an hour of an idle core;
open-... are experiments on what the thesis leaves open. Every run is recorded in OUT/runs as JSON: what was
interrupted goes on where it stopped, what has been run is not run again, and an option that has changed makes a new
run. Written to OUT: report.html with everything in it, report.md and images/, results.json with all figures.

The problem Ladybug-49 is read from the folder --data, and so are samples of GTSAM and KITTI if they are there; the
others are made.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ba_node.cli.console import progress_bar

if TYPE_CHECKING:
    from experiments.thesis.tasks import Task

EXAMPLE = "ba thesis 3.8 5.1 --out out/thesis"


class ChoiceError(ValueError):
    """No experiment was named."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="table, figure or name of an experiment")
    parser.add_argument("--list", action="store_true", help="list the experiments")
    parser.add_argument("--all", action="store_true", help="all of them")
    parser.add_argument(
        "--out", type=Path, default=Path("out/thesis"), metavar="DIR", help="folder to write to (default: out/thesis)"
    )
    parser.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="folder with problem-49-7776-pre.txt (default: data)",
    )
    parser.add_argument("--quick", action="store_true", help="three steps a run and no large problem: to look at it")


def run(args: argparse.Namespace) -> int:
    """Run what is missing and write the pages."""
    # Processor time is compared: threads that wait for each other would count.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ba_node.io.files import locked_folder  # noqa: PLC0415
    from experiments.thesis import catalogue  # noqa: PLC0415
    from experiments.thesis.data_sets import DATA_SETS  # noqa: PLC0415
    from experiments.thesis.problems import DATA  # noqa: PLC0415
    from experiments.thesis.repeat import Repetition  # noqa: PLC0415

    if args.list:
        for experiment in catalogue.EXPERIMENTS:
            print(f"{experiment.name:10} {experiment.heading}")
        return 0
    if bool(args.names) == args.all:
        raise ChoiceError("say which experiments, for example `ba thesis 3.8 5.1`, or --all, or --list to see them")
    repetition = Repetition(catalogue.chosen(args.names), args.data or DATA, args.out, quick=args.quick)
    for name in repetition.absent:
        print(f"left out: {DATA_SETS[name].left_out(name, args.data or DATA)}", file=sys.stderr)
    with progress_bar("thesis", "steps") as show:
        done, total = 0, sum(task.weight for task in repetition.missing())

        def progress(task: Task, share: float) -> None:
            nonlocal done
            show(done + int(share * task.weight), total)
            done += task.weight if share >= 1.0 else 0

        with locked_folder(args.out):
            sections = repetition.run(time.process_time, progress)
            page = repetition.write(sections)
    for section in sections:
        print(f"{section.experiment.heading}\n\n{section.table().markdown()}")
    print(f"written: {page}")
    return 0
