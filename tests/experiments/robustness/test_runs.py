# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The rows behind `ba robustness`: what is run, what is not run again, what they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.robustness import runs
from experiments.robustness.faults import FAULTS, MONO, RGBD, SOUND, STEREO
from experiments.robustness.page import fault_table, outlier_table, page, spread
from experiments.robustness.plots import draw
from experiments.robustness.runs import FAULT_TABLE, OUTLIER_TABLE, Row, Task


def test_every_fault_has_its_rigs_and_amounts() -> None:
    found = runs.tasks(2)
    assert len({task.key for task in found}) == len(found)
    assert {task.fault for task in found} == {SOUND, *FAULTS}
    turned = [(task.amount, task.seed) for task in found if task.fault == "camera_turned"]
    assert turned == [(amount, seed) for amount in FAULTS["camera_turned"].amounts for seed in range(2)]
    assert len([task for task in found if task.table == OUTLIER_TABLE]) == 3 * 3 * 5 * 2


def test_a_choice_of_names() -> None:
    assert {task.fault for task in runs.tasks(1, ["far_points"])} == {"far_points"}
    assert {task.table for task in runs.tasks(1, ["outliers"])} == {OUTLIER_TABLE}
    with pytest.raises(runs.NameChoiceError, match="'far' is no fault and no table: choose from faults, "):
        runs.tasks(1, ["far"])


@pytest.mark.slow
def test_sound_recording() -> None:
    row = runs.run(Task(FAULT_TABLE, SOUND, RGBD, 0.0, 0))
    assert row["key"] == "faults/sound/rgbd/0/0"
    assert (row["verdict"], row["told"], row["published_share"]) == ("better", True, 1.0)
    assert row["published_m"] < 0.5 * row["input_m"] < 0.03


@pytest.mark.slow
def test_outliers_are_compared_with_none() -> None:
    row = runs.run(Task(OUTLIER_TABLE, "outliers_uniform", RGBD, 0.1, 0))
    assert row["optimum_m"] < 0.1 * row["input_m"]
    assert 0.5 < row["published_m"] / row["optimum_m"] < 1.5


def test_what_is_in_the_file_is_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []

    def run(task: Task) -> Row:
        ran.append(task.key)
        return {"key": task.key, "value": len(ran)}

    monkeypatch.setattr(runs, "run", run)
    wanted = runs.tasks(1, ["sound", "far_points"])
    seen: list[tuple[int, int]] = []
    first = runs.run_all(wanted[:3], tmp_path, 1, lambda *done: seen.append(done))
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]
    with (tmp_path / runs.RESULTS).open("a") as stream:
        stream.write('{"key": "broken off')
    again = runs.run_all(wanted, tmp_path, 1, lambda *_: None)
    assert again[:3] == first
    assert ran == [task.key for task in wanted]


def rows() -> list[Row]:
    faults = [(0.01, 0.009, "better", True), (0.01, 3.0, "harm", False), (None, None, "refused", True)]
    out: list[Row] = [
        {"table": FAULT_TABLE, "fault": "far_points", "rig": MONO, "amount": 5.0, "seed": seed}
        | dict(zip(("input_m", "published_m", "verdict", "told"), values, strict=True))
        for seed, values in enumerate(faults)
    ]
    for share in (0.3, 0.5):
        row = {"table": OUTLIER_TABLE, "fault": "outliers_uniform", "rig": STEREO, "amount": share, "seed": 0}
        out.append(row | {"input_m": 0.1, "published_m": 0.02, "optimum_m": 0.01})
    return out


def test_tables_show_the_worst_and_mark_what_misses_its_goal() -> None:
    assert fault_table(rows()[:3]).splitlines()[-1] == "| all points far, km | mono | 5 | 0.01 | 1.504 | **harm** | – |"
    last = outlier_table(rows()[3:]).splitlines()[-1]
    assert last == "| outliers anywhere | stereo | 10.0 | 0.0100 | **2.00** | 2.00 |"
    assert "Of 3 recordings with a fault 2 did no harm" in page(rows())
    assert spread([1.0, 1.1, 3.0], ".2f") == "1.10 (3.00)"


def test_the_page_says_of_how_many_seeds_it_tells() -> None:
    three, one = rows()[:3], rows()[3:]
    assert "median of 3 recordings with other seeds" in page(three)
    assert "**verdict**, the worst of them:" in page(three)
    assert "outliers, of one recording each" in page(one)
    assert "median" not in page(one)


def test_pictures(tmp_path: Path) -> None:
    paths = draw(tmp_path / "images", rows())
    assert [path.name for path in paths] == ["robustness_faults.png", "robustness_outliers.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)
    assert draw(tmp_path / "none", []) == []
