# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run ``ba``: read the command line, hand over to the file of the command, turn errors into one line.

Only the command that is asked for says what options it has: that of ``synth`` comes from modules that are slow to
import, and ``ba --help`` is not to wait for them.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NoReturn

from ba_node import __version__
from ba_node.cli import interrupts
from ba_node.cli.checkout import CheckoutCommand
from ba_node.cli.console import add_json_option, conclude, json_alone, require_folder

# Every command, under its heading in ``ba --help``; each is a file of this folder, but for those of the last group.
GROUPS: dict[str, tuple[str, ...]] = {
    "from images": (
        "run",
        "track",
    ),
    "refine": (
        "replay",
        "tune",
        "sweep",
        "solve",
        "calibrate",
        "map",
    ),
    "look": (
        "info",
        "check",
        "view",
        "report",
        "evaluate",
        "regress",
    ),
    "recordings and files": (
        "cut",
        "merge",
        "convert",
        "rig",
        "synth",
    ),
    "the running node": (
        "record",
        "play",
        "demo",
        "params",
    ),
    "in a checkout of the repository": (
        "steps",
        "robustness",
        "thesis",
    ),
}
_IN_A_CHECKOUT = (
    CheckoutCommand("steps", "thesis.steps", "search the steps of the scaling inc on a BAL file"),
    CheckoutCommand("robustness", "robustness.command", "prove on recordings gone wrong that no harm is done"),
    CheckoutCommand("thesis", "thesis.command", "repeat tables and figures of the thesis"),
)
_BY_NAME = {command.name: command for command in _IN_A_CHECKOUT}
COMMANDS: dict[str, ModuleType | CheckoutCommand] = {
    name: _BY_NAME.get(name) or importlib.import_module(f"ba_node.cli.{name}")
    for names in GROUPS.values()
    for name in names
}
_EXAMPLES = """\
examples:
  ba check bags/stereo_loop.mcap                 is the set-up sound?
  ba replay bags/stereo_loop.mcap --out out      refine a recording
  ba evaluate out/trajectory.tum truth.tum       how far from the truth?

ba COMMAND --help tells more about each, with an example. Exit codes: 0 all is well, 2 wrong command line or input,
3 results were written and something has to be looked at, 130 and 143 interrupted."""
USAGE_ERROR = 2
INTERRUPTED = 130
FAULT = 1
_ROS_PACKAGES = (
    "rclpy",
    "ba_msgs",
    "std_msgs",
    "std_srvs",
    "geometry_msgs",
    "sensor_msgs",
    "nav_msgs",
    "rcl_interfaces",
)


class Parser(argparse.ArgumentParser):
    """Report a wrong command line as every other error: in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error and leave."""
        self.exit(USAGE_ERROR, f"ba: error: {message}; see {self.prog} --help\n")


def overview() -> str:
    """Return the commands by group, each with its line, and examples."""
    width = max(map(len, COMMANDS))
    parts = [
        "\n".join([f"{title}:", *(f"    {name.ljust(width)}  {COMMANDS[name].SUMMARY}" for name in names)])
        for title, names in GROUPS.items()
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
    for name, entry in COMMANDS.items():
        if name != command:
            subparsers.add_parser(name)
            continue
        module = entry.load() if isinstance(entry, CheckoutCommand) else entry
        sub = subparsers.add_parser(
            name,
            description=module.__doc__,
            epilog=f"example:\n  {module.EXAMPLE}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        module.add_arguments(sub)
        add_json_option(sub)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0, 2 for wrong input, 3 if results need a look, 130 when interrupted.

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
    try:
        args = build_parser(command).parse_args(arguments)
        asked = getattr(args, "json", None)
        require_folder(asked)
        with json_alone(asked):
            code: int = COMMANDS[args.command].run(args)
            if asked is not None:
                conclude(args, code)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of our output has enough. Python must not try to flush the rest when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return _end(INTERRUPTED, "interrupted")
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in _ROS_PACKAGES:
            raise
        return _end(USAGE_ERROR, f"error: {error}: run this where ROS 2 is: after make setup in .venv, or sourced")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
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
