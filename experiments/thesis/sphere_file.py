# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make a BAL problem of points on a sphere: the synthetic problem of section 5.1 of the thesis.

--preset has the sizes measured there. The truth is written beside it in the same format, as OUT.truth.txt. The same
options give the same bytes.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from ba_node.cli.console import TargetError, require_folder
from ba_node.io.bal import BalProblem, write_bal
from experiments.command_options import add_declared_options, declared_options
from experiments.thesis.sphere import SphereData, generate_sphere
from experiments.thesis.sphere_options import PRESETS, SphereOptions, preset

EXAMPLE = "ba sphere ball.txt --preset 10-253"
_BAL = (".txt", ".bz2", ".gz")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("target", type=Path, metavar="OUT")
    parser.add_argument("--preset", choices=tuple(PRESETS), help="images-points of the thesis; options change it")
    add_declared_options(parser, SphereOptions)


def run(args: argparse.Namespace) -> int:
    """Make it."""
    require_folder(args.target)
    if args.target.suffix not in _BAL:
        raise TargetError(f"{args.target}: BAL problems are written as {', '.join(_BAL)}: give a name that ends so")
    base = preset(args.preset) if args.preset else SphereOptions()
    data = generate_sphere(dataclasses.replace(base, **declared_options(args, SphereOptions)))
    truth = write_sphere(args.target, data)
    print(
        f"{args.target}: {len(data.cameras)} images, {len(data.points)} points, {len(data.uv)} observations,"
        f" {int(data.outlier.sum())} of them outliers\n{truth}: the truth"
    )
    return 0


def start_of(data: SphereData) -> BalProblem:
    """Return the problem with the start values."""
    return BalProblem(data.start_cameras, data.start_points, data.camera_index, data.point_index, data.uv)


def truth_of(data: SphereData) -> BalProblem:
    """Return the problem with the true values; its residuals are noise and outliers."""
    return BalProblem(data.cameras, data.points, data.camera_index, data.point_index, data.uv)


def truth_path(path: Path) -> Path:
    """Return where the truth of a problem is written: ``NAME.truth.txt`` beside ``NAME.txt``."""
    suffix = "".join(path.suffixes[-2:]) if path.suffix in (".gz", ".bz2") else path.suffix
    return path.with_name(f"{path.name.removesuffix(suffix)}.truth{suffix}")


def write_sphere(path: Path, data: SphereData) -> Path:
    """Write the problem and, beside it, the truth; return where the truth is."""
    truth = truth_path(path)
    write_bal(truth, truth_of(data))
    write_bal(path, start_of(data))
    return truth
