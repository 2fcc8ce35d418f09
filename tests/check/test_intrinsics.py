# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Focal lengths and principal points that are off are named, by what they are off, and by what that is worth."""

from __future__ import annotations

import dataclasses
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.check import intrinsics
from ba_node.check.examine import examine
from ba_node.config import Config
from ba_node.measurements import CameraRig
from experiments.robustness.faults import spoiled
from tests.check.set_ups import tracks_in


@pytest.mark.parametrize(("factor", "slightly"), [(1.06, True), (0.93, True), (1.17, False), (0.81, False)])
def test_a_focal_length_that_is_far_off_has_to_leave_clearly_less(factor: float, slightly: bool) -> None:
    """On a straight street both halves of the tracks found one that was 17 % off, for 1 % of the loss."""
    tracks = tracks_in(spoiled("sound", "stereo", seed=59).measurements)
    params = tracks.cameras.params.copy()
    params[:, :2] *= factor
    free: Any = SimpleNamespace(params=params, sigma=np.full(3, 0.002))
    model = intrinsics._named(tracks, free)
    assert model is not None
    assert intrinsics._is_lower(1.030, 1.036, 2240, model.focal_alone) == slightly
    # A loss that is flat finds others by chance: 12 % off at 3.7 standard errors, for 1 % of the loss.
    coarse: Any = SimpleNamespace(params=params, sigma=np.full(3, abs(np.log(factor)) / 3.7))
    assert (intrinsics._named(tracks, coarse) is None) == slightly


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["mono", "stereo", "rgbd"])
def test_focal_length_that_is_a_tenth_short_is_named(rig: str) -> None:
    tracks = tracks_in(spoiled("focal_off", rig, 0.9, seed=162, path="loop").measurements)
    assert re.search(r"focal length off by a factor of about 0\.(8[7-9]|9[0-3])", examine(tracks).causes())


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["stereo", "mono", "rgbd"])
def test_principal_point_that_is_off_shows_in_the_steps(rig: str) -> None:
    """By 60 and 36 px: steps point 10 degrees beside the front-end's, all to the same side."""
    tracks = tracks_in(spoiled("roi_ignored", rig, 60.0, seed=613).measurements)
    assert re.search("region of interest", examine(tracks).summary())


@pytest.mark.slow
def test_coefficients_of_another_model_are_named() -> None:
    """Solves that took those of a plain lens for those of a fisheye bent the way (0.04 -> 0.17 m)."""
    recording = spoiled("sound", "mono", distortion="plumb_bob")

    def change(rig: CameraRig) -> CameraRig:
        lens = tuple(one[:4] for one in rig.distortion)
        return dataclasses.replace(rig, models=("equidistant",) * len(rig), distortion=lens)

    tracks = tracks_in(recording.changed(CameraRig, change).measurements)
    found = examine(tracks)
    assert "they fit the tracks as those of plumb_bob" in found.causes(), found.summary()


def test_a_region_with_depths_is_not_taken_for_depths_along_rays_alone() -> None:
    """Where few keyframes are in, depths by steps of wrong intrinsics differ towards the edges as those do."""
    backend = Backend(Config())
    for _ in backend.replay(iter(spoiled("roi_ignored", "rgbd", 120.0, 1).measurements)):
        pass
    assert "region of interest" in backend.scene.log.warnings["setup"]
    assert not backend.scene.keyframes.refined.any()
