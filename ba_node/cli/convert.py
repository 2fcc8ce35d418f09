# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make a recording of a BAL file: each image a keyframe in file order, its points as landmark guesses.

Stamps are 0.1 s apart, ids are the indices in the file; each image has a camera of its own in the rig. Pixels are
float32 in the messages, so an objective differs from that of the file in the seventh digit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import require_mcap

SUMMARY = "make a recording of a BAL file"
EXAMPLE = "ba convert problem-49-7776-pre.txt ladybug.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", type=Path, metavar="IN", help="BAL file: .txt, .bz2 or .gz")
    parser.add_argument("target", type=Path, metavar="OUT.mcap")


def run(args: argparse.Namespace) -> int:
    """Convert."""
    from ba_node.io.bal import read_bal  # noqa: PLC0415
    from ba_node.offline.bal_timeline import timeline  # noqa: PLC0415
    from ba_node.offline.recording import record  # noqa: PLC0415

    require_mcap(args.target)
    bal = read_bal(args.source)
    count = record(args.target, timeline(bal))
    print(
        f"{args.target}: {count} messages; {len(bal.cameras)} keyframes, {len(bal.points)} points,"
        f" {len(bal.observations)} observations"
    )
    return 0
