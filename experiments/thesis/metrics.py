# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Metrics of a record: what tables show and claims are checked against."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Metric:
    """What a column shows."""

    title: str  # head of the column
    form: str = ".3g"  # format of a number
    is_time: bool = False  # compared as a ratio to the first row, as absolute times differ by machine
    # By what factor another machine's rounding, or its clock, moves a number beyond the spread over seeds.
    noise: float = 1.0


METRICS: dict[str, Metric] = {
    "seconds": Metric("time [s]", is_time=True, noise=1.1),
    "seconds_per_solve": Metric("time per linear solve and step [s]", is_time=True, noise=1.1),
    "pcg_per_solve": Metric("PCG steps per solve", ".0f", noise=1.05),
    "pcg_total": Metric("PCG steps in all", ".0f", noise=1.05),
    "steps": Metric("steps taken", ".0f"),
    "solves": Metric("steps tried", ".0f"),
    "objective": Metric("objective at the end", ".6g", noise=1.00002),
    "objective_before": Metric("objective at the start", ".6g"),
    "gradient": Metric("norm of the gradient at the end", noise=1.5),
    "gradient_smallest": Metric("smallest norm of the gradient"),
    "gradient_largest_entry": Metric("largest entry of the gradient", noise=1.5),
    "gradient_rise": Metric("mean rise of its log10 a step", ".3f", noise=1.1),
    "switch": Metric("first solve that eliminates cameras", ".0f"),
    "share_of_steps": Metric("share of the steps asked for", ".2f"),
    "objective_in_time": Metric("objective in the time that the first needs", ".6g", noise=1.0001),
    "gradient_in_time": Metric("norm of the gradient in that time", noise=1.5),
    "noise_px": Metric("noise that the objective means [px]", ".3f"),
    "side": Metric("eliminated cameras in [steps]", ".0f"),
    "rmse_cameras": Metric("RMSE of cameras", ".4g", noise=1.02),
    "rmse_points": Metric("RMSE of points", ".4g", noise=1.02),
    "median_points": Metric("median error of points", ".4g", noise=1.02),
    "outside_two_px": Metric("|error| > 2 px [%]", ".2f"),
    "gaussian_outside": Metric("of a Gaussian as wide [%]", ".2f"),
    "kurtosis": Metric("kurtosis (Gaussian: 3)", ".1f"),
    "end": Metric("why it stopped"),
    "slope": Metric("slope", ".4f"),
    "megabytes": Metric("memory at most [MB]"),
    "difference": Metric("|p - p of Cholesky|² / s", ".2g"),
    "rotation": Metric("rotation", ".0e"),
    "translation": Metric("translation", ".0e"),
    "f": Metric("f", ".0e"),
    "k1": Metric("k1", ".0e"),
    "k2": Metric("k2", ".0e"),
    "point": Metric("point", ".0e"),
    "observations": Metric("observations", ".0f"),
    "tilt": Metric("axis to the ray to the centre [deg]", ".1f"),
    "seen": Metric("points seen", ".0f"),
    "fill_of_e": Metric("share of E's blocks", ".2f"),
    "views_per_point": Metric("images per point", ".1f"),
    "condition_c": Metric("condition of C", ".1e"),
    "condition_b": Metric("condition of B", ".1e"),
    "condition_b_scaled": Metric("condition of B, scaled, median", ".1e"),
    "condition_s": Metric("condition of S", ".1e"),
    "lone_points": Metric("points held by < 2 observations", ".0f"),
    "first_break": Metric("first break in step", ".0f"),
    "breaks": Metric("breaks", ".0f"),
}


def metrics_of(record: Record) -> dict[str, float | str | None]:
    """Return every metric that a record has, by name."""
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
    sides = [row["side"] for row in tried]
    # One that never does has all of its solves before it.
    out["switch"] = float(sides.index("cameras") + 1 if "cameras" in sides else len(sides) + 1)
    asked = record.get("iterations")
    taken = sum(row["accepted"] for row in tried)
    out["share_of_steps"] = taken / asked if asked else None
    out["noise_px"] = _noise(record["problem"], out["objective"])
    return out


def in_time(record: Record, seconds: float) -> dict[str, float | str | None]:
    """Return objective and gradient that a run has when a time is over, s of its own clock."""
    row = [row for row in record["trace"] if row["time_s"] <= seconds or row["iteration"] == 0][-1]
    return {"objective_in_time": row["objective"], "gradient_in_time": row["gradient_norm"]}


def _noise(sizes: Mapping[str, Any], objective: float | str | None) -> float | None:
    """Return the noise, px, that an objective at the minimum means: ``2 psi = (2 l - s + 7) sigma^2``."""
    redundancy = 2 * sizes["observations"] - 9 * sizes["images"] - 3 * sizes["points"] + 7
    return math.sqrt(2.0 * objective / redundancy) if isinstance(objective, float) and redundancy > 0 else None


def over_seeds(found: Sequence[Mapping[str, float | str | None]]) -> dict[str, Any]:
    """Return the median of each metric, and under ``spread`` its smallest and largest value where they differ.

    A value that is missing or not finite in one run counts as worse than all; words are those of the first run.
    """
    out: dict[str, Any] = {}
    spread: dict[str, list[float | None]] = {}
    for name, first in found[0].items():
        values = [row.get(name) for row in found]
        if any(isinstance(value, str) for value in values) or len(values) == 1:
            out[name] = first
            continue
        ordered = sorted(math.inf if value is None else float(value) for value in values)
        out[name] = _finite(statistics.median(ordered))
        if ordered[0] != ordered[-1]:
            spread[name] = [_finite(ordered[0]), _finite(ordered[-1])]
    return out | ({"spread": spread} if spread else {})


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _rise(norms: Sequence[float]) -> float:
    """Return by how much log10 of the gradient's norm rises in a step at the mean, falls counted as nothing."""
    logs = [math.log10(norm) for norm in norms if norm > 0.0]
    return sum(max(0.0, b - a) for a, b in itertools.pairwise(logs)) / max(len(logs) - 1, 1)


def shown(name: str, value: float | str | None) -> str:
    """Return a metric as text; a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    return format(value, METRICS[name].form) if math.isfinite(value) else "–"
