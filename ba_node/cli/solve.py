# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a BAL file (.txt, .bz2, .gz), a scene of Bundler (.out), a model of COLMAP (a folder) or a .g2o as a whole.

BAL ("Bundle Adjustment in the Large") and Bundler: poses, points and each camera's f, k1, k2 are free. The defaults are
those of the method: squared loss but for irls_*, points behind a camera keep their residual, as the published results
count. COLMAP and g2o: poses, points, and what --refine names of the cameras, which stay shared as they are in the
model; points that are behind their camera at the start are left out, as COLMAP does. Parameters of the node (solver.*)
and options of the solver (loss, damping, trust_region, linear_solver, ...) are changed with --set.

Exit code: 0 all is well, 2 nothing came of it, 3 the result has to be looked at: it is worse than the start, focal
lengths are not positive, or many points lie behind their cameras.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ba_node.cli.console import require_folder, write_result
from ba_node.cli.ranks import start_ranks, together

if TYPE_CHECKING:
    from ba_node.config import SolverOptions
    from ba_node.estimate import Iteration
    from ba_node.offline.solve_bal import Solution
    from ba_node.offline.solve_model import ModelSolution

EXAMPLE = (
    "ba solve problem-49-7776-pre.txt.bz2 --iterations 50 --json trace.json\n"
    "  ba solve sparse/0 --out refined --refine focal distortion"
)
# Nothing came of it; something came of it that has to be looked at.
NOTHING, ATTENTION = 2, 3
_GROUPS = ("focal", "principal_point", "distortion", "rig")
# What differs from a method's defaults where a model of COLMAP is solved, before --set.
_OF_MODELS = ("cheirality=drop", "damping_policy=nielsen", "function_tolerance=1e-9", "max_iterations=200")
_HEAD = ("iter", "time [s]", "objective", "|gradient|", "linear", "step", "damping", "radius")
_WIDTHS = (4, 9, 18, 11, 7, 9, 10, 10)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from ba_node.config import SolverOptions, declared  # noqa: PLC0415

    options = {option.name: option for option in declared(SolverOptions)}
    iterations = options["max_iterations"]
    parser.add_argument("problem", type=Path, metavar="PROBLEM")
    parser.add_argument(
        "--method",
        default="auto",
        help=f"one of {', '.join(options['method'].choices)}; see docs/methods.md (default: auto)",
    )
    parser.add_argument(
        "--iterations", type=int, metavar="N", help=f"{iterations.doc} (default: the method's, {iterations.default})"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"change an option, one of {', '.join(name for name in options if name != 'method')}; repeatable",
    )
    parser.add_argument(
        "--ranks", type=int, metavar="N", help="BAL, Bundler: solve on N processes by MPI, see docs/scale.md"
    )
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="with ranks: write where the solve is")
    parser.add_argument(
        "--every", type=int, default=5, metavar="K", help="iterations between checkpoints (default: %(default)s)"
    )
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the refined problem in its own format")
    parser.add_argument(
        "--refine",
        nargs="+",
        choices=(*_GROUPS, "none"),
        metavar="WHAT",
        help=f"COLMAP, g2o: what of the cameras is refined, of {', '.join(_GROUPS)}, or none (default: of COLMAP focal"
        " distortion rig, as it does itself; of g2o none)",
    )


def run(args: argparse.Namespace) -> int:
    """Solve."""
    from ba_node.offline.ranks import started_as_ranks  # noqa: PLC0415

    require_folder(args.out)
    if args.ranks is not None and not started_as_ranks():
        return start_ranks(args, (0, ATTENTION, NOTHING), lambda: _how_to_go_on(args.checkpoint))
    solution = _solved(args)
    if solution is None:
        args.json = None  # rank 0 writes it
        return 0
    summary = solution.as_dict()
    summary["peak_rss_mb"] = _peak_rss_mb()
    write_result(args.json, summary)
    if not solution.result.status.usable:
        print(f"ba: error: {args.problem}: {solution.result.status.name.lower()}: {summary['reason']}", file=sys.stderr)
        return NOTHING
    sizes, status = summary["problem"], summary["status"]
    print(
        f"{status.lower()}: {summary['reason']}\n"
        f"objective {summary['objective_before']:.8g} -> {summary['objective_after']:.8g},"
        f" rms {summary['rms_px_before']:.4g} -> {summary['rms_px_after']:.4g} px"
        f" ({sizes['cameras']} cameras, {sizes['points']} points, {sizes['observations']} observations)\n"
        f"linear solver: {summary['linear_solver']}\n"
        f"set-up {summary['setup_s']:.3f} s, solver {summary['solve_s']:.3f} s, memory {summary['peak_rss_mb']:.0f} MB"
    )
    if "camera_unknowns" in summary:
        print(f"cameras {len(summary['camera_models'])}, of which {summary['camera_unknowns']} numbers were refined")
    if solution.origin.any():
        print("solved about the origin {:g} {:g} {:g}, as that of the file is far away".format(*solution.origin))
    lines, grave = solution.attention()
    for line in lines:
        print(f"ba: warning: {line}" if grave else line, file=sys.stderr if grave else sys.stdout)
    if args.out:
        solution.write(args.out)
        print(f"written to {args.out}")
    return ATTENTION if grave else 0


