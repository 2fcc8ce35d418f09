# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make a recording with ground truth: a stereo or mono camera on a path around and through structure.

The front-end's poses drift, its pixels are noisy and some are wrong, as the options say. The true poses are in the
recording on ground_truth/pose. The same options give the same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import require_mcap

SUMMARY = "make a recording with ground truth"
EXAMPLE = "ba synth loop.mcap --seed 3 --keyframes 100 --outlier-share 0.1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options: one for each field of SyntheticOptions."""
    from ba_node.synthetic import declarations  # noqa: PLC0415

    parser.add_argument("target", type=Path, metavar="OUT.mcap")
    for option in declarations():
        flag = f"--{option.name.replace('_', '-')}"
        unit = f", {option.unit}" if option.unit else ""
        text = f"{option.doc} (default: {option.default}{unit})".replace("%", "%%")
        if option.kind is bool:
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=option.default, help=text)
        else:
            parser.add_argument(
                flag,
                type=option.kind,
                default=option.default,
                choices=option.choices or None,
                metavar=None if option.choices else option.kind.__name__.upper(),
                help=text,
            )


def run(args: argparse.Namespace) -> int:
    """Generate."""
    from ba_node.offline.recording import record  # noqa: PLC0415
    from ba_node.synthetic import SyntheticOptions, declarations, generate  # noqa: PLC0415

    require_mcap(args.target)
    data = generate(SyntheticOptions(**{option.name: getattr(args, option.name) for option in declarations()}))
    count = record(args.target, data.timeline(), data.truth)
    observations = sum(len(image.track_id) for images in data.tracks for image in images)
    print(
        f"{args.target}: {count} messages; {len(data.keyframes)} keyframes, {len(data.track_id)} tracks,"
        f" {observations} observations"
    )
    return 0
