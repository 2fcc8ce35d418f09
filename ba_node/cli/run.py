# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""From images to a map in one command: track them, check the set-up, replay with a full adjustment at the end, report.

SOURCE is what ba track reads. Into DIR go tracks.mcap (ba track) and all that ba replay writes: trajectory.tum,
points.ply, refined.mcap, report.json and report.html.

Exit code: the highest of tracking, check and replay: 0 all is well, 2 nothing was written, 3 written, but something has
to be looked at, which is said in a line of its own.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ba_node.cli import check, replay, track
from ba_node.cli.console import TargetError, add_parameter_options, progress_bar, write_result

EXAMPLE = "ba run drive.mcap --out out/drive\n  ba run kitti/sequences/07 --out out/kitti07"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", type=Path, metavar="SOURCE")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the results; made if missing"
    )
    track.add_track_options(parser)
    add_parameter_options(parser)
    parser.add_argument("--no-report", action="store_true", help="leave out the page and the picture of the results")


def run(args: argparse.Namespace) -> int:
    """Run all of it."""
    from ba_node.offline.track import track as track_images  # noqa: PLC0415

    request = track.request(args)
    if args.out.exists() and not args.out.is_dir():
        raise TargetError(f"{args.out}: is no folder: results need one, of another name")
    args.out.mkdir(parents=True, exist_ok=True)
    tracks = args.out / "tracks.mcap"
    with progress_bar("track", "images") as progress:
        report = track_images(args.source, tracks, request, time.process_time, progress)
    track.tell(report)
    codes = [track.ATTENTION if track.attention(report) else 0]
    parameters = [word for name in args.set for word in ("--set", name)]
    parameters += ["--params", str(args.params)] if args.params else []
    page = ["--no-report"] if args.no_report else []
    try:
        print("\ncheck")
        codes.append(_call(check, [str(tracks), *parameters]))
        print("\nreplay")
        codes.append(_call(replay, [str(tracks), "--out", str(args.out), "--final-optimize", *page, *parameters]))
    finally:
        # Last, as all that was said before stands on it.
        track.warn(report, "tracking: ")
    # Too little to check is no fault of what was tracked.
    codes[1] = 0 if codes[1] == check.TOO_LITTLE else codes[1]
    _keep(args.out / "report.json", report)
    by_name = dict(zip(("track", "check", "replay"), codes, strict=True))
    write_result(args.json, {"track": report, "exit_codes": by_name})
    return max(codes, key=lambda code: (code == 2, code))


def _keep(path: Path, tracked: Mapping[str, Any]) -> None:
    """Write into report.json, too, what was wrong with the images."""
    from ba_node.io.files import write_json  # noqa: PLC0415

    if path.is_file():
        told = {name: tracked[name] for name in ("mode", "images", "states", "left_out", "causes", "notes")}
        write_json(path, json.loads(path.read_text()) | {"tracking": told})


def _call(command: object, words: list[str]) -> int:
    """Run another command with its own options."""
    from ba_node.cli.console import add_json_option  # noqa: PLC0415

    parser = argparse.ArgumentParser()
    add_json_option(parser)
    command.add_arguments(parser)  # type: ignore[attr-defined]
    code: int = command.run(parser.parse_args(words))  # type: ignore[attr-defined]
    return code
