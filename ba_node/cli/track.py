# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Track the images of a recording or of a folder; write keyframes, feature tracks and cameras for ba replay.

SOURCE is a recording (MCAP, rosbag2) with sensor_msgs/Image or CompressedImage and CameraInfo, or a folder: pictures of
one camera, or left/ and right/, rgb/ and depth/, image_0/ and image_1/ (KITTI), cam0/ and cam1/ (EuRoC) below it, with
rig.yaml (ba rig), calib.txt or sensor.yaml, and times.txt if the names of the pictures are no stamps. Two cameras are
stereo, rectified or raw; colour with depth is RGB-D; one camera takes its scale from --odometry, or has one of its own.

Exit code: 0 all is well, 2 nothing was written, 3 written, but something has to be looked at: images that were left
out, tracking that was lost, cameras that are not as the rig says. Each has a line of its own.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ba_node.cli.console import TargetError, counted, facts, progress_bar, require_mcap, write_result

if TYPE_CHECKING:
    from ba_node.config.front_end import FrontEndOptions
    from ba_node.offline.track import TrackRequest

EXAMPLE = "ba track drive.mcap tracks.mcap\n  ba track kitti/sequences/07 tracks.mcap --track max_features=500"
ATTENTION = 3
# What is said and is no fault.
_HARMLESS = ("one camera without odometry", "the recording has /", "the second camera is turned")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", type=Path, metavar="SOURCE")
    parser.add_argument("out", type=Path, metavar="OUT.mcap")
    add_track_options(parser)


def add_track_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of commands that track images."""
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="NAME=TOPIC",
        help="which images are meant: left, right, rgb, depth, image; odometry=TOPIC of nav_msgs/Odometry, or"
        " odometry=/tf:FRAME of transforms from a fixed frame (odom); repeatable",
    )
    parser.add_argument("--rig", type=Path, nargs="+", metavar="YAML", help="cameras, in any form that ba rig reads")
    parser.add_argument("--rectified", action="store_true", help="images are rectified: take p of camera_info, no d")
    parser.add_argument(
        "--base", default="", metavar="FRAME", help="body frame in /tf_static; the first camera if none"
    )
    parser.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="of pictures without stamps (10)")
    parser.add_argument("--mask", type=Path, metavar="PNG", help="black where nothing is to be looked at")
    parser.add_argument(
        "--odometry", type=Path, metavar="TUM", help="poses of the body, a line each: t x y z qx qy qz qw"
    )
    parser.add_argument(
        "--track", action="append", default=[], metavar="NAME=VALUE", help="set an option of the tracker; repeatable"
    )


def run(args: argparse.Namespace) -> int:
    """Track."""
    from ba_node.offline.track import track  # noqa: PLC0415

    require_mcap(args.out)
    with progress_bar("track", "images") as progress:
        report = track(args.source, args.out, request(args), time.process_time, progress)
    tell(report)
    warn(report)
    print(f"written to {args.out}")
    write_result(args.json, report)
    return ATTENTION if attention(report) else 0


def request(args: argparse.Namespace) -> TrackRequest:
    """Return what the options say."""
    from ba_node.config import split_assignment  # noqa: PLC0415
    from ba_node.offline.images import ImageRequest  # noqa: PLC0415
    from ba_node.offline.rig import load_rig  # noqa: PLC0415
    from ba_node.offline.track import TrackRequest  # noqa: PLC0415

    if not 0.0 < args.rate < 1e6:
        raise TargetError(f"--rate {args.rate:g}: expected images a second, more than 0")
    rig = load_rig(args.rig, rectified=args.rectified, base=args.base) if args.rig else None
    topics = dict(split_assignment(text, "left=/camera/left/image_raw") for text in args.topic)
    images = ImageRequest(rig, topics, args.rectified, args.base, args.rate)
    return TrackRequest(images, _options(args.track), args.mask, args.odometry)


def _options(assignments: list[str]) -> FrontEndOptions:
    from ba_node.config import ConfigError, declared, split_assignment, unknown  # noqa: PLC0415
    from ba_node.config.front_end import FrontEndOptions  # noqa: PLC0415

    known = {parameter.name: parameter for parameter in declared(FrontEndOptions)}
    values: dict[str, Any] = {}
    for text in assignments:
        name, value = split_assignment(text, "max_features=500")
        if name not in known:
            raise ConfigError(unknown(name, known))
        values[name] = known[name].read(value)
    return FrontEndOptions(**values)


def attention(report: Mapping[str, Any]) -> list[str]:
    """Return what has to be looked at."""
    return [note for note in report["notes"] if not note.startswith(_HARMLESS)]


def tell(report: Mapping[str, Any]) -> None:
    """Print what came of the images."""
    turn = report["stereo_turn_px"]
    rows = [
        ("images", f"{report['images']}, {report['mode']}, {1e3 * report['time_per_image_s']:.1f} ms each"),
        ("keyframes", f"{report['keyframes']} in {counted(report['sessions'], 'session')}"),
        ("tracks", f"{report['tracks']} with {report['observations']} observations"),
        ("scale of", report["scale_from"]),
    ]
    if report["stood_images"]:
        rows.append(
            ("stood still", f"in {report['stood_images']} of {report['images']} images, {report['stood_s']:.1f} s")
        )
    if turn is not None and any(turn[:2]):
        yaw, roll = f"{turn[0]:.2f} +- {turn[2]:.2f} px of yaw", f"{turn[1]:.2f} +- {turn[3]:.2f} of roll"
        rows.append(("second camera", f"turned by {yaw}, {roll} against the rig; corrected"))
    rows += [("note", note) for note in report["notes"] if note.startswith(_HARMLESS)]
    print(facts(rows))


def warn(report: Mapping[str, Any], of: str = "") -> None:
    """Say what has to be looked at, a line each."""
    for note in attention(report):
        print(f"ba: warning: {of}{note}", file=sys.stderr)
