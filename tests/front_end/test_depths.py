# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images that are no good: it is said what is wrong with them."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.config.front_end import FrontEndOptions
from ba_node.front_end import FrontEnd
from tests.front_end import world

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")


@pytest.mark.parametrize(
    ("factor", "begins", "words"),
    [
        (1.0, True, ""),
        (0.0, False, "has no depth (all 0 or NaN): check its topic"),
        (np.nan, False, "has no depth (all 0 or NaN): check its topic"),
        (1000.0, True, "32FC1 is in m, 16UC1 in mm; are these millimetres?"),
    ],
)
def test_an_empty_depth_image_or_one_in_another_unit_is_said(factor: float, begins: bool, words: str) -> None:
    rig = world.rig(1)
    one = world.images(rig, world.drive(1)[0], 0, depth=True)
    assert one.depth_m is not None
    told = FrontEnd(rig, FrontEndOptions(max_features=200)).process(world.without(one, depth_m=factor * one.depth_m))
    assert (told.keyframe is not None) == begins
    assert any(words in note for note in told.notes) if words else not told.notes, told.notes
