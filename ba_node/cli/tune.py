# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Search for better parameters on recordings.

What counts is the error of the trajectory where a recording has ground_truth/pose, else the residuals of tracks that
are held out of it. Of several recordings the last one is kept for validation: it takes no part in the search, decides
between the ten best trials, and shows whether what was found is better on others too. The search begins with --params
and --set; what it has found is kept in DIR/trials.log as it comes, and the same command goes on from there, with more
--trials where it was done.

Writes into DIR: tuned.yaml, ready for --params and for the node; tuning.json; index.html, a page with all trials.

    ba tune --apply /ba_node --out out/tune     # sets what was found on a running node

Exit code: 0 better parameters were found, 3 nothing better was, they are worse on the recording for validation, or a
recording could not be used, which is named and stops no other.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ba_node.cli import console

if TYPE_CHECKING:
    from ba_node.offline.study import Plan, Trial
    from ba_node.offline.tuning import Tuned

EXAMPLE = "ba tune bags/*.mcap --out out/tune --preset accuracy --trials 50 --jobs 2"
ATTENTION = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", type=console.place, nargs="*", metavar="RECORDING", help="files, folders or URLs")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--parameters",
        default="",
        metavar="A,B",
        help="parameters to tune, e.g. window.max_keyframes,tracks.outlier_px",
    )
    which.add_argument(
        "--preset", choices=("accuracy", "latency"), default="accuracy", help="those for a goal (default: accuracy)"
    )
    parser.add_argument(
        "--goal",
        choices=("accuracy", "latency"),
        help="what is lowered (default: as --preset): error, or time of a solve",
    )
    parser.add_argument("--max-latency-ms", type=float, metavar="MS", help="limit on p95 of the time of a solve")
    parser.add_argument("--validate", metavar="RECORDING", help="the one for validation (default: the last of several)")
    parser.add_argument("--trials", type=int, default=50, metavar="N", help="trials in all (default: 50)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the search (default: 1)")
    parser.add_argument("--storage", type=Path, metavar="FILE", help="where trials are kept (default: DIR/trials.log)")
    parser.add_argument("--apply", metavar="NODE", help="set the parameters found on a running node, e.g. /ba_node")
    console.add_search_options(parser)


def run(args: argparse.Namespace) -> int:
    """Tune, apply, or both."""
    code = 0
    if args.bag:
        code = _tune(args)
    elif not args.apply:
        raise console.TargetError(
            "no recording to tune on: give one, or --apply NODE with the folder of an earlier search"
        )
    if args.apply:
        from ba_node.ros.tools.set_parameters import set_parameters  # noqa: PLC0415

        for text in set_parameters(args.apply, args.out / "tuned.yaml"):
            print(text)
    return code


def _tune(args: argparse.Namespace) -> int:
    from ba_node.offline import tuning, tuning_page  # noqa: PLC0415
    from ba_node.offline.fleet import Fleet  # noqa: PLC0415

    base = console.parameters(args)
    plan = _plan(args)
    storage = args.storage or args.out / "trials.log"
    console.require_folder(args.storage)
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"tuning {len(plan.parameters)} parameters on {', '.join(place[0] for place in plan.recordings)}")
    if plan.validation is None:
        print("no recording is kept for validation: that what is found fits others too does not show", file=sys.stderr)

    def better(trial: Trial) -> None:
        tuning_page.write_parameters(args.out, base, trial.values)

    with Fleet(args.jobs, args.scheduler) as fleet, console.progress_bar("tune", "trials") as progress:
        tuned = tuning.tune(plan, base, fleet, storage, better, progress)
    names = tuning_page.write_tuned(args.out, tuned, base)
    print(console.table(tuning_page.ERRORS, tuning_page.error_rows(tuned)), end="\n\n")
    print(console.table(tuning_page.PARAMETERS, tuning_page.parameter_rows(tuned, base)))
    print(f"written to {args.out}: {names}")
    console.write_result(args.json, tuning_page.tuned_as_dict(tuned))
    return max(console.say_left_out(tuned.left_out), _verdict(tuned))


def _plan(args: argparse.Namespace) -> Plan:
    from ba_node.offline.batch import recordings  # noqa: PLC0415
    from ba_node.offline.study import Plan, TuneError  # noqa: PLC0415
    from ba_node.offline.tuning import chosen, preset  # noqa: PLC0415

    found = recordings(args.bag, each=args.each)
    validation = None
    if args.validate:
        validation = recordings([args.validate])[0]
    elif len(found) > 1:
        *found, validation = found
    if args.trials < 1:
        raise TuneError(f"--trials {args.trials}: expected 1 or more")
    if args.max_latency_ms is not None and not args.max_latency_ms > 0.0:
        raise TuneError(f"--max-latency-ms {args.max_latency_ms:g}: expected more than 0")
    return Plan(
        tuple(found),
        validation,
        chosen(args.parameters.split(",")) if args.parameters else preset(args.preset),
        args.goal or args.preset,
        args.objective,
        args.max_latency_ms,
        args.trials,
        args.seed,
        console.topic_choice(args),
    )


def _verdict(tuned: Tuned) -> int:
    """Say what somebody has to know of the result; return the exit code."""
    if not tuned.best.feasible:
        print(
            f"ba: warning: no trial kept within {tuned.plan.max_latency_ms:g} ms: tuned.yaml has the parameters of the"
            " start; raise the limit, or tune more parameters",
            file=sys.stderr,
        )
        return ATTENTION
    if not tuned.improved:
        print("ba: warning: nothing better was found: tuned.yaml has the parameters of the start", file=sys.stderr)
        return ATTENTION
    if tuned.overfitted:
        print(
            "ba: warning: over-fitted: the error on the recording for validation is larger than at the start; tune on"
            " more recordings, or fewer parameters",
            file=sys.stderr,
        )
        return ATTENTION
    return 0
