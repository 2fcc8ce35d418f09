# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Try every combination of some values of parameters on recordings.

The error is that of `ba tune`: of the trajectory where a recording has a truth, else of tracks that are held out of it.
Writes into DIR: sweep.csv and sweep.json with each combination that is through, and index.html in the end.

Exit code: 3 if a recording or a combination cannot be used, which is named and stops no other.
"""

from __future__ import annotations

import argparse

from ba_node.cli import console

EXAMPLE = "ba sweep bags/*.mcap --out out/sweep --values window.max_keyframes=5,10,20 --values tracks.outlier_px=3,6"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", type=console.place, nargs="+", metavar="RECORDING", help="files, folders or URLs")
    parser.add_argument(
        "--values", action="append", required=True, metavar="NAME=A,B,C", help="values of a parameter; repeatable"
    )
    console.add_search_options(parser)


def run(args: argparse.Namespace) -> int:
    """Sweep."""
    from ba_node.config import find, split_assignment  # noqa: PLC0415
    from ba_node.offline import tuning, tuning_page  # noqa: PLC0415
    from ba_node.offline.batch import recordings  # noqa: PLC0415
    from ba_node.offline.fleet import Fleet  # noqa: PLC0415
    from ba_node.offline.study import Plan  # noqa: PLC0415

    base = console.parameters(args)
    values = {}
    for text in args.values:
        name, listed = split_assignment(text, "window.max_keyframes=5,10,20")
        parameter = find(name)
        values[parameter.name] = [parameter.read(one.strip()) for one in listed.split(",")]
    plan = Plan(
        tuple(recordings(args.bag, each=args.each)),
        None,
        (),
        objective=args.objective,
        topics=console.topic_choice(args),
    )
    args.out.mkdir(parents=True, exist_ok=True)
    with Fleet(args.jobs, args.scheduler) as fleet, console.progress_bar("sweep", "replays") as progress:

        def keep(done: int, total: int, found: tuning.Swept) -> None:
            progress(done, total)
            tuning_page.keep_sweep(args.out, found)

        found, left_out = tuning.sweep(plan, base, fleet, list(tuning.grid(values)), keep)
    print(console.table(*tuning_page.sweep_rows(found)))
    print(f"written to {args.out}: {tuning_page.write_sweep(args.out, found)}")
    console.write_result(args.json, tuning_page.sweep_as_dict(found))
    return console.say_left_out(left_out)
