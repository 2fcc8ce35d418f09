# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Test rig, poses, depths and intrinsics of a recording against its tracks.

Prints how well the usual mistakes explain the tracks, the likely one, and what to change. Changes nothing. In the table
stand the share of the tracks that agree with a hypothesis, and by how much it is off what the tracks say by themselves.

Exit code: 0 the set-up fits the tracks, 2 the recording cannot be read or has too little to tell, 3 a mistake is
likely, or something else is to be looked at: stamps that jump, messages that were turned away, files that are missing.
Of several recordings a table says what each gives; the code is the highest of any but one that cannot be read, which is
named: 3.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ba_node.cli import console

if TYPE_CHECKING:
    from ba_node.backend import Diagnosis, Row
    from ba_node.config import Config

EXAMPLE = "ba check bags/stereo_loop.mcap"
TOO_LITTLE, MISTAKE = 2, 3

# Columns of the text, and of the hypotheses in the table.
_WIDTH, _HYPOTHESIS = 100, 52
_HEAD = ("tracks agree", "rotation off", "direction off")
_SHOWN = {"free": "best fit to the tracks, whatever is given"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "bag", type=console.place, nargs="+", metavar="RECORDING", help="a file, a folder, or a URL; repeatable"
    )
    console.add_fleet_options(parser)
    console.add_parameter_options(parser)


def run(args: argparse.Namespace) -> int:
    """Check."""
    from ba_node.offline.check import check_recording  # noqa: PLC0415

    config = console.parameters(args)
    if len(args.bag) > 1 or args.scheduler or "://" in args.bag[0]:
        return _check_all(args, config)
    checked = check_recording(Path(args.bag[0]), config)
    sessions = checked.sessions
    for text in checked.warnings:
        print(f"ba: warning: {text}", file=sys.stderr)
    for number, session in enumerate(sessions, start=1):
        if len(sessions) > 1:
            first, last = (stamp_ns * 1e-9 for stamp_ns in session.stamps_ns)
            ids = f"keyframes {session.keyframe_ids[0]} to {session.keyframe_ids[1]}"
            text = f"part {number} of {len(sessions)}: session {session.session_id}, {ids}"
            print(*([""] if number > 1 else []), f"{text}, stamps {first:.3f} to {last:.3f} s", "", sep="\n")
        _print(session.found)
        sys.stdout.flush()
        for text in session.warnings:
            print(f"ba: warning: {text}", file=sys.stderr)
    console.write_result(args.json, checked.as_dict())
    if checked.all_warnings or any(session.found.findings for session in sessions):
        return MISTAKE
    return 0 if any(session.found.sound for session in sessions) else TOO_LITTLE


def _check_all(args: argparse.Namespace, config: Config) -> int:
    """Check many recordings."""
    from ba_node.io.bag_topics import TopicChoice  # noqa: PLC0415
    from ba_node.offline import batch  # noqa: PLC0415
    from ba_node.offline.fleet import Fleet, expand  # noqa: PLC0415

    tasks = [batch.ReplayTask((place,), "", config, TopicChoice()) for place in expand(args.bag)]
    with Fleet(args.jobs, args.scheduler) as fleet, console.progress_bar("check", "recordings") as progress:
        rows = batch.each(fleet, batch.check_one, tasks, progress)
    for row in rows:
        print(f"{row['recording']}: {row['state']}", *_wrapped(row["note"], _WIDTH, "    ", "    "), sep="\n")
    console.write_result(args.json, {"recordings": rows})
    if all(row["state"] == batch.FAILED for row in rows):
        return TOO_LITTLE
    return 0 if all(row["state"] == batch.OK for row in rows) else MISTAKE


def _print(found: Diagnosis) -> None:
    if found.rows:
        print(_table(found.rows), end="\n\n")
    for finding in found.findings:
        print(_entry("likely mistake", finding.causes))
        print(_entry("  why", (finding.evidence,)))
        print(_entry("  change", finding.changes))
    if found.findings:
        return
    if found.sound:
        print(_items("the set-up fits the tracks:", found.sound))
    if found.untold:
        print(_items("not told:" if found.sound else "the tracks cannot tell:", found.untold))


def _table(rows: list[Row]) -> str:
    """Return the hypotheses under the name of their test, in as many columns as a terminal usually has."""
    lines: list[tuple[str, ...]] = [("", *_HEAD)]
    for test, of_test in itertools.groupby(rows, key=lambda row: row.test):
        lines.append((test, "", "", ""))
        for row in of_test:
            *above, last = _wrapped(_SHOWN.get(row.hypothesis, row.hypothesis), _HYPOTHESIS)
            lines += [(f"  {text}", "", "", "") for text in above]
            angles = (row.rotation_deg, row.direction_deg)
            lines.append((f"  {last}", f"{row.share:.0%}", *("" if math.isnan(a) else f"{a:.2f} deg" for a in angles)))
    return console.table(lines[0], lines[1:])


def _entry(name: str, texts: Sequence[str]) -> str:
    """Return a name and texts, of which one is meant, each on lines of its own."""
    indent = " " * (len(name) - len(name.lstrip()) + 4)
    lines: list[str] = []
    for i, text in enumerate(dict.fromkeys(texts)):
        lines += _wrapped(text, _WIDTH, f"{name}: " if i == 0 else f"{indent}or ", indent)
    return "\n".join(lines)


def _items(head: str, texts: Sequence[str]) -> str:
    return "\n".join([head, *(line for text in texts for line in _wrapped(text, _WIDTH, "  - ", "    "))])


def _wrapped(text: str, width: int, first: str = "", others: str = "") -> list[str]:
    return textwrap.wrap(text, width, initial_indent=first, subsequent_indent=others, break_on_hyphens=False)
