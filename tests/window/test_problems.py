# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ba_node.config import Config
from ba_node.scene.scene import Scene
from ba_node.window.problems import part_of, problem_of, some_observations
from experiments.synthetic import SyntheticOptions, generate


@pytest.mark.parametrize("depth_share", [0.0, 0.5])
def test_a_part_is_what_would_have_been_made_of_its_rows(depth_share: float) -> None:
    settings = Config()
    scene = Scene(settings.scene)
    for _, _, measurement in generate(
        SyntheticOptions(seed=5, keyframes=8, tracks=40, length_m=12.0, depth_share=depth_share, ids="random64")
    ).timeline():
        scene.add(measurement)
    rng = np.random.default_rng(0)
    rows = np.arange(len(scene.observations))
    landmarks = rng.permutation(len(scene.landmarks))
    origin, positions = np.array([1.0, 2.0, 3.0]), rng.normal(size=(len(landmarks), 3))
    whole, rows = problem_of(scene, rows, scene.order, landmarks, origin, positions, settings)
    obs = whole.observations
    keys = np.stack([obs.point, obs.keyframe, obs.camera])
    assert (np.lexsort(keys[::-1]) == np.arange(len(obs))).all(), "sorted by point, keyframe, camera"
    keyframes, points = rng.random(len(scene.order)) < 0.7, rng.random(len(landmarks)) < 0.7
    kept = np.flatnonzero(keyframes[obs.keyframe] & points[obs.point])
    assert 10 < len(kept) < len(obs) - 10
    part = part_of(whole, kept, points, keyframes)
    again, _ = problem_of(
        scene,
        rng.permutation(rows[kept]),
        scene.order[keyframes],
        landmarks[points],
        origin,
        positions[points],
        settings,
    )
    for a, b in ((part.start, again.start), (part.observations, again.observations)):
        for name, value in vars(a).items():
            np.testing.assert_array_equal(value, getattr(b, name), err_msg=name)
    np.testing.assert_array_equal(some_observations(whole, kept).observations.uv, part.observations.uv)
