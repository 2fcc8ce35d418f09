# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that is turned on the body is measured by its own turns and directions."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.check.examine import examine
from ba_node.check.mounting import check_mounting, turned
from ba_node.check.relations import Relation, in_motion
from ba_node.check.two_view import Pair, Pose
from ba_node.core import geometry
from tests.check.set_ups import recording, seen


def _related(pose: Pose, k: int) -> Relation:
    rows = np.empty(0, np.intp)
    return Relation((k, 0), (k + 1, 0), rows, rows, Pair(np.empty((0, 2)), np.empty((0, 2)), 1e-3), pose, 1.0, 9.0)


@pytest.mark.parametrize("degrees", [0.0, 3.0, 12.0])
def test_turn_of_made_up_steps(degrees: float) -> None:
    rng = np.random.default_rng(5)
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    turn = geometry.so3_exp(np.radians(degrees) * axis)
    given, told = [], []
    for k in range(40):
        step = Pose(geometry.so3_exp(0.1 * rng.normal(size=3)), np.array([0.1, 0.0, 1.0]) + 0.3 * rng.normal(size=3))
        noisy = geometry.so3_exp(np.radians(0.2) * rng.normal(size=3)) @ turn
        move = noisy @ step.translation
        given.append(step)
        told.append(_related(Pose(noisy @ step.rotation @ turn.T, move / np.linalg.norm(move)), k))
    found = turned(given, told)
    assert np.linalg.norm(found.along_deg) == pytest.approx(degrees, abs=0.15)
    assert (np.max(found.errors) > 10.0) == (degrees > 0.0), found


@pytest.mark.parametrize("mode", ["mono", "stereo"])
@pytest.mark.parametrize(
    ("wrong", "degrees"), [("", 0.0), ("all turned 5 about z", 5.0), ("all turned 4 about x", 4.0)]
)
def test_cameras_that_are_turned_together(wrong: str, degrees: float, mode: str) -> None:
    tracks = seen(recording(3, wrong, mode, drift_rotation_deg=0.3, drift_translation=0.02))
    found = check_mounting(tracks, in_motion(tracks))
    if not degrees:
        assert found.sound == ["camera 0 is turned on the body as the rig says"] and not found.findings
    else:
        assert [one.causes for one in found.findings] == [
            (f"camera 0 does not fit its place on the body by about {degrees:.0f} degrees",)
        ]


def test_a_turn_is_no_other_mistake_that_explains_turns_alone() -> None:
    """A quaternion that looks ahead is nearly its own with w first, so a pitch of it passes for another turn."""
    drift = {"drift_rotation_deg": 0.05, "drift_translation": 0.005}
    found = examine(seen(recording(3, "all turned 4 about x", "mono", **drift)))
    assert found.causes() == "camera 0 does not fit its place on the body by about 4 degrees", found.summary()
