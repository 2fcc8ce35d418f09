# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare a trajectory with a reference, pose by pose with the nearest stamp. Both are in the TUM format."""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import require_folder, table

SUMMARY = "compare a trajectory with a reference"
EXAMPLE = "ba evaluate out/trajectory.tum ground_truth.tum --align se3"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("estimate", type=Path, metavar="ESTIMATE.tum")
    parser.add_argument("reference", type=Path, metavar="REFERENCE.tum")
    parser.add_argument(
        "--align",
        choices=("none", "se3", "sim3"),
        default="se3",
        help="what is fitted before comparing: nothing, rotation and translation, or scale too (default: se3)",
    )
    parser.add_argument(
        "--max-difference",
        type=float,
        default=0.01,
        metavar="S",
        help="largest difference of the stamps of a pair, s (default: 0.01)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the errors as JSON too")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw both trajectories and the error over time")


def run(args: argparse.Namespace) -> int:
    """Print the errors."""
    from ba_node.evaluation.metrics import absolute_error  # noqa: PLC0415
    from ba_node.io.files import whole_file, write_json  # noqa: PLC0415
    from ba_node.io.trajectory import read_tum  # noqa: PLC0415

    require_folder(args.json)
    require_folder(args.plot)
    estimate, reference = (read_tum(path) for path in (args.estimate, args.reference))
    error = absolute_error(estimate, reference, args.align, args.max_difference)
    rows = []
    for name, unit, of in (("translation", "m", error.translation), ("rotation", "deg", error.rotation)):
        shown = (of.rmse, of.mean, of.median, of.max, of.std)
        rows.append([f"{name} [{unit}]", *(f"{value:.6f}" for value in shown)])
    print(f"{len(error.stamp_ns)} of {len(estimate)} poses have a partner; alignment {args.align}")
    print(table(["", "rmse", "mean", "median", "max", "std"], rows))
    if args.align == "sim3":
        print(f"scale {error.alignment.scale:.9f}")
    if args.json:
        write_json(
            args.json,
            {
                "align": args.align,
                "scale": error.alignment.scale,
                "translation_m": error.translation.as_dict(),
                "rotation_deg": error.rotation.as_dict(),
            },
        )
    if args.plot:
        import numpy as np  # noqa: PLC0415

        from ba_node.evaluation.plot import Comparison, draw  # noqa: PLC0415

        by_time = [poses[np.argsort(poses.stamp_ns, kind="stable")] for poses in (estimate, reference)]
        with whole_file(args.plot) as stream:
            draw(stream, Comparison(None, by_time[0], by_time[1], np.empty((0, 3)), args.align))
    return 0
