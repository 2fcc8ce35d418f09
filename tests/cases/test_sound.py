# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Sound recordings: nothing is held back, nobody is warned, and the figures stay what they were."""

from __future__ import annotations

from pathlib import Path

import pytest

from ba_node.cli.main import main
from experiments.robustness.faults import RIGS, SOUND, spoiled
from tests.cases.conftest import Outcome, Replay, harmless
from tests.cases.test_siblings import write

BAGS = Path(__file__).resolve().parents[2] / "bags"
TOLERANCE = 1.02


def is_silent(outcome: Outcome) -> None:
    assert outcome.code == 0, outcome.words
    assert outcome.report["attention"] == [] and outcome.report["warnings"] == {}
    assert not {"HELD", "FAILED"} & outcome.report["solves_by_status"].keys()
    assert outcome.report["keyframes_refined"] == outcome.report["keyframes"]


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [("stereo_loop", 0.739, 0.00532), ("mono_loop", 0.557, 0.0083)],
)
def test_shipped_recordings(name: str, before: float, after: float, run: Replay) -> None:
    outcome = run(BAGS / f"{name}.mcap")
    is_silent(outcome)
    error = outcome.report["trajectory_error_m"]
    assert error["input"] == pytest.approx(before, abs=0.001)
    assert error["refined"] <= TOLERANCE * after, f"{error['refined']:.5f} m, it was {after} m"


@pytest.mark.slow
def test_kitti_stereo(shared_data: Path, run: Replay) -> None:
    outcome = run(shared_data / "kitti-stereo-vo" / "kitti_stereo.mcap")
    is_silent(outcome)
    rms = outcome.report["rms_px"]
    assert rms["input"] == pytest.approx(1.021, abs=0.001)
    assert rms["refined"] <= TOLERANCE * 0.363, rms


@pytest.mark.slow
def test_ladybug(shared_data: Path, tmp_path: Path, run: Replay) -> None:
    bag = tmp_path / "ladybug.mcap"
    assert main(["convert", str(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"), str(bag)]) == 0
    outcome = run(bag)
    is_silent(outcome)
    rms, median = outcome.report["rms_px"], outcome.report["median_px"]
    assert rms["input"] == pytest.approx(5.172, abs=0.001)
    assert rms["refined"] <= TOLERANCE * 1.922, rms
    assert median["refined"] <= TOLERANCE * 0.307, median


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["none", "plumb_bob", "equidistant"])
@pytest.mark.parametrize("rig", RIGS)
def test_drives_of_every_rig_and_lens(rig: str, lens: str, tmp_path: Path, run: Replay) -> None:
    recording = spoiled(SOUND, rig, seed=7, path="loop", length_m=20.0, distortion=lens)
    outcome = run(write(tmp_path, recording))
    is_silent(outcome)
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))


@pytest.mark.slow
@pytest.mark.parametrize(("motion", "amount", "seed"), [("stands_still", 35.0, 39), ("hardly_moves", 1.0, 37)])
def test_depths_tell_where_keyframes_are_not_apart(
    motion: str, amount: float, seed: int, tmp_path: Path, run: Replay
) -> None:
    recording = spoiled(motion, "rgbd", amount, seed)
    outcome = run(write(tmp_path, recording))
    is_silent(outcome)
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))
