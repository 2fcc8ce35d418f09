# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write a part of a recording: a time, some topics, or both.

Messages are copied as they are. Cameras, static transforms and what else is latched come along from before the begin.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import counted, progress_bar, require_mcap, write_result

EXAMPLE = "ba cut bags/stereo_loop.mcap --out middle.mcap --start 5 --end 10"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", type=Path, nargs="+", metavar="RECORDING", help="a file, a folder, or all files of one")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT.mcap")
    parser.add_argument(
        "--start", type=float, default=0.0, metavar="S", help="from so many seconds after the first message on"
    )
    parser.add_argument(
        "--end", type=float, default=float("inf"), metavar="S", help="up to so many seconds after the first message"
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these")


def run(args: argparse.Namespace) -> int:
    """Cut."""
    from ba_node.offline.bag_tools import Span, cut  # noqa: PLC0415

    require_mcap(args.out)
    with progress_bar("cut", "messages") as progress:
        count, seconds = cut(args.bag, args.out, Span(args.start, args.end, args.topics), progress)
    print(f"{args.out}: {counted(count, 'message')}, {seconds:.2f} s")
    write_result(args.json, {"messages": count, "duration_s": seconds})
    return 0
