# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make a recording of keyframes and tracks of a BAL file, or of what another front-end published (--from).

BAL: each image becomes a keyframe in file order, its points landmark guesses. Stamps are 0.1 s apart, ids are the
indices in the file; each image has a camera of its own in the rig. Pixels are float32 in the messages, so an objective
differs from that of the file in the seventh digit.

Front-ends: openvins (loop_pose, loop_feats, loop_extrinsic, loop_intrinsics), vins_fusion (keyframe_pose,
keyframe_point, extrinsic), vins_mono (feature, keyframe_pose or odometry, extrinsic), rtabmap (odom, odom_info;
without these mapData, which is rtabmap_map). Exit code 3: messages were there that could not be read.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import TargetError, require_mcap

SUMMARY = "make a recording of a BAL file, or of what another front-end published"
EXAMPLE = "ba convert problem-49-7776-pre.txt ladybug.mcap\n  ba convert openvins.mcap keyframes.mcap --from openvins"
NEEDS_A_LOOK = 3
# What no sound recording has.
_FAULTS = ("malformed", "undecodable", "inexact_id", "not_finite", "bad_camera", "unknown_camera")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from ba_node.messages.adapters import SOURCES  # noqa: PLC0415  # slow to import

    parser.add_argument("source", type=Path, metavar="IN", help="BAL file: .txt, .bz2 or .gz; or a recording")
    parser.add_argument("target", type=Path, metavar="OUT.mcap")
    parser.add_argument("--from", dest="front_end", choices=SOURCES, help="the front-end that was recorded")
    parser.add_argument("--rig", type=Path, nargs="+", metavar="FILE", help="cameras, in any form that ba rig reads")
    parser.add_argument("--tolerance", type=float, default=1e-3, metavar="S", help="stamps pair within (%(default)s)")
    parser.add_argument("--parallax", type=float, default=1.0, metavar="DEG", help="between keyframes (%(default)s)")
    parser.add_argument("--cameras", type=int, default=1, metavar="N", help="NUM_OF_CAM of vins_mono (%(default)s)")
    parser.add_argument("--topic", action="append", default=[], metavar="NAME=TOPIC", help="where one is not found")


def run(args: argparse.Namespace) -> int:
    """Convert."""
    require_mcap(args.target)
    if args.front_end:
        return _convert_front_end(args)
    from ba_node.io.bal import read_bal  # noqa: PLC0415
    from ba_node.offline.bal_timeline import timeline  # noqa: PLC0415
    from ba_node.offline.recording import record  # noqa: PLC0415

    bal = read_bal(args.source)
    count = record(args.target, timeline(bal))
    print(
        f"{args.target}: {count} messages; {len(bal.cameras)} keyframes, {len(bal.points)} points,"
        f" {len(bal.observations)} observations"
    )
    return 0


def _convert_front_end(args: argparse.Namespace) -> int:
    from ba_node.messages.adapters import AdapterOptions  # noqa: PLC0415
    from ba_node.offline.convert import convert  # noqa: PLC0415
    from ba_node.offline.rig import load_rig  # noqa: PLC0415

    topics = dict(text.split("=", 1) for text in args.topic if "=" in text)
    if len(topics) < len(args.topic):
        raise TargetError(f"--topic {' '.join(args.topic)}: expected NAME=TOPIC, each name once")
    rig = load_rig(args.rig) if args.rig else None
    options = AdapterOptions(args.tolerance, args.parallax, rig=rig)
    adapter = convert(args.source, args.target, args.front_end, options, args.cameras, topics)
    print(f"{args.target}: {adapter.summary()}")
    for note in adapter.told():
        print(f"  {note}")
    return NEEDS_A_LOOK if any(adapter.counted[reason] for reason in _FAULTS) else 0
