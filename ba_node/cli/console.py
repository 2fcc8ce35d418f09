# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What commands print: tables, and a progress bar where someone is looking."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ba_node.config import Config
    from ba_node.io.bag_topics import TopicChoice


STANDARD_OUTPUT = Path("-")
# Names of arguments for what is read, and for what is written.
_READ = (
    "bag",
    "bags",
    "source",
    "odometry",
    "mask",
    "files",
    "rig",
    "problem",
    "map",
    "estimate",
    "reference",
    "params",
)
_WRITTEN = ("out", "target", "json", "csv", "plot", "tum", "ply")
_RECORDINGS = (".mcap", ".db3")
# A folder with one of these is a model of COLMAP.
_MODEL = ("cameras.bin", "cameras.txt")
_out: list[IO[str]] = []
_written: list[Path | None] = []


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table with the first column flush left and the others flush right."""
    columns = list(zip(head, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for row in (head, *rows):
        first, *others = (
            cell.ljust(width) if index == 0 else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join([first, *others]).rstrip())
    return "\n".join(lines)


def facts(rows: Sequence[tuple[str, str]]) -> str:
    """Return pairs of name and value, one a line."""
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name.ljust(width)}  {value}".rstrip() for name, value in rows)


# By the first letters of what is shown, as on every terminal: red, yellow, green.
_COLOURS = {"WORSE": 31, "MISSING": 31, "error": 31, "warning": 33, "better": 32, "ok": 32}


def counted(number: int, thing: str) -> str:
    """Return how many there are of a thing: "1 session", "2 sessions"."""
    return f"{number} {thing}{'s' * (number != 1)}"


def coloured(text: str) -> str:
    """Return a word in its colour if somebody looks at a terminal that shows it (NO_COLOR: no), else as it is."""
    code = _COLOURS.get(text)
    if code is None or not sys.stdout.isatty() or "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb":
        return text
    return f"\x1b[{code}m{text}\x1b[0m"


@contextmanager
def progress_bar(name: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function to be called with what is done and the total; it shows nothing unless on a terminal."""
    from tqdm import tqdm  # noqa: PLC0415  # slow to import

    with tqdm(desc=name, unit=f" {unit}", disable=not sys.stderr.isatty(), leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


class CheckoutError(ValueError):
    """A command whose code stands beside the package in a checkout, and is not installed with it."""


class TargetError(ValueError):
    """A file that is asked for in a format that is not written."""


def require_folder(path: Path | None) -> None:
    """Raise TargetError if a file to write is in no folder, before long work is done for it."""
    if path is not None and not path.parent.is_dir():
        raise TargetError(f"{path}: there is no folder {path.parent}: make it first")


def require_others(args: argparse.Namespace) -> None:
    """Raise TargetError if what is to be written is what is to be read, or a part of it: it would be lost."""
    for target in (path for name in _WRITTEN for path in _paths(args, name) if _holds_work(path)):
        for source in (path for name in _READ for path in _paths(args, name) if path.exists()):
            inside = source.is_dir() and target.suffix in _RECORDINGS and target.parent.samefile(source)
            if inside or target.samefile(source):
                kind = "in the folder" if inside else "the folder" if target.is_dir() else "the file"
                raise TargetError(f"{target}: is {kind} that is read, and would be lost: write to another name")


def _holds_work(path: Path) -> bool:
    """Return True if writing there would write over something: a file, or a folder that is a model."""
    return path.is_file() or any((path / name).is_file() for name in _MODEL)


def _paths(args: argparse.Namespace, name: str) -> list[Path]:
    value = getattr(args, name, None)
    values = value if isinstance(value, list) else [value]
    return [Path(one) for one in values if isinstance(one, (str, Path))]


def require_mcap(path: Path) -> None:
    """Raise TargetError unless a recording may have this name."""
    require_folder(path)
    if path.suffix != ".mcap":
        raise TargetError(f"{path}: recordings are written as .mcap: give a name that ends so")


def place(text: str) -> str:
    """Return the name of a file, a folder or a URL; an empty one, as of a variable that is not set, is none.

    Raises:
        ArgumentTypeError: it is empty, which would stand for the folder that one is in.
    """
    if not text:
        raise argparse.ArgumentTypeError("an empty name: expected a file or folder")
    return text


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Declare the option that has a command's result written for programs, unless the command has one of its own."""
    if "--json" not in parser.format_usage():
        words = "write the result as JSON; - for standard output, instead of the text"
        parser.add_argument("--json", type=Path, metavar="FILE", help=words)
        parser.set_defaults(common_json=True)


def write_result(path: Path | None, content: Mapping[str, Any]) -> None:
    """Write what a command found as JSON where it was asked for."""
    from ba_node.io.files import json_text, write_json  # noqa: PLC0415

    _written.append(path)
    if path == STANDARD_OUTPUT:
        _out[-1].write(json_text(content))
    elif path is not None:
        write_json(path, content)


def conclude(args: argparse.Namespace, code: int) -> None:
    """Write the exit code as the result of a command that has no other."""
    if args.json is not None and args.json not in _written and getattr(args, "common_json", False):
        write_result(args.json, {"command": args.command, "exit_code": code})
    _written.clear()


@contextmanager
def json_alone(path: Path | None) -> Iterator[None]:
    """Keep the text of a command from standard output while the block runs, if its JSON is to go there."""
    if path != STANDARD_OUTPUT:
        yield
        return
    _out.append(sys.stdout)
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        _out.pop().flush()


def add_topic_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of commands that read the inputs of the node from a recording."""
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="NAME=TOPIC",
        help="which topic is meant where a recording has several, e.g. keyframes=/robot1/keyframes; repeatable",
    )
    parser.add_argument(
        "--namespace", default="", metavar="NS", help="take topics of this namespace only, e.g. /robot1"
    )


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of commands that run the back-end."""
    parser.add_argument(
        "--params", type=Path, metavar="YAML", help="parameters, in the form of ROS or plain (ba params)"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="set a parameter, after the file; repeatable"
    )


def add_fleet_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of commands that work on many recordings."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes on this machine (default: 1)")
    parser.add_argument(
        "--scheduler", default="", metavar="ADDRESS", help="scheduler of a Dask cluster, e.g. tcp://host:8786"
    )


def add_search_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of commands that try parameters on many recordings."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--objective",
        choices=("auto", "truth", "held_out"),
        default="auto",
        help="what the error is: of the trajectory, of tracks held out, or (auto) the former where there is a truth",
    )
    parser.add_argument("--each", action="store_true", help="every RECORDING is one by itself, whatever it is called")
    add_fleet_options(parser)
    add_topic_options(parser)
    add_parameter_options(parser)


def say_left_out(left_out: Mapping[str, str]) -> int:
    """Name the recordings that could not be used, and why; return the exit code."""
    for name, words in left_out.items():
        print(f"ba: error: {words if name in words else f'{name}: {words}'}", file=sys.stderr)
    return 3 if left_out else 0


def parameters(args: argparse.Namespace) -> Config:
    """Return all parameters, with what these options change."""
    from ba_node.config import parse_assignment  # noqa: PLC0415
    from ba_node.io.parameters import configure  # noqa: PLC0415

    return configure(args.params, dict(parse_assignment(text) for text in args.set))


def topic_choice(args: argparse.Namespace) -> TopicChoice:
    """Return what these options say."""
    from ba_node.io.bag_topics import TopicChoice, parse_topic  # noqa: PLC0415  # slow to import

    return TopicChoice(dict(parse_topic(text) for text in args.topic), args.namespace)
