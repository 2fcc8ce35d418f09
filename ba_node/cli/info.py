# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tell what is in a recording: topics, types, counts, gaps, and what a replay would use of it or refuse, and why.

Exit code: 0 a replay would use it, 2 it cannot be read, 3 a replay would refuse it, or something has to be looked at.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ba_node.cli import console

if TYPE_CHECKING:
    from ba_node.offline.bag_tools import RecordingFacts

EXAMPLE = "ba info bags/stereo_loop.mcap"
ATTENTION = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", type=Path, nargs="+", metavar="RECORDING", help="a file, a folder, or all files of one")
    console.add_topic_options(parser)


def run(args: argparse.Namespace) -> int:
    """Tell."""
    from ba_node.offline.bag_tools import examine  # noqa: PLC0415

    with console.progress_bar("info", "messages") as progress:
        found = examine(args.bag, console.topic_choice(args), progress)
    _print(found)
    for line in found.attention:
        print(f"ba: warning: {line}", file=sys.stderr)
    console.write_result(args.json, found.as_dict())
    return ATTENTION if found.refusal or found.attention else 0


def _print(found: RecordingFacts) -> None:
    duration = (found.end_ns - found.start_ns) * 1e-9
    count, size = (sum(values) for values in zip(*((of.count, of.bytes) for of in found.topics.values()), strict=True))
    print(f"{found.path}: {duration:.2f} s, {console.counted(count, 'message')}, {size / 1e6:.1f} MB")
    if found.refusal:
        print(f"a replay would refuse it: {found.refusal}\n")
    else:
        used = found.inputs
        sessions, cameras = (console.counted(used[f"{thing}s"], thing) for thing in ("session", "camera"))
        rows = [
            ("a replay uses", ", ".join(found.taken.values())),
            *(("left aside", f"{topic}: {reason}") for topic, reason in found.left.items()),
            ("keyframes", f"{used['keyframes']} in {sessions}, {cameras}"),
            ("tracks", f"{used['tracks']}, {used['tracks_seen_once']} of them seen once"),
            ("median", f"{used['images_per_track']:g} images a track, {used['tracks_per_image']:g} tracks an image"),
            *(("pauses", used["pauses"]) for _ in range(bool(used["pauses"]))),
            ("observations", f"{used['observations']}, {used['depths']} with depth; {used['guesses']} guesses"),
        ]
        print(console.facts(rows), end="\n\n")
    cells = []
    for topic, of in sorted(found.topics.items()):
        span = (of.last_ns - of.first_ns) * 1e-9
        rate = f"{(of.count - 1) / span:.1f}" if span > 0.0 else ""
        gap = f"{of.gap_s:.2f} at {of.gap_at_s:.1f}" if of.gap_s > 0.0 else ""
        cells.append((topic, of.type_name, str(of.count), rate, gap))
    print(console.table(("topic", "type", "messages", "Hz", "longest pause [s]"), cells))
