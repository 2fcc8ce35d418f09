# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""From traces to figures: time to a tolerance, performance profiles, growth with size.

A trace is a list of (seconds since the start of the set-up, objective). Two kinds of target, both with f_best the
lowest objective that any solver reached on the problem under the same rules:

- tau: f_best + tau (f_0 - f_best) (Dolan and More 2002, More and Wild 2009);
- gap: f_best (1 + gap), sharper where f_0 is huge.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Trace = Sequence[tuple[float, float]]

TAUS = (1e-1, 1e-2, 1e-3, 1e-4)
GAPS = (1e-2, 1e-3, 1e-4, 1e-6)


def targets(f_start: float, f_best: float) -> dict[str, float]:
    """Return the objectives to reach, by name: ``tau 1e-01``, ..., ``gap 1e-02``, ..."""
    named = {f"tau {tau:.0e}": f_best + tau * (f_start - f_best) for tau in TAUS}
    return named | {f"gap {gap:.0e}": f_best * (1.0 + gap) for gap in GAPS}


def time_to(trace: Trace, target: float) -> float:
    """Return when a trace first is at or below a target, s; inf if never."""
    return next((time for time, value in trace if value <= target), math.inf)


def lowest(trace: Trace) -> float:
    """Return the lowest finite objective of a trace; inf if there is none."""
    return min((value for _, value in trace if math.isfinite(value)), default=math.inf)


def iteration_s(trace: Trace) -> float:
    """Return the mean time of an iteration, the set-up left out, s; NaN without iterations."""
    return (trace[-1][0] - trace[0][0]) / (len(trace) - 1) if len(trace) > 1 else math.nan


def median(values: Iterable[float]) -> float:
    """Return the median, in which "never" (inf) counts as the largest; NaN of nothing."""
    known = [value for value in values if not math.isnan(value)]
    return statistics.median_low(known) if known else math.nan


def profile(times: Mapping[str, Sequence[float]]) -> dict[str, tuple[list[float], list[float]]]:
    """Return the performance profile of each solver.

    Args:
        times: of each solver, for the same problems in the same order; inf for never, NaN for not taken part.

    Returns:
        For each solver, factors a over the fastest, ascending, and the share of the problems that it took part in
        and solved within a times the fastest's time there. A problem that nobody solved counts against everybody.
    """
    table = np.array([list(row) for row in times.values()], dtype=float)
    table_inf = np.where(np.isnan(table), np.inf, table)
    fastest = table_inf.min(axis=0)
    out: dict[str, tuple[list[float], list[float]]] = {}
    for name, row in zip(times, table, strict=True):
        took_part = ~np.isnan(row)
        solved = took_part & np.isfinite(row)
        ratios = np.sort(row[solved] / fastest[solved])
        share = np.arange(1, len(ratios) + 1) / max(int(took_part.sum()), 1)
        out[name] = (ratios.tolist(), share.tolist())
    return out


def growth(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Return factor c and exponent p of ``value = c size^p``, by least squares in logarithms; NaN under two values."""
    pairs = [(s, v) for s, v in zip(sizes, values, strict=True) if s > 0 and v > 0 and math.isfinite(v)]
    if len({s for s, _ in pairs}) < 2:
        return math.nan, math.nan
    log_s, log_v = np.log(np.array(pairs)).T
    exponent, intercept = np.polyfit(log_s, log_v, 1)
    return float(np.exp(intercept)), float(exponent)


def numbers(problems: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return problems as a summary's JSON has them, with inf for "never" and NaN for nothing."""
    known = {"never": math.inf, None: math.nan}

    def row(values: Mapping[str, Any]) -> dict[str, float]:
        return {key: known.get(value, value) for key, value in values.items()}

    return [{**p, "solvers": {name: row(values) for name, values in p["solvers"].items()}} for p in problems]
