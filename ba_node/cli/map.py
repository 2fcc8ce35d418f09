# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Look into a map that ~/save_map or `ba replay --save-map` wrote, or write its poses and points for other tools.

The format is described in docs/map_format.md; numpy alone reads it as well.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import TargetError, facts, require_folder, write_result

EXAMPLE = "ba map export site.npz --tum poses.tum --ply points.ply"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("what", choices=("info", "export"), help="tell what is in it, or write it as other files")
    parser.add_argument("map", type=Path, metavar="FILE")
    parser.add_argument("--tum", type=Path, metavar="FILE", help="export: poses, in the format of TUM")
    parser.add_argument("--ply", type=Path, metavar="FILE", help="export: points, as binary PLY")


def run(args: argparse.Namespace) -> int:
    """Tell or export."""
    from ba_node.io.ply import write_ply  # noqa: PLC0415
    from ba_node.io.trajectory import write_tum  # noqa: PLC0415
    from ba_node.offline import saved_map  # noqa: PLC0415

    if (args.what == "export") != bool(args.tum or args.ply):
        raise TargetError("export writes what --tum and --ply name, info writes nothing: name one, or leave both out")
    for path in (args.tum, args.ply):
        require_folder(path)
    backend = saved_map.open_map(args.map)
    estimate = backend.estimate()
    known = saved_map.facts(backend)
    write_result(args.json, dict(known))
    if args.what == "info":
        print(facts(known))
    if args.tum:
        write_tum(args.tum, estimate.trajectory)
        print(f"{args.tum}: {len(estimate.trajectory)} poses")
    if args.ply:
        write_ply(args.ply, estimate.cloud, estimate.frame_id)
        print(f"{args.ply}: {len(estimate.cloud)} points")
    return 0
