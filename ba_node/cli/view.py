# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Show recordings, or folders of results of `ba replay`, in Foxglove or Rerun.

Foxglove: a server on this machine sends the messages with their own definitions, in a loop. Open the link that is
printed in a browser or in the app, and import config/foxglove_layout.json once. Rerun (pip install rerun-sdk) opens the
files by itself.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import urllib.parse
from pathlib import Path

from ba_node.cli.console import counted, write_result

EXAMPLE = "ba view bags/stereo_loop.mcap out --rate 4\n  ba view out --rerun"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("paths", type=Path, nargs="+", metavar="PATH", help="recording, or folder of ba replay")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine alone)")
    parser.add_argument("--port", type=int, default=8765, help="0 for any that is free (default: 8765)")
    parser.add_argument(
        "--rate", type=float, default=1.0, metavar="R", help="times real time; 0: as fast as it goes (default: 1)"
    )
    parser.add_argument("--rounds", type=int, default=0, metavar="N", help="how often (default: until interrupted)")
    parser.add_argument("--rerun", action="store_true", help="open the files in Rerun instead")


def run(args: argparse.Namespace) -> int:
    """Show."""
    from ba_node.offline.view import REFINED, ViewError, ViewOptions, view  # noqa: PLC0415

    if args.rate < 0.0 or args.rounds < 0:
        raise ViewError(f"--rate {args.rate:g}, --rounds {args.rounds}: expected 0 or more")
    if args.rerun:
        program = shutil.which("rerun")
        if program is None:
            raise ViewError("rerun is not installed: pip install rerun-sdk, or leave out --rerun")
        files = [path / REFINED if path.is_dir() else path for path in args.paths]
        return subprocess.run([program, *map(str, files)], check=False).returncode
    count = view(args.paths, ViewOptions(args.host, args.port, args.rate, args.rounds), _tell)
    print(f"{counted(count, 'message')} sent")
    write_result(args.json, {"messages": count})
    return 0


def _tell(address: str) -> None:
    link = urllib.parse.urlencode({"ds": "foxglove-websocket", "ds.url": address})
    print(f"serving {address}; open https://app.foxglove.dev/~/view?{link}", flush=True)
