# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A camera whose image stands still while the robot drives: nothing is drawn to where it was, and it is said."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from ba_node.measurements import FeatureTracks
from experiments.robustness.faults import SOUND, Recording, spoiled
from tests.cases.conftest import Replay, harmless
from tests.cases.test_siblings import write


def frozen(recording: Recording, cameras: set[int], first: int, last: int) -> Recording:
    """Return a recording in which some cameras show from ``first`` to ``last`` what they showed at the first."""
    held: dict[int, FeatureTracks] = {}

    def change(image: FeatureTracks) -> FeatureTracks:
        if image.camera_index not in cameras or not first <= recording.number(image.keyframe_id) < last:
            return image
        shown = held.setdefault(image.camera_index, image)
        return dataclasses.replace(shown, keyframe_id=image.keyframe_id)

    return recording.changed(FeatureTracks, change)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "cameras", "first", "last"),
    [("stereo", {0, 1}, 15, 25), ("mono", {0}, 15, 25), ("stereo", {1}, 0, 40), ("rgbd", {0}, 28, 40)],
)
def test_a_stuck_image_does_no_harm(
    rig: str, cameras: set[int], first: int, last: int, tmp_path: Path, run: Replay
) -> None:
    recording = frozen(spoiled(SOUND, rig, seed=931), cameras, first, last)
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))
    outcome.tells(f"camera {max(cameras)} in keyframe .* stands still")
