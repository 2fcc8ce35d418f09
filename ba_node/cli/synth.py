# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make data with ground truth: a recording, or a BAL problem of points on a sphere.

A recording (--kind recording, OUT.mcap) is a stereo or mono camera on a path around and through structure. The
front-end's poses drift, its pixels are noisy and some are wrong, as the options say. The true poses are in it on
ground_truth/pose.

A sphere (--kind sphere, OUT.txt, .bz2 or .gz) is the synthetic problem of section 5.1 of the thesis: --preset has the
sizes measured there. The truth is written beside it in the same format, as OUT.truth.txt. Only a checkout of the
repository makes spheres.

The same options give the same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ba_node.cli import checkout
from ba_node.cli.console import TargetError, require_folder, require_mcap, write_result

if TYPE_CHECKING:
    from ba_node.config import Parameter

SUMMARY = "make a recording or a BAL problem with ground truth"
EXAMPLE = (
    "ba synth loop.mcap --seed 3 --keyframes 100 --outlier-share 0.1\n  ba synth ball.txt --kind sphere --preset 10-253"
)
_RECORDING, _SPHERE = "recording", "sphere"
_BAL = (".txt", ".bz2", ".gz")


class OptionError(ValueError):
    """An option that the kind of data does not have."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options: one for each field of SyntheticOptions and SphereOptions."""
    parser.add_argument("target", type=Path, metavar="OUT")
    parser.add_argument(
        "--kind", choices=(_RECORDING, _SPHERE), default=_RECORDING, help="what to make (default: recording)"
    )
    if checkout.present():
        presets = tuple(_spheres().PRESETS)
        parser.add_argument("--preset", choices=presets, help="sphere: images-points of the thesis; options change it")
    for name, declared in _declared().items():
        option = next(iter(declared.values()))
        flag = f"--{name.replace('_', '-')}"
        if option.kind is bool:
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, help=_help(declared))
        else:
            parser.add_argument(
                flag,
                type=option.kind,
                choices=option.choices or None,
                metavar=None if option.choices else option.kind.__name__.upper(),
                help=_help(declared),
            )


def run(args: argparse.Namespace) -> int:
    """Generate."""
    if args.kind == _SPHERE:
        _spheres()
    given: dict[str, Any] = {}
    for name, declared in _declared().items():
        value = getattr(args, name)
        if value is None:
            continue
        if args.kind not in declared:
            raise OptionError(f"--{name.replace('_', '-')} is an option of --kind {next(iter(declared))} alone")
        given[name] = value
    if args.kind == _RECORDING and getattr(args, "preset", None):
        raise OptionError("--preset is an option of --kind sphere alone")
    return _sphere(args, given) if args.kind == _SPHERE else _recording(args, given)


def _recording(args: argparse.Namespace, given: dict[str, Any]) -> int:
    from ba_node.offline.recording import record  # noqa: PLC0415
    from ba_node.synthetic import SyntheticOptions, generate  # noqa: PLC0415

    is_bal = args.target.suffix in _BAL
    require_mcap(args.target, f", or --kind {_SPHERE} for a BAL problem" if is_bal else "")
    data = generate(SyntheticOptions(**given))
    count = record(args.target, data.timeline(), data.truth)
    observations = sum(len(image.track_id) for images in data.tracks for image in images)
    made = {"messages": count, "keyframes": len(data.keyframes), "tracks": len(data.track_id)}
    write_result(args.json, made | {"observations": observations})
    print(
        f"{args.target}: {count} messages; {len(data.keyframes)} keyframes, {len(data.track_id)} tracks,"
        f" {observations} observations"
    )
    return 0


def _sphere(args: argparse.Namespace, given: dict[str, Any]) -> int:
    require_folder(args.target)
    if args.target.suffix not in _BAL:
        raise TargetError(
            f"{args.target}: BAL problems are written as {', '.join(_BAL)}: give a name that ends so,"
            f" or leave out --kind {_SPHERE} for a recording"
        )
    text = _spheres().make(args.target, args.preset, given)
    write_result(args.json, {"made": text})
    print(text)
    return 0


def _spheres() -> ModuleType:
    return checkout.load("thesis.sphere_file", "--kind sphere")


def _declared() -> dict[str, dict[str, Parameter]]:
    """Return, by name of the option, its declaration for each kind that has it."""
    from ba_node.config import declared  # noqa: PLC0415
    from ba_node.synthetic import SyntheticOptions  # noqa: PLC0415

    kinds: dict[str, type] = {_RECORDING: SyntheticOptions}
    if checkout.present():
        kinds[_SPHERE] = _spheres().SphereOptions
    found: dict[str, dict[str, Parameter]] = {}
    for kind, options in kinds.items():
        for option in declared(options):
            found.setdefault(option.name, {})[kind] = option
    return found


def _help(declared: dict[str, Parameter]) -> str:
    option = next(iter(declared.values()))
    unit = f", {option.unit}" if option.unit else ""
    if len(declared) > 1:
        defaults = ", ".join(f"{kind} {item.default}" for kind, item in declared.items())
        return f"{option.doc} (default: {defaults}{unit})".replace("%", "%%")
    only = "sphere: " if _SPHERE in declared else ""
    return f"{only}{option.doc} (default: {option.default}{unit})".replace("%", "%%")
