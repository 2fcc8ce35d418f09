# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from ba_node.cli.main import main
from ba_node.offline.regress import BETTER, MISSING, OK, WORSE, Figure, read_baseline, value_of

SHIPPED = Path(__file__).resolve().parents[2] / "bags" / "regress.yaml"


@pytest.mark.parametrize(
    ("direction", "tolerance", "now", "verdict"),
    [
        ("lower", 0.1, 1.09, OK),
        ("lower", 0.1, 1.11, WORSE),
        ("lower", 0.1, 0.89, BETTER),
        ("higher", 0.1, 0.91, OK),
        ("higher", 0.1, 0.89, WORSE),
        ("higher", 0.0, 1.01, BETTER),
        ("equal", 0.0, 1.0, OK),
        ("equal", 0.0, 1.01, WORSE),
        ("lower", 0.1, None, MISSING),
        ("lower", 0.1, float("nan"), MISSING),
    ],
)
def test_a_figure_is_judged(direction: str, tolerance: float, now: float | None, verdict: str) -> None:
    assert Figure("key", 1.0, "m", direction, tolerance).compare(now) == verdict


def test_a_value_is_found_by_its_path() -> None:
    report = {"a": {"b": 2.5}, "list": [1, 2, 3], "text": "x", "flag": True}
    found = [value_of(report, key) for key in ("a.b", "list", "a", "a.b.c", "none", "text", "flag")]
    assert found == [2.5, 3, None, None, None, None, None]


@pytest.mark.slow
def test_a_baseline_is_made_held_and_renewed(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(bag, tmp_path / "small.mcap")
    baseline, figures = tmp_path / "base.yaml", tmp_path / "now.json"
    assert main(["regress", str(baseline), "--new", str(tmp_path / "small.mcap")]) == 0
    content = yaml.safe_load(baseline.read_text())
    (case,) = content["recordings"]
    assert case["recording"] == "small.mcap"
    assert [figure["key"] for figure in case["figures"]][:2] == [
        "trajectory_error_m.refined",
        "rms_px_without_outliers.refined",
    ]
    assert main(["regress", str(baseline), "--json", str(figures)]) == 0
    now = json.loads(figures.read_text())["figures"]
    assert {row["verdict"] for row in now} == {"ok"}
    assert all(row["now"] == row["value"] for row in now), "a replay gives the same every time"

    before = case["figures"][0]["value"]
    case["figures"][0]["value"] = before / 2.0
    case["figures"].append({"key": "no.such.figure", "value": 1.0})
    baseline.write_text(yaml.safe_dump(content))
    capsys.readouterr()
    assert main(["regress", str(baseline)]) == 3
    told = capsys.readouterr()
    assert "trajectory_error_m.refined is worse" in told.err
    assert "no.such.figure is missing" in told.err
    assert "+100.00%" in told.out and "\x1b" not in told.out
    assert main(["regress", str(baseline), "--update"]) == 0
    assert read_baseline(baseline)[0].figures[0].value == pytest.approx(before, rel=1e-12)


def test_settings_of_a_case_are_used(bag: Path, tmp_path: Path) -> None:
    """A window of three keyframes ends elsewhere than the default."""
    shutil.copy(bag, tmp_path / "small.mcap")
    case: dict[str, Any] = {"recording": "small.mcap", "settings": {"window.max_keyframes": 3}}
    case["figures"] = [{"key": "trajectory_error_m.refined", "value": 0.0, "direction": "equal"}]
    content = {"recordings": [case, {**case, "settings": {}}]}
    (tmp_path / "base.yaml").write_text(json.dumps(content))
    assert main(["regress", str(tmp_path / "base.yaml"), "--json", str(tmp_path / "now.json")]) == 3
    narrow, wide = (row["now"] for row in json.loads((tmp_path / "now.json").read_text())["figures"])
    assert narrow != wide


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a list of recordings"),
        ("recordings: []", "expected a list of recordings"),
        ("recordings: [{figures: []}]", "KeyError: 'recording'"),
        ("recordings: [{recording: a, figures: [{key: x, value: y}]}]", "x: expected a number"),
        ("recordings: [{recording: a, figures: [{key: x, value: 1, direction: up}]}]", "lower, higher or equal"),
        ("recordings: [{recording: a, figures: [{key: x, value: 1, unti: m}]}]", "unti"),
        ("recordings: [{recording: a, figures: [{key: x, value: 1}]}]", "a: cannot be opened"),
    ],
)
def test_wrong_baselines_are_named(text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "base.yaml").write_text(text)
    assert main(["regress", str(tmp_path / "base.yaml")]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1, error


def test_the_shipped_baseline_is_of_the_shipped_recordings() -> None:
    cases = read_baseline(SHIPPED)
    assert {case.recording for case in cases} == {path.name for path in SHIPPED.parent.glob("*.mcap")}
    assert all(len(case.figures) >= 4 for case in cases)
