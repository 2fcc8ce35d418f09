# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run ``ba``: read the command line, hand over to the file of the command, turn errors into one line.

Only the command that is asked for is imported: ``ba --help`` is not to wait for the others.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from ba_node import __version__
from ba_node.cli import console, interrupts

# What every command does, under its heading in ``ba --help``; each is a file of this folder, or below ``experiments``.
GROUPS: dict[str, dict[str, str]] = {
    "from images": {
        "run": "from images to a map: track, check, replay, report",
        "track": "track images: keyframes and feature tracks for ba replay",
    },
    "refine": {
        "replay": "run the back-end on a recording, without a middleware",
        "tune": "search for better parameters on recordings",
        "sweep": "try every combination of some values of parameters on recordings",
        "solve": "solve a BAL, Bundler, COLMAP or g2o problem as a whole",
        "calibrate": "refine the cameras of a recording from its tracks",
        "map": "look into a saved map, or export it",
    },
    "look": {
        "info": "tell what is in a recording, and what a replay would use",
        "check": "test calibration and conventions of a recording against its tracks",
        "view": "show recordings and results in Foxglove or Rerun",
        "report": "make a page of the results of replays, one or several side by side",
        "evaluate": "compare a trajectory with a reference",
        "regress": "replay recordings and compare with a baseline",
    },
    "recordings and files": {
        "cut": "write a part of a recording",
        "merge": "put several recordings together",
        "convert": "convert between recordings, COLMAP, Bundler, BAL, TUM, KITTI, g2o, PLY",
        "rig": "show, convert or publish the cameras of a rig",
    },
    "the running node": {
        "record": "record the node's inputs from live topics",
        "play": "publish a recording on live topics",
        "params": "print all parameters with their defaults",
    },
    "in a checkout of the repository": {
        "demo": "run the node on a recording and compare with ground truth",
        "synth": "make a recording with ground truth",
        "steps": "search the steps of the scaling inc on a BAL file",
        "sphere": "make a BAL problem of points on a sphere, with its truth",
        "robustness": "prove on recordings gone wrong that no harm is done",
        "thesis": "repeat tables and figures of the thesis",
    },
}
COMMANDS = {name: summary for group in GROUPS.values() for name, summary in group.items()}
_EXPERIMENTS = {
    "demo": "demo.command",
    "synth": "synthetic.command",
    "steps": "thesis.steps",
    "sphere": "thesis.sphere_file",
    "robustness": "robustness.command",
    "thesis": "thesis.command",
}
ROOT = Path(__file__).resolve().parents[2]
_EXAMPLES = """\
examples:
  ba check bags/stereo_loop.mcap                 is the set-up sound?
  ba replay bags/stereo_loop.mcap --out out      refine a recording
  ba evaluate out/trajectory.tum truth.tum       how far from the truth?

ba COMMAND --help tells more about each, with an example. Exit codes: 0 all is well, 2 wrong command line or input,
3 results were written and something has to be looked at, 130 and 143 interrupted."""
USAGE_ERROR = 2
INTERRUPTED = 130
NOBODY_READS = 141  # as a shell has it: 128 and the number of SIGPIPE
FAULT = 1
_MESSAGES = ("ba_msgs", "std_msgs", "std_srvs", "geometry_msgs", "sensor_msgs", "nav_msgs", "rcl_interfaces")


class Parser(argparse.ArgumentParser):
    """Report a wrong command line as every other error: in one line."""

    def __init__(self, *args: Any, **fields: Any) -> None:
        super().__init__(*args, **fields)
        self.register("type", Path, lambda text: Path(console.place(text)))

    def error(self, message: str) -> NoReturn:
        """Print the error and leave."""
        self.exit(USAGE_ERROR, f"ba: error: {message}; see {self.prog} --help\n")


def module_of(command: str) -> ModuleType:
    """Import the module of a command: it has EXAMPLE, add_arguments and run.

    Raises:
        CheckoutError: it is one of the experiments, and the package is installed without its repository.
    """
    if command not in _EXPERIMENTS:
        return importlib.import_module(f"ba_node.cli.{command}")
    if not all((ROOT / name).is_file() for name in ("setup.py", "experiments/__init__.py")):
        raise console.CheckoutError(f"{command} needs a checkout of the repository: experiments are not installed")
    if str(ROOT) not in sys.path:
        sys.path.append(str(ROOT))
    return importlib.import_module(f"experiments.{_EXPERIMENTS[command]}")


