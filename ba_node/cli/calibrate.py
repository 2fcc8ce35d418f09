# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine the cameras of a recording from its tracks: intrinsics, places on the body, offsets of their clocks.

Replays the recording, refines cameras beside all poses and points, and writes the rig as YAML with standard deviations.
Only what the tracks tell moves; the rest is said. The place of the first camera on the body is never told by tracks.
See docs/calibration.md.

Exit code: 0 refined, 2 nothing was written, 3 written, but nothing of what was asked for is told by the recording.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli import console

EXAMPLE = "ba calibrate bags/stereo_loop.mcap --out out/rig.yaml --refine intrinsics extrinsics"
NOTHING_TOLD = 3
_PARTS = ("intrinsics", "extrinsics", "time_offset")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", type=Path, nargs="+", metavar="RECORDING", help="recording, as of ba replay")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="YAML file for the rig")
    parser.add_argument(
        "--refine",
        nargs="+",
        choices=_PARTS,
        default=["intrinsics", "extrinsics"],
        help="what to refine (default: intrinsics extrinsics)",
    )
    console.add_topic_options(parser)
    console.add_parameter_options(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate."""
    from ba_node.offline.calibrate import calibrate_recording, write_rig  # noqa: PLC0415

    wanted = {f"calibration.{part}": "refined" if part in args.refine else "fixed" for part in _PARTS}
    config = console.parameters(args).with_values(wanted)
    with console.progress_bar("calibrate", "messages") as progress:
        refined = calibrate_recording(args.bag, config, console.topic_choice(args), progress)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_rig(args.out, refined)
    rows = [("keyframes", str(refined.keyframes)), ("rms without outliers", f"{refined.rms_px[-1]:.3f} px")]
    print(console.facts([*rows, *((f"camera {i}", text) for i, text in enumerate(refined.found.lines()))]))
    print(f"written to {args.out}")
    found = {"keyframes": refined.keyframes, "rms_px": refined.rms_px, "parameters": refined.found.as_dicts()}
    console.write_result(args.json, found)
    return 0 if any(one.told for one in refined.found.parameters) else NOTHING_TOLD
