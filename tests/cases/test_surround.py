# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Rigs whose cameras look to several sides and share no view: which of them is wrong is told all the same."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.measurements import CameraRig, FeatureTracks
from experiments.robustness.faults import RIGS, SOUND, Recording, spoiled
from experiments.robustness.faults.surround import surround
from tests.cases.conftest import Replay, harmless
from tests.cases.test_siblings import write

Edit = Callable[[Recording], Recording]
_GOOD = {"drift_rotation_deg": 0.02, "drift_translation": 0.002}


def drive(seed: int, looks: tuple[float, ...] = (0.0, 90.0, -90.0), **options: float) -> Recording:
    """Return a drive with two cameras that look ahead, and one to either side."""
    rigs = ("stereo", *["mono"] * (len(looks) - 1)) if len(looks) > 2 else ("mono",) * len(looks)
    return surround(
        [
            spoiled(SOUND, rig, seed=seed, look_deg=look, **RIGS[rig], **options)
            for rig, look in zip(rigs, looks, strict=True)
        ]
    )


def turned(camera: int, degrees: float, axis: tuple[float, float, float]) -> Edit:
    turn = geometry.so3_exp(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis))

    def change(rig: CameraRig) -> CameraRig:
        orientation = rig.orientation.copy()
        rotation = geometry.matrix_from_quaternion(orientation[camera]) @ turn
        orientation[camera] = geometry.quaternion_from_matrix(rotation)
        return dataclasses.replace(rig, orientation=orientation)

    return lambda recording: recording.changed(CameraRig, change)


def swapped(a: int, b: int) -> Edit:
    other = {a: b, b: a}
    return lambda recording: recording.changed(
        FeatureTracks,
        lambda image: dataclasses.replace(image, camera_index=other.get(image.camera_index, image.camera_index)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [901, 902])
def test_sound_rig_is_refined(seed: int, tmp_path: Path, run: Replay) -> None:
    recording = drive(seed)
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 0 and outcome.report["attention"] == [], outcome.words
    (error,) = outcome.errors(recording.truth)
    assert error.published_m < 0.25 * error.input_m, f"{error.input_m:.4f} -> {error.published_m:.4f} m"


@pytest.mark.parametrize("path", ["line", "loop"])
def test_cameras_that_look_at_the_same_may_be_tracked_one_by_one(path: str, tmp_path: Path, run: Replay) -> None:
    recording = spoiled(SOUND, "stereo", seed=903, path=path).changed(
        FeatureTracks,
        lambda image: dataclasses.replace(image, track_id=2 * image.track_id + np.uint64(image.camera_index)),
    )
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 0 and outcome.report["attention"] == [], outcome.words
    assert outcome.report["notices"]["no_shared_track"] == 1
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "options", "looks", "named"),
    [
        (turned(2, 2.0, (0.1, 1.0, 0.2)), _GOOD, (0.0, 90.0, -90.0), "camera 2 does not fit .* about 2 degrees"),
        (swapped(2, 3), {}, (0.0, 90.0, -90.0), "cameras 3 and 2 swapped|cameras 2 and 3 swapped"),
        (turned(1, 3.0, (0.0, 1.0, 0.0)), {}, (0.0, 180.0), "camera 1 does not fit"),
    ],
)
def test_camera_with_a_view_of_its_own(
    edit: Edit, options: dict[str, float], looks: tuple[float, ...], named: str, tmp_path: Path, run: Replay
) -> None:
    recording = edit(drive(902, looks, **options))
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))
    outcome.tells(named)
