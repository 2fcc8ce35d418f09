# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn a synthetic sphere into BAL problems: one that begins where a solver does, and one that holds the truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ba_node.io.bal import BalProblem, write_bal
from experiments.thesis.sphere import SphereData, generate_sphere
from experiments.thesis.sphere_options import PRESETS, SphereOptions, preset

__all__ = ["PRESETS", "SphereOptions", "make", "start_of", "truth_of", "truth_path", "write_sphere"]


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


def make(path: Path, size: str | None, given: dict[str, Any]) -> str:
    """Write a problem for ``ba synth --kind sphere``; return what it says.

    Args:
        path: of the problem.
        size: name of a preset, or None for the defaults.
        given: options by name, in place of those of the preset.
    """
    base = preset(size) if size else SphereOptions()
    data = generate_sphere(dataclasses.replace(base, **given))
    truth = write_sphere(path, data)
    return (
        f"{path}: {len(data.cameras)} images, {len(data.points)} points, {len(data.uv)} observations,"
        f" {int(data.outlier.sum())} of them outliers\n{truth}: the truth"
    )
