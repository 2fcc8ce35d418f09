# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Metrics of a record: what tables show and claims are checked against."""

from __future__ import annotations

import itertools
import math
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


METRICS: dict[str, Metric] = {
    "seconds": Metric("time [s]", is_time=True),
    "seconds_per_solve": Metric("time per linear solve and step [s]", is_time=True),
    "pcg_per_solve": Metric("PCG steps per solve", ".0f"),
    "pcg_total": Metric("PCG steps in all", ".0f"),
    "steps": Metric("steps taken", ".0f"),
    "solves": Metric("steps tried", ".0f"),
    "objective": Metric("objective at the end", ".6g"),
    "objective_before": Metric("objective at the start", ".6g"),
    "gradient": Metric("norm of the gradient at the end"),
    "gradient_smallest": Metric("smallest norm of the gradient"),
    "gradient_largest_entry": Metric("largest entry of the gradient"),
    "gradient_rise": Metric("mean rise of its log10 a step", ".3f"),
    "side": Metric("eliminated cameras in [steps]", ".0f"),
    "rmse_cameras": Metric("RMSE of cameras", ".4g"),
    "rmse_points": Metric("RMSE of points", ".4g"),
    "median_points": Metric("median error of points", ".4g"),
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
    "fill_of_e": Metric("share of E's blocks", ".2f"),
    "views_per_point": Metric("images per point", ".1f"),
    "condition_c": Metric("condition of C", ".1e"),
    "condition_b": Metric("condition of B", ".1e"),
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
    return out


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
