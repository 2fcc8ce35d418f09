# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Rigs that the front-end refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.front_end import FrontEnd, FrontEndError
from ba_node.measurements import CameraRig
from tests.front_end import world


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"position": np.zeros((2, 3))}, "sit in one place"),
        ({"models": ("fov", "fov")}, "distortion_model 'fov'"),
        ({"position": np.array([[0.0, 0, 0], [0, 0, 0.3]])}, "expected two side by side"),
    ],
)
def test_rigs_that_cannot_be_used(changes: dict[str, object], words: str) -> None:
    pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")
    broken: CameraRig = dataclasses.replace(world.rig(), **changes)  # type: ignore[arg-type]
    with pytest.raises(FrontEndError, match=words):
        FrontEnd(broken)
