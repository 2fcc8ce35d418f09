# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.window.view import view


def test_view_tells_who_sees_the_same_and_how_well() -> None:
    # Keyframe 0 sees points 0 and 1, 1 sees 0, 1 (with two cameras) and 2, 2 sees 2; the third residual is (3, 4) px.
    keyframe, camera, point = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [1, 0, 2], [2, 0, 2]]).T
    uv = np.zeros((7, 2))
    uv[2] = (3.0, 4.0)
    points = np.tile([0.0, 0.0, 5.0], (3, 1))
    state = State(np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)), points, np.empty((0, 3)))
    params = np.zeros((2, 12))
    params[:, :2] = 100.0
    cameras = Cameras(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.zeros(2, np.uint8), params)
    obs = Observations(keyframe, camera, point, uv, np.ones(7), np.empty(0), np.empty(0))
    problem = Problem(state, np.array([True, False, False]), cameras, obs)

    got = view(problem, state, np.ones(7, bool), np.array([0, 2, 3]), 4)
    assert got.free.tolist() == [False, False, True, True]
    assert got.links.tolist() == [[0, 2], [2, 3]]
    assert got.shared.tolist() == [2, 1]
    np.testing.assert_allclose(got.frusta[0], [[0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]])
    np.testing.assert_allclose(got.rms_px, [2.5, np.nan, 0.0, 0.0])
    without = view(problem, state, np.arange(7) != 2, np.array([0, 2, 3]), 4)
    np.testing.assert_allclose(without.rms_px, [0.0, np.nan, 0.0, 0.0])
