# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras, and gross mistakes of placement, by two to nine keyframes."""

from __future__ import annotations

import dataclasses
import re

import pytest

from ba_node.backend import Backend
from ba_node.check.diagnosis import Diagnosis
from ba_node.check.few import check_few
from ba_node.check.tracks import tracks_of
from ba_node.config import Config
from experiments.robustness.faults import SOUND, spoiled
from experiments.robustness.faults.recording import Recording
from tests.cases.test_short import first_of

pytest.importorskip("cv2")


def asked(recording: Recording) -> Diagnosis:
    """Return what a few keyframes tell, the map being as it is without a check of the set-up."""
    config = Config()
    config = dataclasses.replace(config, guard=dataclasses.replace(config.guard, check_setup=False))
    backend = Backend(config)
    for _ in backend.replay(recording.measurements):
        pass
    table, order = backend.scene.keyframes, backend.scene.order
    tracks = tracks_of(backend.scene)
    assert tracks is not None
    return check_few(tracks, table.rotation[order], table.position[order])


@pytest.mark.parametrize(
    ("fault", "rig", "amount", "keyframes", "words"),
    [
        ("roi_ignored", "mono", 120.0, 5, "region of interest"),
        ("roi_ignored", "stereo", 120.0, 5, "region of interest"),
        ("rectified_with_distortion", "stereo", 1.0, 3, "rectified though a distortion is given"),
        ("binning_ignored", "stereo", 2.0, 4, "focal length off by a factor of about (1.[89]|2)"),
        ("camera_turned", "stereo", 1.0, 2, "do not sit on the body"),
        ("focal_off", "rgbd", 1.5, 7, r"focal length off by a factor of about 1\.[45]"),
        ("axes_confused", "mono", 1.0, 2, "axes confused"),
        ("extrinsics_inverted", "rgbd", 1.0, 3, "extrinsics inverted"),
    ],
)
def test_what_is_gross_is_named(fault: str, rig: str, amount: float, keyframes: int, words: str) -> None:
    found = asked(first_of(spoiled(fault, rig, amount, 70), keyframes))
    assert found.harmful and re.search(words, found.summary()), found.summary()
    assert "internal error" not in found.summary()


def test_a_focal_length_that_turns_confirm_takes_less() -> None:
    recording = first_of(spoiled("focal_off", "mono", 1.2, 70, look_deg=90.0), 5)
    assert re.search(r"focal length off by a factor of about 1\.[12]", asked(recording).summary())


@pytest.mark.parametrize("keyframes", [2, 3, 5, 9])
@pytest.mark.parametrize("rig", ["stereo", "mono", "rgbd"])
def test_sound_cameras_are_not_accused(rig: str, keyframes: int) -> None:
    for seed, look_deg in ((70, 0.0), (71, 90.0)):
        found = asked(first_of(spoiled(SOUND, rig, seed=seed, look_deg=look_deg), keyframes))
        assert not found.findings, found.summary()