def overview() -> str:
    """Return the commands by group, each with its line, and examples."""
    width = max(map(len, COMMANDS))
    parts = [
        "\n".join([f"{title}:", *(f"    {name.ljust(width)}  {summary}" for name, summary in group.items())])
        for title, group in GROUPS.items()
    ]
    return "\n\n".join([*parts, _EXAMPLES])


class _Version(argparse.Action):
    """Print the version and which kernels there are; these are asked only then, as to load them takes a while."""

    def __init__(self, option_strings: Sequence[str], dest: str, **fields: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **fields)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print and exit."""
        native = importlib.import_module("ba_node.native")
        print(f"ba_node {__version__} (kernels: {native.description()})")
        parser.exit()


def build_parser(command: str) -> argparse.ArgumentParser:
    """Return the parser, with the options of one command."""
    parser = Parser(
        prog="ba",
        description="Offline tools of ba_node, the bundle-adjustment back-end for ROS 2.",
        usage="ba [--version] COMMAND ...",
        epilog=overview(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, help="show the versions of ba_node and of its kernels")
    subparsers = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=Parser, help=argparse.SUPPRESS, prog="ba"
    )
    for name in COMMANDS:
        if name != command:
            subparsers.add_parser(name)
            continue
        module = module_of(name)
        sub = subparsers.add_parser(
            name,
            description=module.__doc__,
            epilog=f"example:\n  {module.EXAMPLE}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        module.add_arguments(sub)
        console.add_json_option(sub)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0, 2 for wrong input, 3 if results need a look, 130 when interrupted.

    It is 141 where whoever reads the output leaves before the work is through.

    In a process that is there for ``ba`` alone it does not return but ends it, as a signal may come until the very end.
    """
    if argv is not None or not interrupts.begun():
        return _run(argv)
    interrupts.at_interrupt(_discard_files)
    try:
        code: Any = _run(None)
    except SystemExit as stop:
        code = stop.code
    except BaseException:
        traceback.print_exc()
        code = FAULT
    return interrupts.leave(code if isinstance(code, int) else FAULT if code else 0)


def _discard_files() -> None:
    """Remove files that are half written, if any have been begun: their module is slow to import."""
    files = sys.modules.get("ba_node.io.files")
    if files is not None:
        files.discard_partials()


def _run(argv: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if "_ARGCOMPLETE" in os.environ:
        _complete()
    command = next((word for word in arguments if not word.startswith("-")), "")
    code: int = NOBODY_READS
    try:
        args = build_parser(command).parse_args(arguments)
        asked = getattr(args, "json", None)
        console.require_folder(asked)
        console.require_others(args)
        with console.json_alone(asked):
            code = module_of(args.command).run(args)
            if asked is not None:
                console.conclude(args, code)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of our output has enough: the code stays what it was, if the work was through. Python must not try
        # to flush the rest when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return code
    except KeyboardInterrupt:
        return _end(INTERRUPTED, "interrupted")
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("rclpy", *_MESSAGES):
            raise
        return _end(USAGE_ERROR, f"error: {error}: run this where ROS 2 is: after make setup in .venv, or sourced")
    except OSError as error:
        # Files name themselves when a disk is full.
        unnamed = "standard output: " if error.errno == errno.ENOSPC else ""
        where = f"{error.filename}: " if error.filename else unnamed
        return _end(USAGE_ERROR, f"error: {where}{error.strerror or error}")
    except ValueError as error:
        # The errors of this package that speak of its input are all ValueErrors of its own.
        if type(error).__module__.partition(".")[0] not in ("ba_node", "experiments"):
            raise
        return _end(USAGE_ERROR, f"error: {' '.join(str(error).split())}")


def _complete() -> None:
    """Answer a shell that asks how its line may go on (``eval "$(register-python-argcomplete ba)"``), and exit."""
    argcomplete = importlib.import_module("argcomplete")  # the shell's hook comes with it
    words = os.environ.get("COMP_LINE", "").split()[1:]
    argcomplete.autocomplete(build_parser(next((word for word in words if word in COMMANDS), "")))


def _end(code: int, message: str) -> int:
    print(f"ba: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
