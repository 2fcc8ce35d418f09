# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that is exposed later is told from one that is off its place, and only where something is wrong."""

from __future__ import annotations

from typing import Any

import pytest

from ba_node.check.diagnosis import Diagnosis
from ba_node.check.examine import examine
from ba_node.check.exposure import find_late
from ba_node.check.tracks import Tracks
from experiments.robustness.faults import SOUND, spoiled
from experiments.robustness.faults.spoil import spoiled_by
from tests.check.set_ups import tracks_in

LOOP: dict[str, Any] = {"path": "loop", "length_m": 30.0, "keyframes": 60}


def tracks(name: str, amount: float | None = None, seed: int = 0, **changes: Any) -> Tracks:
    return tracks_in(spoiled(name, "stereo", amount, seed, **changes).measurements)


@pytest.mark.parametrize(("delay_s", "changes"), [(0.05, {}), (0.02, LOOP), (0.05, LOOP), (0.1, LOOP)])
def test_a_camera_that_is_exposed_later_is_named_alone(delay_s: float, changes: dict[str, Any]) -> None:
    """Else its place, a focal length, its track ids or nothing are blamed."""
    found = examine(tracks("second_late", delay_s, seed=4, **changes))
    assert len(found.findings) == 1 and found.harmful, found.summary()
    (cause,) = found.findings[0].causes
    assert cause.startswith("camera 1 is not synchronised with camera 0"), found.summary()
    assert "after those of camera 0" in cause, cause
    told_ms = float(cause.split(" about ")[1].split(" ms")[0])
    assert abs(told_ms - 1e3 * delay_s) < 0.2 * 1e3 * delay_s, cause


@pytest.mark.parametrize(("degrees", "share"), [(0.5, 0.25), (1.0, 0.2), (2.0, 0.25)])
def test_a_camera_that_is_turned_is_told_from_a_late_one_among_outliers(degrees: float, share: float) -> None:
    """It explains so few tracks that a delay, which explains hardly more, passed for as good."""
    good = {"keyframes": 25, "drift_rotation_deg": 0.02, "drift_translation": 0.002}
    faults = (("camera_turned", degrees), ("outliers_uniform", share))
    for seed in (701, 704):
        found = examine(tracks_in(spoiled_by(faults, "stereo", seed, **good).measurements))
        assert found.harmful and found.causes().startswith("camera 1 does not fit its place on the body"), (
            f"seed {seed}: {found.summary()}"
        )
        assert "synchronised" not in found.causes(), f"seed {seed}: {found.summary()}"


@pytest.mark.parametrize("changes", [{}, LOOP, {"look_deg": 90.0}])
@pytest.mark.parametrize(
    ("fault", "amount"), [(SOUND, None), ("camera_turned", 0.5), ("camera_turned", 3.0), ("focal_off", 1.1),
                          ("baseline_off", 1.1), ("outliers_moving", 0.4)],
)  # fmt: skip
def test_what_is_off_all_the_time_is_no_delay(fault: str, amount: float | None, changes: dict[str, Any]) -> None:
    found = Diagnosis(untold=["nothing"])
    assert find_late(tracks(fault, amount, seed=5, **changes), found) is found
