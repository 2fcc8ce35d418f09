# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Which of several cameras is wrong is for the others to say; of two, both are named."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from ba_node.check.examine import examine
from ba_node.check.tracks import Tracks
from experiments.robustness.faults import Recording, spoiled
from experiments.robustness.faults.surround import third
from tests.check.set_ups import tracks_in


def tracks(recording: Recording, camera: int = 0, factor: float = 1.0) -> Tracks:
    """Return the tracks of a recording, the focal length of one camera given wrongly."""
    found = tracks_in(recording.measurements)
    params = found.cameras.params.copy()
    params[camera, :2] *= factor
    return dataclasses.replace(found, cameras=dataclasses.replace(found.cameras, params=params))


def sound(**changes: Any) -> Recording:
    return spoiled("sound", "stereo", seed=7, **changes)


@pytest.mark.parametrize("factor", [1.2, 1.05, 0.9])
@pytest.mark.parametrize("camera", [0, 1, 2])
def test_a_focal_length_is_that_of_the_camera_which_the_others_contradict(camera: int, factor: float) -> None:
    found = examine(tracks(third(sound()), camera, factor))
    (finding,) = found.findings
    (cause,) = finding.causes
    told = float(cause.split(" about ")[1].split()[0])
    assert cause.startswith(f"focal length of camera {camera} off"), found.summary()
    assert abs(np.log(told / factor)) < 0.02, cause
    assert finding.changes == (f"k in the camera_info of camera {camera}",)


def test_of_two_cameras_either_may_be_wrong() -> None:
    found = examine(tracks(sound(), 0, 1.2))
    (finding,) = found.findings
    assert [cause[:24] for cause in finding.causes] == ["focal length of camera 1", "focal length of camera 0"]


def test_a_first_camera_that_is_turned_is_named() -> None:
    recording = third(sound())
    found = tracks(recording)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.03), -np.sin(0.03)], [0.0, np.sin(0.03), np.cos(0.03)]])
    rotation, translation = found.cameras.rotation.copy(), found.cameras.translation.copy()
    rotation[0], translation[0] = turn @ rotation[0], turn @ translation[0]
    turned = dataclasses.replace(found.cameras, rotation=rotation, translation=translation)
    told = examine(dataclasses.replace(found, cameras=turned))
    assert told.causes().startswith("camera 0 does not fit its place on the body"), told.summary()
    assert examine(found).findings == [], "and three sound ones are not accused"


@pytest.mark.parametrize("order", [(1, 0), (0, 2, 1)])
def test_cameras_that_are_swapped_are_so_whatever_their_intrinsics(order: tuple[int, ...]) -> None:
    """The principal points of sound cameras differ by some pixels: images are exchanged, not places alone."""
    sound = spoiled("sound", "stereo", seed=7)
    found = tracks_in((sound if len(order) == 2 else third(sound)).measurements)
    shift = np.array([[0.0, 0.0], [7.0, -5.0], [-6.0, 4.0]])[: len(order)]
    params = found.cameras.params.copy()
    params[:, 2:4] += shift
    own = dataclasses.replace(found, cameras=dataclasses.replace(found.cameras, params=params))
    own = own.seen(found.uv + shift[found.camera])
    assert examine(own).findings == [], examine(own).summary()
    rig, rows = own.cameras, list(order)
    placed = dataclasses.replace(rig, rotation=rig.rotation[rows], translation=rig.translation[rows])
    told = examine(dataclasses.replace(own, cameras=dataclasses.replace(placed, params=rig.params[rows])))
    assert ("swapped" if len(order) == 2 else f"they sit where it says that {str(order)[1:-1]} do") in told.causes()
