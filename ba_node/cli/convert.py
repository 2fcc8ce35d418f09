# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Convert recordings, maps, reconstructions and trajectories between formats, both ways.

  in:   recording (.mcap, .db3, folder), map (.npz), COLMAP model (folder, text or binary), Bundler (.out), BAL (.txt,
        .bz2, .gz); poses as TUM, KITTI, EuRoC (.csv), g2o
  out:  recording (.mcap), COLMAP model (folder), Bundler (.out), BAL (.txt, .bz2, .gz), points (.ply); poses as TUM
        (.tum), KITTI (.kitti), g2o (.g2o)

A recording comes out as the back-end refines it with its defaults, as in `ba replay`. A recording that is made has each
image as a keyframe, 0.1 s apart, its points as landmark guesses and its ids as the indices in the file; pixels are
float32 in the messages. Pixels of COLMAP count from the corner of the image, those here from the middle of the first
pixel: half a pixel is added and taken away.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import add_topic_options, require_folder, require_mcap, topic_choice

SUMMARY = "convert between recordings, COLMAP, Bundler, BAL, TUM, KITTI, g2o, PLY"
EXAMPLE = (
    "ba convert sparse/0 scene.mcap\n  ba convert bags/stereo_loop.mcap model/\n"
    "  ba convert problem-49-7776-pre.txt ladybug.mcap\n  ba convert out/trajectory.tum poses.txt --to kitti"
)
_FORMATS = ("mcap", "colmap", "colmap-text", "bundler", "bal", "tum", "kitti", "g2o", "ply")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", type=Path, metavar="IN")
    parser.add_argument("target", type=Path, metavar="OUT")
    parser.add_argument("--to", choices=_FORMATS, help="format of OUT, where its name does not tell it")
    add_topic_options(parser)


def run(args: argparse.Namespace) -> int:
    """Convert."""
    from ba_node.offline import convert  # noqa: PLC0415

    form = convert.format_of(args.target, args.to)
    require_folder(args.target)
    if form == "mcap":
        require_mcap(args.target)
    what = convert.read(args.source, topic_choice(args))
    left_out = convert.write(args.target, what, form)
    print(f"{args.target}: {convert.counts(what)}{f', without {left_out}' if left_out else ''}")
    return 0
