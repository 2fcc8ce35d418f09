# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import pytest

from ba_node.cli.main import main


@pytest.mark.slow
def test_rows_page_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["robustness", "--only", "stamps_in_another_unit", "--seeds", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    rows = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert [(row["rig"], row["amount"]) for row in rows] == [(rig, a) for rig in ("stereo", "mono") for a in (1e3, 1e6)]
    assert {row["verdict"] for row in rows} <= {"kept", "better"}
    assert (tmp_path / "report.md").read_text() in printed
    assert "Of 4 recordings with a fault 4 did no harm" in printed
    assert (tmp_path / "images" / "robustness_faults.png").stat().st_size > 5000
    assert main(command) == 0
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 4


def test_unknown_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robustness", "--only", "nothing", "--out", str(tmp_path)]) == 2
    assert "'nothing' is no fault and no table" in capsys.readouterr().err
