# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ba_node import native
from ba_node.config import Config
from ba_node.scene.scene import Scene
from experiments.synthetic import SyntheticOptions, generate


@pytest.fixture(params=["C++", "numpy"])
def scene(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Return a scene whose keyframes came out of order, with and without the C++ kernels."""
    if request.param == "numpy":
        monkeypatch.setattr(native, "kernels", None)
    elif native.kernels is None:
        pytest.skip("the C++ kernels are not built")
    options = SyntheticOptions(seed=5, keyframes=9, tracks=40, length_m=12.0, depth_share=0.3, ids="random64")
    data, found = generate(options), Scene(Config().scene)
    found.add(data.rig)
    for k in np.random.default_rng(1).permutation(len(data.keyframes)).tolist():
        for measurement in (data.keyframes[k], *data.tracks[k]):
            found.add(measurement)
    found.observations.outlier[::7] = True
    return found


def test_views_are_all_rows_of_the_landmarks(scene: Scene) -> None:
    landmarks = np.random.default_rng(2).permutation(len(scene.landmarks))[:60]
    expected = np.flatnonzero(np.isin(scene.observations.landmark, landmarks))
    np.testing.assert_array_equal(np.sort(scene.views_of(landmarks)), expected)
    newest = scene.views_of(landmarks, 3)
    for landmark in landmarks.tolist():
        of = np.flatnonzero(scene.observations.landmark == landmark)
        np.testing.assert_array_equal(np.sort(newest[scene.observations.landmark[newest] == landmark]), of[-3:])


def test_what_keyframes_see_is_sorted_by_track_id(scene: Scene) -> None:
    keyframes = scene.order[2:6]
    expected = np.unique(scene.observations.landmark[np.isin(scene.observations.keyframe, keyframes)])
    found = scene.seen_by(keyframes)
    np.testing.assert_array_equal(np.sort(found), expected)
    assert (np.diff(scene.landmarks.track_id[found].astype(object)) > 0).all(), "by track id"
    assert len(scene.seen_by(keyframes[:0])) == 0, "nobody sees nothing"


def test_inliers_are_counted_by_keyframe(scene: Scene) -> None:
    rows = np.arange(0, len(scene.observations), 2)
    keyframes, counts = scene.inliers_by_keyframe(rows)
    expected = np.bincount(scene.observations.keyframe[rows][~scene.observations.outlier[rows]])
    found = np.zeros(len(expected), int)
    found[keyframes] = counts
    np.testing.assert_array_equal(found, expected)


def test_views_are_gathered_in_the_order_of_the_lists(scene: Scene) -> None:
    rng, table = np.random.default_rng(3), scene.observations
    keyframes = scene.order[rng.permutation(len(scene.order))[:6]]
    landmarks = rng.permutation(len(scene.landmarks))
    rows, keyframe, camera, point, uv, sigma_px, depth_m = scene.gather(
        rng.permutation(len(table)), keyframes, landmarks
    )
    np.testing.assert_array_equal(np.sort(rows), np.flatnonzero(np.isin(table.keyframe, keyframes)))
    np.testing.assert_array_equal(np.lexsort((camera, keyframe, point)), np.arange(len(rows)))
    np.testing.assert_array_equal(keyframes[keyframe], table.keyframe[rows])
    np.testing.assert_array_equal(landmarks[point], table.landmark[rows])
    for found, column in ((camera, table.camera), (uv, table.uv), (sigma_px, table.sigma_px), (depth_m, table.depth_m)):
        np.testing.assert_array_equal(found, column[rows])
    in_order = scene.gather(rows, keyframes, landmarks)
    for again, before in zip(in_order, (rows, keyframe, camera, point, uv, sigma_px, depth_m), strict=True):
        np.testing.assert_array_equal(again, before)
    without = rows[np.isnan(table.depth_m[rows])]
    assert scene.gather(without, keyframes, landmarks)[-1].shape == (0,), "none was measured"
    # What is kept for the next call is as it was.
    np.testing.assert_array_equal(scene.numbers(table.keyframe[rows], keyframes), keyframe)
    np.testing.assert_array_equal(scene.numbers(table.landmark[rows], landmarks), point)
