# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings, and sessions, that end before there is much to tell: what is wrong with them is told all the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.robustness.faults import SOUND, spoiled
from experiments.robustness.faults.catalogue import spoiled_by
from tests.cases.conftest import Replay, harmless
from tests.cases.test_siblings import write

SHORT = {"keyframes": 13, "length_m": 10.0}


@pytest.mark.parametrize(("amount", "seed", "options"), [(1.2, 921, ()), (0.8, 922, ("--final-optimize",))])
def test_a_baseline_is_compared_once_more_at_the_end(
    amount: float, seed: int, options: tuple[str, ...], tmp_path: Path, run: Replay
) -> None:
    recording = spoiled("baseline_off", "stereo", amount, seed, **SHORT)
    outcome = run(write(tmp_path, recording), *options)
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))
    outcome.tells("baseline|scale of focal")


def test_each_of_two_sessions_is_compared_at_its_end(tmp_path: Path, run: Replay) -> None:
    recording = spoiled_by([("session_lowered", 3.0), ("baseline_off", 1.3)], "stereo", 88)
    outcome = run(write(tmp_path, recording))
    harmless(outcome.errors(recording.truth), 0.9, len(recording.keyframes))
    outcome.tells("session", "baseline|scale of focal")


@pytest.mark.parametrize("rig", ["stereo", "mono", "rgbd"])
def test_a_short_sound_drive_is_refined(rig: str, tmp_path: Path, run: Replay) -> None:
    recording = spoiled(SOUND, rig, seed=923, **SHORT)
    outcome = run(write(tmp_path, recording), "--final-optimize")
    assert outcome.code == 0 and not outcome.report["attention"], outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))


def test_a_principal_point_off_on_a_straight_way(tmp_path: Path, run: Replay) -> None:
    recording = spoiled("roi_ignored", "mono", 15.0, 924)
    outcome = run(write(tmp_path, recording), "--final-optimize")
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))
    outcome.tells("principal point")
