# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Figures of the benchmarks, from traces made by hand."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from experiments.benchmarks import metrics, page
from experiments.benchmarks.process import Run
from experiments.benchmarks.suite import START_AGREES, START_AGREES_PRINTED, Result, faults

# Objective 1000 at the start, set up after 1 s; 100 is the best that anybody reaches.
FAST = ((1.0, 1000.0), (2.0, 150.0), (3.0, 100.05), (4.0, 100.0))
SLOW = ((0.5, 1000.0), (5.0, 900.0), (9.0, 100.5), (20.0, 100.4))


def test_time_to_counts_from_the_start_of_the_setup() -> None:
    named = metrics.targets(1000.0, 100.0)
    assert named["tau 1e-01"] == pytest.approx(190.0) and named["gap 1e-02"] == pytest.approx(101.0)
    assert metrics.time_to(FAST, named["tau 1e-01"]) == 2.0
    assert metrics.time_to(FAST, named["gap 1e-02"]) == 3.0
    assert metrics.time_to(FAST, named["gap 1e-04"]) == 4.0
    assert metrics.time_to(SLOW, named["tau 1e-03"]) == 9.0
    assert metrics.time_to(SLOW, named["gap 1e-03"]) == math.inf
    assert metrics.time_to(SLOW, 1000.0) == 0.5


def test_iterations_leave_the_setup_out() -> None:
    assert metrics.iteration_s(FAST) == 1.0
    assert math.isnan(metrics.iteration_s(FAST[:1]))
    assert metrics.lowest(SLOW) == 100.4
    assert metrics.lowest(((0.0, math.nan),)) == math.inf


def test_median_takes_never_as_the_largest() -> None:
    assert metrics.median([3.0, math.inf, 1.0]) == 3.0
    assert metrics.median([3.0, math.inf, math.inf]) == math.inf
    assert metrics.median([math.nan, 2.0]) == 2.0
    assert math.isnan(metrics.median([]))


def test_profile_counts_what_was_not_solved_and_leaves_out_what_was_not_tried() -> None:
    times = {
        "a": [1.0, 4.0, math.inf, math.inf],
        "b": [2.0, 2.0, 3.0, math.inf],
        "c": [math.nan, 20.0, math.nan, math.nan],
    }
    profile = metrics.profile(times)
    assert profile["a"] == ([1.0, 2.0], [0.25, 0.5])
    assert profile["b"] == ([1.0, 1.0, 2.0], [0.25, 0.5, 0.75])
    assert profile["c"] == ([10.0], [1.0])


def test_growth_finds_the_exponent() -> None:
    sizes = [10.0, 100.0, 1000.0]
    factor, exponent = metrics.growth(sizes, [3.0 * size**1.5 for size in sizes])
    assert factor == pytest.approx(3.0, rel=1e-9) and exponent == pytest.approx(1.5, abs=1e-9)
    assert math.isnan(metrics.growth([10.0, 10.0], [1.0, 2.0])[1])
    assert math.isnan(metrics.growth([10.0, 20.0], [1.0, math.inf])[1])


def test_a_solver_that_minimised_something_else_is_left_out() -> None:
    right, wrong = Run(trace=FAST, checked=100.0), Run(trace=FAST, checked=103.0)
    assert faults(right, 1000.0, START_AGREES) == []
    assert len(faults(wrong, 1000.0, START_AGREES)) == 1
    assert len(faults(right, 1000.001, START_AGREES)) == 1
    assert faults(right, 1000.0005, START_AGREES_PRINTED) == []
    row = Result("peer", [wrong], faults=faults(wrong, 1000.0, START_AGREES)).medians(1000.0, 100.0)
    assert all(math.isnan(value) for value in row.values())


def test_medians_over_runs_count_a_failed_run_as_never() -> None:
    runs = [Run(trace=FAST, checked=100.0, total_s=4.0), Run(reason="ended after 60 s"), Run(trace=SLOW, checked=100.4)]
    row = Result("peer", runs).medians(1000.0, 100.0)
    assert row["tau 1e-01"] == 9.0
    assert row["gap 1e-03"] == math.inf
    assert row["final"] == 100.0


def test_the_end_is_a_ranking_of_its_own(tmp_path: Path) -> None:
    """Who stops early is told apart from who ends low; times to 1e-6 and memory are on the page too."""
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    times = {f"gap {gap:.0e}": 1.0 for gap in metrics.GAPS}
    problems = [
        {
            "problem": f"window-{n}",
            "f_start": 1e6,
            "f_best": 100.0,
            "solvers": {
                "early": {"final": 101.0, **times, "gap 1e-06": "never", "peak_mb": 10.0},
                "ba_node": {"final": 100.0, **times, "peak_mb": 20.0},
                "absent": {"final": None, **dict.fromkeys(times), "peak_mb": None},
            },
        }
        for n in (5, 10)
    ]
    known = metrics.numbers(problems)
    assert page.ranking(known) == [["ba_node", "2", "2", "same", "same"], ["early", "2", "0", "1 %", "1 %"]]
    figures = {figure.key: figure for figure in page.figures(known)}
    assert [trace["name"] for trace in figures["gap_1e_06"].data if trace["x"]] == ["ba_node"]
    assert [trace["y"] for trace in figures["above"].data] == [[pytest.approx(0.01)] * 2, [page.SAME] * 2, []]
    page.write(tmp_path / "index.html", {"machine": "a core"}, known)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "Objective at the end" in text and "a core" in text and len(text) > 1_000_000
