# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every fault of the catalogue, in other worlds and by other amounts: no harm, and the cause in words."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.measurements import Keyframe
from ba_node.offline.recording import record
from experiments.robustness.faults import FAULTS, SOUND, Recording, spoiled
from tests.cases.conftest import Replay, harmless


def siblings() -> list[Any]:
    """Return fault, rig, amount and seed of each fault, by turns; `ba robustness` takes all rigs and amounts.

    The quick tests do with one fault of six.
    """
    return [
        pytest.param(
            name,
            fault.rigs[i % len(fault.rigs)],
            fault.amounts[i % len(fault.amounts)],
            100 + number + 50 * i,
            marks=[pytest.mark.slow] if number % 6 or i != (0 if fault.motion else number) else [],
        )
        for number, (name, fault) in enumerate(FAULTS.items())
        # Of a motion the usual rig, to which it does most harm, and another; of the others one, by turns.
        for i in ((0, 1) if fault.motion else (number,))
    ]


def write(folder: Path, recording: Recording) -> Path:
    """Write a recording as a file."""
    path = folder / "recording.mcap"
    record(path, recording.timeline, camera_info=recording.camera_info)
    return path


@pytest.mark.parametrize(("name", "rig", "amount", "seed"), siblings())
def test_no_harm_and_the_cause_is_named(
    name: str, rig: str, amount: float, seed: int, tmp_path: Path, run: Replay
) -> None:
    fault = FAULTS[name]
    recording = spoiled(name, rig, amount, seed)
    outcome = run(write(tmp_path, recording))
    assert outcome.code in fault.codes, f"exit code {outcome.code}: {outcome.words}"
    if outcome.report:
        harmless(outcome.errors(recording.truth), fault.least, len(recording.keyframes))
    outcome.tells(*fault.named)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["camera_turned", "depth_in_mm", "extrinsics_inverted"])
def test_odometry_that_is_better_than_the_tracks_is_kept(name: str, tmp_path: Path, run: Replay) -> None:
    recording = spoiled(name, seed=301, keyframes=60, drift_rotation_deg=0.01, drift_translation=0.001)
    outcome = run(write(tmp_path, recording))
    assert outcome.code in FAULTS[name].codes
    harmless(outcome.errors(recording.truth), 1.0, 60)
    outcome.tells(*FAULTS[name].named)


@pytest.mark.parametrize("rig", ["stereo", "mono", "rgbd"])
def test_a_first_keyframe_from_which_the_front_end_jumped_is_named(rig: str, tmp_path: Path, run: Replay) -> None:
    sound = spoiled(SOUND, rig, seed=5)
    first = sound.keyframes[0].keyframe_id

    def jumped(keyframe: Keyframe) -> Keyframe:
        if keyframe.keyframe_id != first:
            return keyframe
        return dataclasses.replace(keyframe, position=np.add(keyframe.position, (24.0, 32.0, 0.0)))

    outcome = run(write(tmp_path, sound.changed(Keyframe, jumped)))
    assert outcome.code == 3
    outcome.tells(r"keyframe 0, the first, stands apart")
    assert outcome.report["median_sigmas"]["refined"] < 1.5