def _how_to_go_on(checkpoint: Path | None) -> str:
    """Return what helps after a rank has died."""
    if checkpoint is not None and checkpoint.is_file():
        return f": go on from {checkpoint} with --resume"
    return "; --checkpoint FILE keeps what was done"


def _on_ranks(args: argparse.Namespace, options: SolverOptions) -> Solution | None:
    """Solve as one of several ranks; return the solution on rank 0."""
    from ba_node.offline.ranks import world  # noqa: PLC0415
    from ba_node.offline.solve_ranks import Checkpoint, solve_on_ranks  # noqa: PLC0415

    communicator = world()
    checkpoint = Checkpoint(args.checkpoint, max(1, args.every), args.resume) if args.checkpoint else None
    return together(
        communicator,
        lambda: solve_on_ranks(
            args.problem,
            options,
            communicator,
            checkpoint=checkpoint,
            clock=time.perf_counter,
            on_iteration=_show,
            warn=lambda text: print(f"ba: warning: {text}", file=sys.stderr),
        ),
    )


def _solved(args: argparse.Namespace) -> Solution | ModelSolution | None:
    from ba_node.config import ConfigError  # noqa: PLC0415
    from ba_node.offline.ranks import started_as_ranks  # noqa: PLC0415
    from ba_node.offline.solve_bal import solve_file  # noqa: PLC0415
    from ba_node.offline.solver_settings import solver_options  # noqa: PLC0415

    assignments = [*args.set] if args.iterations is None else [*args.set, f"max_iterations={args.iterations}"]
    if args.resume and args.checkpoint is None:
        raise ConfigError("--resume needs --checkpoint FILE, from which to go on")
    on_ranks = args.checkpoint is not None or started_as_ranks()
    is_model = args.problem.is_dir() or args.problem.suffix == ".g2o"
    if on_ranks and is_model:
        raise ConfigError("ranks and checkpoints are for BAL and Bundler, not for models of COLMAP or g2o")
    if not is_model:
        if args.refine:
            raise ConfigError("--refine is for COLMAP and g2o: BAL and Bundler have f, k1, k2 of each image free")
        options = solver_options(args.method, assignments)
        if on_ranks:
            return _on_ranks(args, options)
        return solve_file(args.problem, options, clock=time.perf_counter, on_iteration=_show)

    from ba_node.offline.solve_model import DEFAULT_GROUPS, solve_model  # noqa: PLC0415

    usual = DEFAULT_GROUPS if args.problem.is_dir() else ()
    groups = [group for group in args.refine or usual if group != "none"]
    # Cameras are refined without a region, which the default has; a method that is asked for by name is not changed.
    own = [*_OF_MODELS, "trust_region=none"] if groups and args.method == "auto" else _OF_MODELS
    options = solver_options(args.method, [*own, *assignments])
    return solve_model(args.problem, options, groups, clock=time.perf_counter, on_iteration=_show)


def _show(row: Iteration) -> bool:
    if row.iteration == 0:
        print("  ".join(name.rjust(width) for name, width in zip(_HEAD, _WIDTHS, strict=True)))
    cells = (
        str(row.iteration),
        f"{row.time_s:.3f}",
        f"{row.objective:.8g}",
        f"{row.gradient_norm:.3e}",
        str(row.linear_iterations),
        "taken" if row.accepted else "rejected",
        f"{row.damping:.2e}",
        f"{row.radius:.2e}",
    )
    print("  ".join(cell.rjust(width) for cell, width in zip(cells, _WIDTHS, strict=True)), flush=True)
    return True


def _peak_rss_mb() -> float:
    """Return the largest memory of this process so far; the unit of the system call is kB, on macOS bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)
