# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Publish a recording on live topics, where `ros2 bag play` is not at hand. Needs ROS 2.

Play begins when the node listens, and ends when everything has been acknowledged.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

from ba_node.cli import interrupts
from ba_node.cli.console import counted, progress_bar, write_result

EXAMPLE = (
    "ba play bags/stereo_loop.mcap --rate 2 --remap keyframes:=front/keyframes\n"
    "  ba play bags/mono_loop.mcap --clock --start 3 --loop"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", type=Path, metavar="BAG.mcap")
    parser.add_argument(
        "--rate", type=float, default=1.0, metavar="R", help="times real time; 0: as fast as it goes (default: 1)"
    )
    parser.add_argument(
        "--wait", type=float, default=10.0, metavar="S", help="how long to wait for subscribers, s (default: 10)"
    )
    parser.add_argument(
        "--start", type=float, default=0.0, metavar="S", help="begin so many seconds into the recording (default: 0)"
    )
    parser.add_argument("--loop", action="store_true", help="play again and again, until interrupted")
    parser.add_argument(
        "--clock",
        type=float,
        nargs="?",
        const=100.0,
        default=0.0,
        metavar="HZ",
        help="publish the time of the recording on /clock, for nodes with use_sim_time (HZ: 100)",
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="play only these")
    parser.add_argument("--namespace", default="", metavar="NS", help="put in front of every topic")
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="FROM:=TO",
        help="publish a topic under another name; repeatable",
    )


def run(args: argparse.Namespace) -> int:
    """Play."""
    from ba_node.ros.tools.play import Listener, PlayOptions, play, take_leave  # noqa: PLC0415

    remaps = [word for remap in args.remap for word in ("-r", remap)]
    options = PlayOptions(
        rate=args.rate,
        wait_s=args.wait,
        start_s=args.start,
        rounds=0 if args.loop else 1,
        clock_hz=args.clock,
        namespace=args.namespace,
        topics=args.topics,
        ros_args=("--ros-args", *remaps) if remaps else (),
    )
    interrupts.at_interrupt(take_leave)
    with progress_bar("play", "messages") as progress:
        summary = play(args.bag, options, Listener(progress, lambda text: print(f"ba: {text}", file=sys.stderr)))
    for topic, count in summary.published.items():
        print(f"{topic}: {counted(count, 'message')}")
    write_result(args.json, dataclasses.asdict(summary))
    print(f"played in {summary.duration_s:.1f} s")
    return 0 if not summary.unconfirmed else 1
