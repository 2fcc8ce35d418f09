# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Test rig, poses, depths and intrinsics of a recording against its tracks.

Prints how well the usual mistakes explain the tracks, the likely one, and what to change. Changes nothing.

Exit code: 0 the set-up fits the tracks, 2 the recording cannot be read or has too little to tell, 3 a mistake is
likely.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from ba_node.cli.console import add_parameter_options, parameters, require_folder, table

if TYPE_CHECKING:
    from ba_node.check.diagnosis import Diagnosis, Row

SUMMARY = "test calibration and conventions of a recording against its tracks"
EXAMPLE = "ba check bags/stereo_loop.mcap"
TOO_LITTLE, MISTAKE = 2, 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", type=Path, metavar="RECORDING")
    add_parameter_options(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all of it as JSON")


def run(args: argparse.Namespace) -> int:
    """Check."""
    from ba_node.io.json_file import write_json  # noqa: PLC0415
    from ba_node.offline.check import check_recording  # noqa: PLC0415

    require_folder(args.json)
    config = parameters(args)
    sessions = check_recording(args.bag, config)
    for session, found in sessions:
        if len(sessions) > 1:
            print(f"session {session}")
        _print(found)
    if args.json is not None:
        write_json(args.json, {"sessions": [{"session_id": key, **found.as_dict()} for key, found in sessions]})
    if any(found.findings for _, found in sessions):
        return MISTAKE
    return 0 if any(found.sound for _, found in sessions) else TOO_LITTLE


def _print(found: Diagnosis) -> None:
    if found.rows:
        print(table(("test", "hypothesis", "tracks that meet", "rotation off", "direction off"), _rows(found.rows)))
    for finding in found.findings:
        print(f"likely mistake: {'; or '.join(finding.causes)}")
        print(f"  why: {finding.evidence}")
        print(f"  change: {'; or '.join(finding.changes)}")
    if not found.findings:
        print(found.summary())


def _rows(rows: list[Row]) -> list[tuple[str, ...]]:
    def degrees(value: float) -> str:
        return "" if math.isnan(value) else f"{value:.2f} deg"

    return [
        (row.test, row.hypothesis, f"{row.share:.0%}", degrees(row.rotation_deg), degrees(row.direction_deg))
        for row in rows
    ]
