# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put several recordings of the same time together, as those of a robot's computers, or a recording and its refinement.

Messages are copied as they are, by time. Exit code 3: an input of the node is in several of them, so that two streams
were mixed in one topic.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ba_node.cli.console import counted, progress_bar, require_mcap, write_result

EXAMPLE = "ba merge bags/stereo_loop.mcap out/refined.mcap --out both.mcap"
ATTENTION = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bags", type=Path, nargs="+", metavar="RECORDING")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT.mcap")


def run(args: argparse.Namespace) -> int:
    """Merge."""
    from ba_node.offline.bag_tools import merge  # noqa: PLC0415

    require_mcap(args.out)
    with progress_bar("merge", "messages") as progress:
        count, mixed = merge(args.bags, args.out, progress)
    print(f"{args.out}: {counted(count, 'message')}")
    for topic in mixed:
        print(f"ba: warning: {topic} is in several of them: two streams are mixed in it", file=sys.stderr)
    write_result(args.json, {"messages": count, "mixed": mixed})
    return ATTENTION if mixed else 0
