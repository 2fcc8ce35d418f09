# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Start the node as a process of its own, play a recording into it over DDS from another, and evaluate what comes back.

The node runs in a ROS domain that nobody else uses, on this machine only. Writes into DIR: trajectory.tum,
trajectory_input.tum, ground_truth.tum, points.ply, trajectory.png, and the logs node.log and play.log.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ba_node.cli import interrupts
from ba_node.cli.console import facts, table, write_result
from ba_node.io.files import locked_folder

if TYPE_CHECKING:
    from experiments.demo.demo import Outcome

EXAMPLE = "ba demo --out out/demo"
_SHIPPED = Path(__file__).resolve().parents[2] / "bags" / "stereo_loop.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: out/demo")
    words = "a recording with ground truth (default: the one that is shipped)"
    parser.add_argument("--bag", type=Path, default=_SHIPPED, metavar="BAG.mcap", help=words)


def run(args: argparse.Namespace) -> int:
    """Run the demo."""
    from experiments.demo.demo import run as run_demo  # noqa: PLC0415
    from experiments.demo.demo import stop_processes, write  # noqa: PLC0415

    interrupts.at_interrupt(stop_processes)
    with locked_folder(args.out):
        outcome = run_demo(args.bag, args.out, lambda text: print(text, flush=True))
        errors = write(outcome, args.out)
    rows = []
    for kind, unit in (("translation", "m"), ("rotation", "deg")):
        for name, error in errors.items():
            statistics = getattr(error, kind)
            shown = (statistics.rmse, statistics.median, statistics.max)
            rows.append([f"{kind} {name} [{unit}]", *(f"{x:.4f}" for x in shown)])
    print(f"\n{table(['error to ground truth', 'rmse', 'median', 'max'], rows)}\n")
    print(facts(_rows(outcome)))
    write_result(
        args.json,
        {
            "error_m": {name: vars(error.translation) for name, error in errors.items()},
            "error_deg": {name: vars(error.rotation) for name, error in errors.items()},
            "facts": dict(_rows(outcome)),
        },
    )
    print(f"written to {args.out}: trajectory.png, trajectory.tum, points.ply, ...")
    return 0


def _rows(outcome: Outcome) -> list[tuple[str, str]]:
    last = outcome.reports[-1]
    times_ms = 1e3 * np.array([report.solve_time_s for report in outcome.reports])
    waits_ms = 1e3 * np.array([report.queue_wait_s for report in outcome.reports])
    rejected = [f"{n} {reason}" for reason, n in zip(last.rejected_reason, last.rejected_count, strict=True)]
    return [
        ("keyframes", f"{len(outcome.after)} of {len(outcome.before)} came back refined"),
        ("points", str(len(outcome.cloud))),
        ("solves", f"{len(times_ms)}, median {np.median(times_ms):.0f} ms, slowest {times_ms.max():.0f} ms"),
        ("wait before a solve", f"median {np.median(waits_ms):.0f} ms, longest {waits_ms.max():.0f} ms"),
        ("dropped", f"{last.dropped} messages; {last.coalesced} keyframes solved together with the next"),
        ("rejected", ", ".join(rejected) or "nothing"),
        ("outliers", f"{last.outliers} of {last.outliers + last.observations} observations in the last window"),
        ("time", f"{outcome.duration_s:.1f} s"),
    ]
