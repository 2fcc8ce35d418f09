# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.estimate import Poses
from ba_node.io.trajectory import write_tum


@pytest.fixture
def trajectories(tmp_path: Path) -> tuple[str, str]:
    """Write a reference and an estimate that is 1 m beside it, and shuffled."""
    rng = np.random.default_rng(0)
    stamps = 1_000_000_000 + 100_000_000 * np.arange(20, dtype=np.int64)
    position, orientation = rng.normal(size=(20, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (20, 1))
    ids = np.arange(20, dtype=np.uint64)
    estimate, reference = tmp_path / "e.tum", tmp_path / "r.tum"
    write_tum(reference, Poses(ids, stamps, position, orientation))
    order = rng.permutation(20)
    write_tum(estimate, Poses(ids, stamps[order], position[order] + [1.0, 0.0, 0.0], orientation))
    return str(estimate), str(reference)


def test_figures(trajectories: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "e.json"
    for align, expected in (("none", 1.0), ("se3", 0.0), ("sim3", 0.0)):
        assert main(["evaluate", *trajectories, "--align", align, "--json", str(report)]) == 0
        error = json.loads(report.read_text())["translation_m"]
        assert error["rmse"] == pytest.approx(expected, abs=1e-9), align
        assert error["count"] == 20
    assert "20 of 20 poses have a partner" in capsys.readouterr().out


def test_plot_is_a_picture(trajectories: tuple[str, str], tmp_path: Path) -> None:
    png = tmp_path / "e.png"
    assert main(["evaluate", *trajectories, "--plot", str(png)]) == 0
    assert png.read_bytes().startswith(b"\x89PNG")


def test_trajectories_without_a_common_time(
    trajectories: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = tmp_path / "far.tum"
    far.write_text("99.0 0 0 0 0 0 0 1\n")
    assert main(["evaluate", str(far), trajectories[1]]) == 2
    assert "0 of 1 poses have a stamp within 0.01 s" in capsys.readouterr().err


def test_bad_line_is_named(trajectories: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.tum"
    bad.write_text("1.0 0 0 0 0 0 0 1\n2.0 x 0 0 0 0 0 1\n")
    assert main(["evaluate", str(bad), trajectories[1]]) == 2
    assert f"{bad}:2: x = 'x' is not a number" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "-1", "1e400", "1e300"])
def test_a_difference_that_is_no_time_is_named(
    trajectories: tuple[str, str], capsys: pytest.CaptureFixture[str], value: str
) -> None:
    assert main(["evaluate", *trajectories, f"--max-difference={value}"]) == 2
    assert "expected 0 to 1e+06 s" in capsys.readouterr().err


def test_no_difference_is_one(trajectories: tuple[str, str]) -> None:
    assert main(["evaluate", *trajectories, "--max-difference", "0"]) == 0
