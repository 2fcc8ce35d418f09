# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The covariance means what it says, over few runs; ``make consistency`` does it for all cases over 200."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.consistency.__main__ import main
from experiments.consistency.runs import Case, interval, run

RUNS = 40


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [Case("stereo", "cauchy", 0.5), Case("rgbd", "huber", 1.0), Case("mono", "cauchy", 1.0)],
    ids=lambda c: c.name,
)
def test_errors_are_as_large_as_is_said(case: Case) -> None:
    found = [run(case, seed) for seed in range(RUNS)]
    low, high = interval(RUNS, 6)
    for name in ("newest", "middle"):
        mean = float(np.mean([getattr(one, name) for one in found]))
        assert low < mean < high, f"{name}: NEES {mean:.2f}, expected {low:.2f} to {high:.2f}"
    share = float(np.mean([one.points for one in found]))
    assert 0.9 < share < 0.995, f"{100 * share:.0f} % of the points are within their 95 % ellipsoids"


def test_runs_that_are_there_are_not_run_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--runs", "1", "--only", "stereo_squared_1", "--out", str(tmp_path)]
    assert main(arguments) == 0
    once = (tmp_path / "nees.jsonl").read_text()
    assert main(arguments) == 0
    assert (tmp_path / "nees.jsonl").read_text() == once and len(once.splitlines()) == 1
    assert "| stereo | squared | 1 x |" in capsys.readouterr().out


def test_the_interval_is_that_of_chi_squared() -> None:
    low, high = interval(200, 6)
    assert (low, high) == pytest.approx((5.53, 6.49), abs=0.01)
