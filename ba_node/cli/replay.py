# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the back-end on a recording, without a middleware; the same recording gives the same bytes every time.

Writes into DIR: trajectory.tum, trajectory_input.tum (the front-end's), points.ply, refined.mcap (the node's output
topics), report.json, effective.yaml (all parameters), details.npz (what the report is drawn from), and
ground_truth.tum if the recording has a ground truth. report.html shows all of it, and trajectory.png the way.
Older sessions of the recording go to DIR/session_<id>/, to DIR/session_<id>_2/ where the same id began a map again.

Exit code: 0 all is well, 2 nothing was written (keyframes, tracks or cameras are missing, or none can be used), 3
written, but something has to be looked at: input that was turned away, solutions that were not taken, nothing refined
at all (empty tracks, one keyframe, all known already), stamps that jumped, a set-up that looks wrong. Each has a line
of its own on the terminal and stands under "attention" in report.json.

Several recordings are replayed each by itself, into DIR/NAME, by as many processes as --jobs says or by a Dask cluster;
results.csv, results.json and index.html in DIR hold them all. One that fails is named and stops no other: the code is 3
then, and 2 if all have failed. Files called NAME_0, NAME_1, ... are parts of one recording, unless --each is given.
Recordings and DIR may be URLs (s3://..., with wildcards), see docs/fleet.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ba_node.cli import console
from ba_node.cli.ranks import start_ranks, together
from ba_node.config import ConfigError
from ba_node.offline.attention import HARMLESS

if TYPE_CHECKING:
    from ba_node.config import Config

# Results were written, and something in them has to be looked at.
ATTENTION, NOTHING = 3, 2

EXAMPLE = "ba replay bags/stereo_loop.mcap --out out/replay --set window.max_keyframes=30"

_ERRORS = (
    ("rms, all observations", "rms_px"),
    ("median residual", "median_px"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "bag",
        type=console.place,
        nargs="+",
        metavar="BAG",
        help="recording: .mcap or .db3, a folder, files in any order, or a URL",
    )
    parser.add_argument(
        "--out", type=console.place, required=True, metavar="DIR", help="folder for the results; made if missing"
    )
    parser.add_argument("--each", action="store_true", help="every BAG is a recording by itself, whatever it is called")
    parser.add_argument(
        "--resume", action="store_true", help="of several, leave alone those whose results are there already"
    )
    console.add_fleet_options(parser)
    console.add_topic_options(parser)
    console.add_parameter_options(parser)
    parser.add_argument(
        "--load-map", type=Path, metavar="FILE", help="begin with a map; the recording goes on in its session"
    )
    parser.add_argument(
        "--final-optimize", action="store_true", help="refine all keyframes and points of the newest session at the end"
    )
    parser.add_argument(
        "--ranks", type=int, metavar="N", help="with --final-optimize: do that on N processes by MPI, see docs/scale.md"
    )
    parser.add_argument("--no-report", action="store_true", help="leave out the page and the picture of the results")
    parser.add_argument(
        "--covariance", action="store_true", help="with --final-optimize: write how precise all is to covariance.npz"
    )
    parser.add_argument(
        "--save-map", type=Path, metavar="FILE", help="write the map at the end, NAME.npz; see docs/map_format.md"
    )


def run(args: argparse.Namespace) -> int:
    """Replay."""
    from ba_node.offline.batch import recordings  # noqa: PLC0415
    from ba_node.offline.fleet import is_url  # noqa: PLC0415
    from ba_node.offline.ranks import started_as_ranks  # noqa: PLC0415

    console.require_folder(args.save_map)
    if args.ranks is not None and not args.final_optimize:
        raise ConfigError("--ranks share a solve of everything: add --final-optimize")
    if args.covariance and not args.final_optimize:
        raise ConfigError("--covariance is worked out by a solve of everything: add --final-optimize")
    config = console.parameters(args)
    if config.calibration.wanted and not args.final_optimize:
        raise ConfigError("calibration.* = refined is for a solve of everything: add --final-optimize")
    if config.calibration.wanted and args.ranks is not None:
        raise ConfigError("calibration.* = refined is worked out by one process: leave --ranks out")
    found = recordings(args.bag, each=args.each)
    if len(found) > 1 or args.scheduler or any(map(is_url, (args.bag[0], args.out))):
        return _replay_all(args, config, found)
    args.bag, args.out = list(map(Path, found[0])), Path(args.out)
    if args.ranks is not None and not started_as_ranks():
        return start_ranks(args, (0, ATTENTION, NOTHING))
    on_ranks = args.final_optimize and started_as_ranks()
    report = _on_ranks(args, config) if on_ranks else _replayed(args, config)
    if report is None:
        args.json = None  # rank 0 writes it
        return 0
    print(console.facts(_rows(report)))
    _tell(report)
    if args.no_report:
        print(f"written to {args.out}")
    else:
        from ba_node.offline.report import show  # noqa: PLC0415

        with console.progress_bar("report", "figures") as progress:
            written = show(args.out, progress)
        print(f"written to {args.out}: {written}")
    console.write_result(args.json, report)
    return ATTENTION if report["attention"] else 0


def _replayed(args: argparse.Namespace, config: Config, **more: Any) -> dict[str, Any]:
    """Replay one recording; return its report."""
    from ba_node.offline.replay import MapOptions, Watch, replay  # noqa: PLC0415

    with console.progress_bar("replay", "messages") as progress:
        wanted = args.final_optimize, args.final_optimize and args.covariance
        options = MapOptions(args.load_map, *wanted, args.save_map, console.topic_choice(args), **more)
        return replay(args.bag, args.out, config, Watch(time.perf_counter, progress), options)


def _on_ranks(args: argparse.Namespace, config: Config) -> dict[str, Any] | None:
    """Replay on rank 0, and have all ranks solve everything at the end; return the report on rank 0."""
    from ba_node.offline.ranks import world  # noqa: PLC0415
    from ba_node.offline.solve_ranks import RankSolver  # noqa: PLC0415

    communicator = world()
    solver = RankSolver(communicator)

    def part() -> dict[str, Any] | None:
        if communicator.rank:
            solver.serve()
            return None
        with solver:
            return _replayed(args, config, by=solver)

    return together(communicator, part)


def _replay_all(args: argparse.Namespace, config: Config, found: list[tuple[str, ...]]) -> int:
    """Replay many recordings."""
    from ba_node.offline import batch  # noqa: PLC0415
    from ba_node.offline.fleet import Fleet, delivered, is_url  # noqa: PLC0415

    alone = [name for name in ("load_map", "save_map", "final_optimize", "ranks") if getattr(args, name)]
    if alone:
        raise console.TargetError(f"--{alone[0].replace('_', '-')} is for one recording: give it alone, by its path")
    tasks = [
        batch.ReplayTask(
            group,
            f"{args.out}/{name}",
            config,
            console.topic_choice(args),
            not args.no_report,
            args.resume,
            time.perf_counter,
        )
        for group, name in zip(found, batch.folder_names(found), strict=True)
    ]
    with Fleet(args.jobs, args.scheduler) as fleet, console.progress_bar("replay", "recordings") as progress:
        rows = batch.each(fleet, batch.replay_one, tasks, progress)
    print(console.table(list(batch.COLUMNS.values())[:-1], [batch.cells(row)[:-1] for row in rows]))
    for row in rows:
        if row["state"] == batch.LOOK:
            print(f"ba: warning: {row['recording']}: {row['note']}", file=sys.stderr)
    failed = [row for row in rows if row["state"] == batch.FAILED]
    console.say_left_out({row["recording"]: row["note"] for row in failed})
    with delivered(args.out) as folder:
        names = batch.write_summary(folder, rows)
    print(f"written to {args.out}: {names}, a folder for each recording")
    console.write_result(args.json, {"recordings": rows})
    if not is_url(args.out):
        lost = [row for row in rows if row not in failed and not (Path(row["folder"]) / "report.json").is_file()]
        if lost:
            raise console.TargetError(
                f"{args.out}: {len(lost)} results are not there: the workers wrote them to disks of their own; give a"
                " folder that all machines share, or a URL"
            )
    if len(failed) == len(rows):
        return NOTHING
    return 0 if all(row["state"] == batch.OK for row in rows) else ATTENTION


def _rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what came out, then how."""
    statuses = ", ".join(f"{n} {name.lower()}" for name, n in report["solves_by_status"].items())
    older = ", ".join(f"{old['keyframes']} keyframes in {old['folder']}" for old in report["older_sessions"])
    rejected = ", ".join(f"{n} {reason}" for reason, n in (report["bag_rejected"] | report["rejected"]).items())
    error = report.get("trajectory_error_m")
    rows = [
        ("keyframes", f"{report['keyframes_refined']} of {report['keyframes']} refined"),
        ("not refined", report["unrefined"] if report["keyframes_refined"] else ""),
        ("error to ground truth", f"{error['input']:.3f} -> {error['refined']:.3f} m (rmse, se3)" if error else ""),
        ("landmarks", f"{report['landmarks']} from {report['observations']} observations"),
        *((label, _change(report[key])) for label, key in _ERRORS),
        *_behind(report["observations_behind"]),
        ("rms without outliers", _short(report["rms_px_without_outliers"]["refined"])),
        *((f"camera {i}", text) for i, text in enumerate(report.get("cameras_refined", []))),
        ("outliers left out", str(report["outliers"])),
        ("rejected", rejected or "nothing"),
        ("topics", ", ".join(report["topics_taken"].values())),
        *(("left aside", f"{topic}: {reason}") for topic, reason in report["topics_left"].items()),
        *(("adjusted", note) for note in report["cameras_adjusted"]),
        ("solves", f"{report['solves']} ({statuses or 'none'})"),
        ("time in the solver", f"{report['solver_time_s']:.2f} s, slowest {1e3 * report['slowest_solve_s']:.0f} ms"),
        ("older sessions", older),
    ]
    if report["known_already"]:
        rows.append(("in the loaded map", f"{report['known_already']} keyframes of the recording already"))
    return [row for row in rows if row[1]]


def _change(of: Mapping[str, float | None]) -> str:
    before, after = of["input"], of["refined"]
    if before is None or after is None:
        return f"{_short(before)} -> {_short(after)}"
    return f"{before:.3f} -> {after:.3f} px"


def _short(value: float | None) -> str:
    return "nothing placed" if value is None else f"{value:.3f} px"


def _behind(of: Mapping[str, int]) -> list[tuple[str, str]]:
    """Return the row of observations that have no residual, if there are any."""
    if not any(of.values()):
        return []
    return [("behind a camera", f"{of['input']} -> {of['refined']} observations, which count in none of these")]


def _tell(report: Mapping[str, Any]) -> None:
    """Print what has to be looked at, and the last rejection in words; all of them are in report.json."""
    for line in report["attention"]:
        print(f"ba: warning: {line}", file=sys.stderr)
    harmless = tuple(f"({reason} = " for reason in HARMLESS)
    notes = [*report["bag_notes"], *(n for n in report["rejection_notes"] if not any(word in n for word in harmless))]
    if notes:
        print(f"ba: {notes[-1]}{' (more in report.json)' if len(notes) > 1 else ''}", file=sys.stderr)
