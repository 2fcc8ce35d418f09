# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a record: what tables show and claims are judged by."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Quantity:
    """What a column shows.

    Attributes:
        title: head of the column.
        form: format of a number.
        is_time: compared as a ratio to the first row, as absolute times differ by machine.
    """

    title: str
    form: str = ".3g"
    is_time: bool = False


QUANTITIES: dict[str, Quantity] = {
    "seconds": Quantity("time [s]", is_time=True),
    "seconds_per_solve": Quantity("time per linear solve and step [s]", is_time=True),
    "pcg_per_solve": Quantity("PCG steps per solve", ".0f"),
    "pcg_total": Quantity("PCG steps in all", ".0f"),
    "steps": Quantity("steps taken", ".0f"),
    "solves": Quantity("steps tried", ".0f"),
    "objective": Quantity("objective at the end", ".6g"),
    "objective_before": Quantity("objective at the start", ".6g"),
    "gradient": Quantity("norm of the gradient at the end"),
    "gradient_smallest": Quantity("smallest norm of the gradient"),
    "gradient_largest_entry": Quantity("largest entry of the gradient"),
    "gradient_rise": Quantity("mean rise of its log10 a step", ".3f"),
    "side": Quantity("eliminated cameras in [steps]", ".0f"),
    "rmse_cameras": Quantity("RMSE of cameras", ".4g"),
    "rmse_points": Quantity("RMSE of points", ".4g"),
    "median_points": Quantity("median error of points", ".4g"),
    "outside_two_px": Quantity("|error| > 2 px [%]", ".2f"),
    "gaussian_outside": Quantity("of a Gaussian as wide [%]", ".2f"),
    "kurtosis": Quantity("kurtosis (Gaussian: 3)", ".1f"),
    "end": Quantity("why it stopped"),
    "slope": Quantity("slope", ".4f"),
    "megabytes": Quantity("memory at most [MB]"),
    "difference": Quantity("|p - p of Cholesky|² / s", ".2g"),
    "rotation": Quantity("rotation", ".0e"),
    "translation": Quantity("translation", ".0e"),
    "f": Quantity("f", ".0e"),
    "k1": Quantity("k1", ".0e"),
    "k2": Quantity("k2", ".0e"),
    "point": Quantity("point", ".0e"),
    "observations": Quantity("observations", ".0f"),
    "fill_of_e": Quantity("share of E's blocks", ".2f"),
    "views_per_point": Quantity("images per point", ".1f"),
    "condition_c": Quantity("condition of C", ".1e"),
    "condition_b": Quantity("condition of B", ".1e"),
    "condition_s": Quantity("condition of S", ".1e"),
    "lone_points": Quantity("points held by < 2 observations", ".0f"),
    "first_break": Quantity("first break in step", ".0f"),
    "breaks": Quantity("breaks", ".0f"),
}


def figures(record: Record) -> dict[str, float | str | None]:
    """Return every figure that a record has, by name of the quantity."""
    if "trace" not in record:
        return dict(record.get("figures", {}))
    rows = record["trace"]
    tried = rows[1:]
    pcg = sum(row["linear_iterations"] for row in tried)
    out: dict[str, float | str | None] = {
        "seconds": rows[-1]["time_s"] if rows else 0.0,
        "seconds_per_solve": rows[-1]["time_s"] / max(len(tried), 1) if rows else 0.0,
        "pcg_per_solve": pcg / max(len(tried), 1),
        "pcg_total": float(pcg),
        "steps": float(sum(row["accepted"] for row in tried)),
        "solves": float(len(tried)),
        "objective": rows[-1]["objective"] if rows else None,
        "objective_before": rows[0]["objective"] if rows else None,
        "gradient": rows[-1]["gradient_norm"] if rows else None,
        "gradient_smallest": min((row["gradient_norm"] for row in rows), default=None),
        "gradient_rise": _rise([row["gradient_norm"] for row in rows if row["accepted"]]),
        "gradient_largest_entry": record["gradient"]["largest"],
        "side": float(sum(row["side"] == "cameras" for row in tried)),
        "end": record["reason"],
    }
    residuals = record["residuals"]
    out["outside_two_px"] = 100.0 * residuals["share_beyond"]
    out["gaussian_outside"] = (
        100.0 * math.erfc(2.0 / residuals["sigma"] / math.sqrt(2.0)) if residuals["sigma"] else 0.0
    )
    out["kurtosis"] = residuals["kurtosis"]
    out.update(record.get("truth_after", {}))
    return out


def _rise(norms: Sequence[float]) -> float:
    """Return by how much log10 of the gradient's norm rises in a step at the mean, falls counted as nothing."""
    logs = [math.log10(norm) for norm in norms if norm > 0.0]
    return sum(max(0.0, b - a) for a, b in itertools.pairwise(logs)) / max(len(logs) - 1, 1)


def shown(name: str, value: float | str | None) -> str:
    """Return a figure as text; a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    return format(value, QUANTITIES[name].form) if math.isfinite(value) else "–"
