# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make a recording with ground truth.

A stereo or mono camera goes on a path around and through structure. The front-end's poses drift, its pixels are noisy
and some are wrong, as the options say. The true poses are in it on ground_truth/pose. The same options give the same
bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import require_mcap, write_result
from ba_node.offline.recording import record
from experiments.command_options import add_declared_options, declared_options
from experiments.synthetic import SyntheticOptions, generate

EXAMPLE = "ba synth loop.mcap --seed 3 --keyframes 100 --outlier-share 0.1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("target", type=Path, metavar="OUT.mcap")
    add_declared_options(parser, SyntheticOptions)


def run(args: argparse.Namespace) -> int:
    """Generate."""
    require_mcap(args.target)
    data = generate(SyntheticOptions(**declared_options(args, SyntheticOptions)))
    count = record(args.target, data.timeline(), data.truth)
    observations = sum(len(image.track_id) for images in data.tracks for image in images)
    made = {"messages": count, "keyframes": len(data.keyframes), "tracks": len(data.track_id)}
    write_result(args.json, made | {"observations": observations})
    print(
        f"{args.target}: {count} messages; {len(data.keyframes)} keyframes, {len(data.track_id)} tracks,"
        f" {observations} observations"
    )
    return 0
