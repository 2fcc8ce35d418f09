# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements whose parts do not fit together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.core.priors import root_information
from ba_node.measurements import CameraRig
from ba_node.scene.constraints import positive_covariance
from ba_node.scene.ingest import rig_cameras
from ba_node.scene.rejections import RejectionLog


@pytest.mark.parametrize(
    "change",
    [
        {"names": ("left",)},
        {"image_size": np.zeros((1, 2), np.int64)},
        {"distortion": ()},
        {"position": np.zeros((3, 3))},
        {"intrinsics": np.zeros((2, 3))},
    ],
    ids=lambda change: next(iter(change)),
)
def test_rig_of_different_lengths_is_refused(rig: CameraRig, change: dict[str, object]) -> None:
    log = RejectionLog()
    assert rig_cameras(dataclasses.replace(rig, **change), log) is None  # type: ignore[arg-type]
    assert log.rejected == {"bad_rig": 1}
    assert "camera rig of 2 cameras: shapes " in log.notes[-1]


def test_variances_that_say_unknown_leave_the_others_as_they_are() -> None:
    """1e223 m^2 beside 1 once left no inverse."""
    log = RejectionLog()
    told = np.diag([1.0, 1e-4, 1e223])
    found = positive_covariance("one", told, 3, log)
    assert found is not None and not log.rejected
    np.testing.assert_allclose(found, np.diag([1.0, 1e-4, 1e8]), atol=1e-6)
    turn = geometry.so3_exp(np.array([0.3, -0.5, 0.7]))
    information = root_information(turn @ found @ turn.T)
    expected = turn @ np.diag([1.0, 1e4, 1e-8]) @ turn.T
    np.testing.assert_allclose(information.T @ information, expected, atol=0.1)
