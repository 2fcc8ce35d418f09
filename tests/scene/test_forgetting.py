# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from ba_node.measurements import (
    GravityDirection,
    PosePrior,
    RelativePose,
)
from tests.scene.small import check_links, keyframe, rig, scene_of, tracks


def test_waiting_is_bounded_and_given_up_in_the_end() -> None:
    scene = scene_of(rig(), keyframe(0), *(tracks(i) for i in range(1, 6)), max_pending=3)
    assert scene.log.rejected == {"unknown_keyframe": 2}
    assert [t.keyframe_id for t in scene.pending] == [3, 4, 5]
    scene.end_pending()
    assert scene.log.rejected == {"unknown_keyframe": 5}
    without_rig = scene_of(keyframe(0), *(tracks(0, camera=i) for i in range(5)), max_pending=3)
    assert without_rig.log.rejected == {"pending_overflow": 2}


def test_the_oldest_keyframes_are_forgotten_with_their_observations() -> None:
    scene = scene_of(rig(), max_keyframes=20)
    for i in range(100):
        scene.add(keyframe(i))
        scene.add(tracks(i, ids=np.array([i // 2, 1000], np.uint64)))
        assert len(scene.keyframes) <= 20
    assert [int(k) for k in scene.keyframes.keyframe_id][-1] == 99
    assert len(scene.observations) == 2 * len(scene.keyframes)
    check_links(scene)


def test_landmarks_seen_longest_ago_are_forgotten() -> None:
    scene = scene_of(rig(), max_landmarks=100)
    for i in range(30):
        scene.add(keyframe(i))
        scene.add(tracks(i, ids=np.array([2**64 - 1, *range(10 * i, 10 * i + 10)], np.uint64)))
        assert len(scene.landmarks) <= 100
    known = {int(t) for t in scene.landmarks.track_id}
    assert set(range(290, 300)) | {2**64 - 1} <= known
    assert not known & set(range(150))
    check_links(scene)


def test_observations_are_bounded_however_many_an_image_shows() -> None:
    """The oldest keyframes go, a tenth of the bound at once, and no row of what stays is lost."""
    scene, n = scene_of(rig(), max_observations=1000), 0
    for i in range(300):
        ids = np.arange(10 * i, 10 * i + 60 + i % 7, dtype=np.uint64)
        scene.add(keyframe(i))
        scene.add(tracks(i, ids=ids))
        assert len(scene.observations) <= 1000 + len(ids)
        n = max(n, len(scene.observations))
        assert int(scene.keyframes.keyframe_id[scene.order[-1]]) == i
        last = scene.blocks[scene.order[-1]][0]
        seen = scene.landmarks.track_id[scene.observations.landmark[last.begin : last.end]]
        assert seen.tolist() == ids.tolist()
    assert n > 950
    scene.add(tracks(299, camera=1, ids=np.arange(5000, dtype=np.uint64)))
    scene.add(keyframe(300))
    assert scene.keyframes.keyframe_id.tolist() == [299, 300], "the newest stay, whatever they see"


def test_what_hangs_on_forgotten_keyframes_is_forgotten_too() -> None:
    scene, eye = scene_of(max_keyframes=20), np.eye(6)
    origin, upright = np.zeros(3), np.array([0.0, 0, 0, 1])
    for i in range(200):
        scene.add(keyframe(i))
        scene.add(RelativePose(0, i, i + 1, False, origin, upright, eye.ravel()))
        scene.add(GravityDirection(0, i, np.array([0.0, 0, 1]), 0.01))
        scene.add(PosePrior(i, "site", origin, upright, eye.ravel()))
    kept = scene.keyframes.keyframe_id.tolist()
    assert len(kept) <= 20
    known = scene.constraints
    assert list(known.relative) == [(key, key + 1) for key in kept]
    assert list(known.gravity) == kept
    assert [one.stamp_ns for one in known.absolute] == kept
