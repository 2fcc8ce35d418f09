# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Record the inputs of the node from live topics, where `ros2 bag record` is not at hand. Needs ROS 2.

Topics are found by their types: keyframes, tracks, guesses, cameras, and /tf_static. Ctrl-C ends the recording.
"""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from ba_node.cli.console import TargetError, counted, require_mcap, write_result

EXAMPLE = "ba record --out drive.mcap --namespace /robot1 --topics /robot1/ground_truth/pose"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", type=Path, required=True, metavar="OUT.mcap", help="must not be there yet")
    parser.add_argument("--namespace", default="", metavar="NS", help="only topics of this namespace, e.g. /robot1")
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC", help="these too, whatever their type")
    parser.add_argument(
        "--duration", type=float, default=0.0, metavar="S", help="end after so long (default: when interrupted)"
    )


def run(args: argparse.Namespace) -> int:
    """Record."""
    from ba_node.ros.tools.record import Recorder, RecordOptions  # noqa: PLC0415

    require_mcap(args.out)
    if args.out.exists():
        raise TargetError(f"{args.out}: File exists: what was recorded is not written over, give another name")
    options = RecordOptions(args.namespace, args.topics, args.duration)
    recorder = Recorder(args.out, options, lambda text: print(f"ba: {text}", file=sys.stderr, flush=True))
    # An interrupt is how a recording ends: nothing of it is to be thrown away.
    before = {number: signal.signal(number, recorder.stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        seconds = recorder.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for topic, count in sorted(recorder.counts.items()):
        print(f"{topic}: {counted(count, 'message')}")
    print(f"{args.out}: {counted(sum(recorder.counts.values()), 'message')} in {seconds:.1f} s")
    write_result(args.json, {"messages": dict(recorder.counts), "duration_s": seconds})
    return 0
