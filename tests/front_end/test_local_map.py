# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Where points appear: alone, and with how their patches look, by two ways."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end.local_map import LocalMap
from ba_node.front_end.rectify import ideal_rig
from tests.front_end import world

pytest.importorskip("cv2", reason="needs opencv: pip install ba_node[front_end]")


def test_points_appear_where_their_warps_have_them() -> None:
    """Of several anchors; with depths, without, at infinity, and behind the camera."""
    rng = np.random.default_rng(8)
    known = LocalMap(ideal_rig(world.rig(), world.SIZE), 5)
    for key in range(3):
        place = Transform(geometry.so3_exp(rng.normal(0.0, 0.1, 3)), rng.normal(0.0, 0.5, 3))
        known.add_keyframe(key, place)
        known.add(key, rng.uniform(0.0, 200.0, (20, 2)), np.zeros((20, 7, 7), np.float32))
    rows = np.arange(10, 60)
    known.place(rows, rng.choice([0.0, 0.05, 1.0], 50), np.full(50, 0.01), np.zeros((50, 2)))
    camera = Transform(geometry.so3_exp(np.array([0.1, 0.2, -0.1])), np.array([0.3, 0.1, -1.5]))
    every = np.arange(60)[::-1]
    uv, warp = known.seen_at(every, camera, 0.2), known.warp(every, camera, 0.2)
    assert uv == pytest.approx(warp.uv, abs=1e-8, nan_ok=True)
    assert 0 < np.isnan(uv).any(axis=1).sum() < 60
