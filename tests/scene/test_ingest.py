# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements whose parts do not fit together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.measurements import CameraRig
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
