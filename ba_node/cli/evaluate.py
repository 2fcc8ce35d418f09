# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare a trajectory with a reference, pose by pose with the nearest stamp.

Either may be a TUM or KITTI file, EuRoC's CSV, or a recording with a topic of poses. Prints absolute errors (ATE) and
relative ones (RPE) over an interval, in frames or in metres of the way. KITTI has no stamps: such a file is
compared in its order, and needs as many poses as the other.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli.console import require_folder, table, write_result

EXAMPLE = "ba evaluate out/trajectory.tum ground_truth.tum --align se3 --interval 1 --unit m"

_HEAD = ("rmse", "mean", "median", "min", "max", "std", "sse", "count")
_FIGURES = _HEAD[:6]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "estimate", type=Path, metavar="ESTIMATE", help="trajectory: .tum, KITTI, EuRoC .csv, recording"
    )
    parser.add_argument("reference", type=Path, metavar="REFERENCE", help="the same, to compare with")
    parser.add_argument(
        "--align",
        choices=("none", "se3", "sim3"),
        default="se3",
        help="what is fitted before comparing: nothing, rotation and translation, or scale too (default: se3)",
    )
    parser.add_argument("--interval", type=float, default=1.0, metavar="N", help="of the relative error (default: 1)")
    parser.add_argument(
        "--unit", choices=("frames", "m"), default="frames", help="of the interval: frames (default) or m of the way"
    )
    parser.add_argument("--all-pairs", action="store_true", help="begin an interval at every pose, not end to end")
    parser.add_argument(
        "--max-difference",
        type=float,
        default=0.01,
        metavar="S",
        help="largest difference of the stamps of a pair, s (default: 0.01)",
    )
    parser.add_argument("--reference-topic", default="", metavar="TOPIC", help="topic of poses in a recording")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the errors as CSV too")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw both trajectories and the error over time")


def run(args: argparse.Namespace) -> int:
    """Print the errors."""
    from ba_node.evaluation import relative  # noqa: PLC0415
    from ba_node.evaluation.metrics import absolute_error_of, pair  # noqa: PLC0415
    from ba_node.io.files import write_csv  # noqa: PLC0415
    from ba_node.io.reference import read_pair  # noqa: PLC0415

    for path in (args.csv, args.plot):
        require_folder(path)
    estimate, reference = read_pair(args.estimate, args.reference, args.reference_topic)
    paired = pair(estimate, reference, args.align, args.max_difference)
    interval = relative.Interval(args.interval, args.unit, args.all_pairs)
    absolute = absolute_error_of(paired)
    found = {"translation_m": vars(absolute.translation), "rotation_deg": vars(absolute.rotation)}
    over = ""
    if len(paired.stamp_ns) > 1:
        moved = relative.relative_error(paired, interval)
        found["relative_translation_m"] = vars(moved.translation)
        found["relative_rotation_deg"] = vars(moved.rotation)
        over = f"{interval}, {len(moved.pairs)} pairs"
    print(f"{len(paired.stamp_ns)} of {len(estimate)} poses have a partner; alignment {args.align}")
    print(_table(found, over))
    if args.align == "sim3":
        print(f"scale {paired.alignment.scale:.9f}")
    about = {"align": args.align, "scale": paired.alignment.scale, "interval": args.interval, "unit": args.unit}
    write_result(args.json, about | found)
    if args.csv:
        write_csv(args.csv, [("error", *_HEAD), *((name, *(of[key] for key in _HEAD)) for name, of in found.items())])
    if args.plot:
        import numpy as np  # noqa: PLC0415

        from ba_node.offline.pictures import draw_trajectory  # noqa: PLC0415
        from ba_node.offline.run_folder import Comparison  # noqa: PLC0415

        ours, theirs = (poses[np.argsort(poses.stamp_ns, kind="stable")] for poses in (estimate, reference))
        draw_trajectory(args.plot, Comparison("estimate", None, ours, theirs, np.empty((0, 3)), args.align))
    return 0


def _table(found: dict[str, dict[str, float | int]], over: str) -> str:
    names = ("translation [m]", "rotation [deg]", f"translation [m] over {over}", f"rotation [deg] over {over}")
    rows = [[name, *(f"{of[key]:.6f}" for key in _FIGURES)] for name, of in zip(names, found.values(), strict=False)]
    return table(["", *_FIGURES], rows)
