# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ba_node.config import SceneConfig
from ba_node.measurements import (
    CameraRig,
    FeatureTracks,
    Keyframe,
    LandmarkGuesses,
    Measurement,
)
from ba_node.scene.scene import Scene
from tests.scene.small import IDS, check_links, content, guesses, keyframe, rig, scene_of, tracks

some_ids = st.lists(st.sampled_from(IDS.tolist()), min_size=0, max_size=6).map(lambda x: np.array(x, np.uint64))


coordinates = st.floats(-2000, 2000) | st.sampled_from([np.nan, np.inf, -np.inf, 1e9, 0.0])


@st.composite
def some_tracks(draw: st.DrawFn) -> FeatureTracks:
    ids = draw(some_ids)
    n = len(ids) if draw(st.integers(0, 9)) else draw(st.integers(0, 6))
    values = [draw(st.lists(coordinates, min_size=k, max_size=k)) for k in (2 * n, len(ids), len(ids))]
    uv, sigma, depth = (np.array(v, float) for v in values)
    return FeatureTracks(
        draw(st.integers(0, 1)),
        draw(st.integers(0, 4) | st.just(2**64 - 1)),
        draw(st.integers(0, 3)),
        ids,
        uv.reshape(-1, 2),
        sigma if draw(st.booleans()) else np.empty(0),
        depth if draw(st.booleans()) else np.empty(0),
        draw(st.sampled_from(["", "", "", "bad"])),
    )


@st.composite
def some_keyframe(draw: st.DrawFn) -> Keyframe:
    position = np.array([draw(coordinates) for _ in range(3)])
    if draw(st.booleans()):
        position = np.nan_to_num(position, posinf=1.0, neginf=0.0)
    quaternion = np.array(draw(st.sampled_from([[0, 0, 0, 1.0], [0, 0, 0, 0.0], [1, 1, 0, 0], [np.nan, 0, 0, 1]])))
    number = draw(st.integers(0, 4) | st.just(2**64 - 1))
    return Keyframe(draw(st.integers(0, 1)), number, draw(st.integers(-5, 5)), "map", position, quaternion)


@st.composite
def some_guesses(draw: st.DrawFn) -> LandmarkGuesses:
    ids = draw(some_ids)
    position = np.array([draw(coordinates) for _ in range(3 * len(ids))], float).reshape(-1, 3)
    return LandmarkGuesses(draw(st.integers(0, 1)), ids, position)


some_rig = st.sampled_from([rig(1), rig(2), rig(3), rig(0), rig(models=("plumb_bob", "unknown"))])


some_measurement = some_tracks() | some_keyframe() | some_guesses() | some_rig


@settings(max_examples=80)
@given(st.lists(some_measurement, max_size=25))
def test_no_stream_raises_or_breaks_the_links(stream: list[Measurement]) -> None:
    scene = Scene(SceneConfig(max_pending=3))
    for measurement in stream:
        known = {int(k) for k in scene.keyframes.keyframe_id}
        scene.add(measurement)
        assert known <= {int(k) for k in scene.keyframes.keyframe_id}
        assert len(scene.pending) <= 3
    assert np.isfinite(scene.keyframes.position).all()
    assert np.isfinite(scene.observations.uv).all()
    assert (scene.observations.sigma_px > 0).all()
    assert np.isfinite(scene.landmarks.guess[scene.landmarks.has_guess]).all()
    check_links(scene)


@settings(max_examples=60)
@given(st.lists(some_measurement, max_size=15), st.randoms(use_true_random=False))
def test_sending_everything_again_changes_only_counters(stream: list[Measurement], random: Any) -> None:
    scene = scene_of(*stream)
    scene.end_pending()
    before = content(scene)
    again = [m for m in stream if not isinstance(m, CameraRig)]
    random.shuffle(again)
    known = {int(k) for k in scene.keyframes.keyframe_id}
    for measurement in again:
        # Tracks that had no keyframe or no such camera may only wait again; a first keyframe cannot be repeated.
        if not isinstance(measurement, FeatureTracks) or (measurement.keyframe_id in known and scene.cameras):
            scene.add(measurement)
    scene.end_pending()
    assert content(scene) == before


@settings(max_examples=60)
@given(st.permutations(range(7)), st.integers(2, 7))
def test_order_within_a_keyframe_does_not_matter(order: list[int], split: int) -> None:
    messages: list[Measurement] = [
        rig(),
        keyframe(1),
        tracks(1),
        tracks(1, camera=1, ids=IDS[::2]),
        guesses(ids=IDS[:3]),
        guesses(ids=IDS[3:]),
        tracks(1, camera=0, ids=np.array([77], np.uint64)),
    ]
    shuffled = [messages[i] for i in order]
    scene = scene_of(*shuffled[:split], *shuffled)
    assert content(scene) == content(scene_of(*messages))
