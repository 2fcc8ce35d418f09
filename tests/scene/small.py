# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Small messages, scenes made of them, and what scenes are checked for."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ba_node.config import SceneConfig
from ba_node.measurements import (
    CameraRig,
    FeatureTracks,
    Keyframe,
    LandmarkGuesses,
    Measurement,
)
from ba_node.scene.scene import Scene

IDS = np.array([0, 1, 2**53 + 1, 2**63, 2**64 - 2, 2**64 - 1], np.uint64)


def rig(n: int = 2, **changes: Any) -> CameraRig:
    plain = CameraRig(
        "body",
        tuple(f"camera{i}" for i in range(n)),
        ("plumb_bob",) * n,
        np.tile([500.0, 500.0, 320.0, 240.0], (n, 1)),
        (np.zeros(5),) * n,
        np.zeros((n, 2), np.int64),
        np.array([[0.1 * i, 0.0, 0.0] for i in range(n)]),
        np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
    )
    return dataclasses.replace(plain, **changes)


def keyframe(i: int, session: int = 0, stamp: int | None = None, **changes: Any) -> Keyframe:
    stamp = i if stamp is None else stamp
    plain = Keyframe(session, i, stamp, "map", np.array([0.5 * stamp, 0, 0]), np.array([0, 0, 0, 1.0]))
    return dataclasses.replace(plain, **changes)


def tracks(i: int, camera: int = 0, ids: np.ndarray = IDS, session: int = 0, **changes: Any) -> FeatureTracks:
    uv = np.linspace(100.0, 200.0, 2 * len(ids)).reshape(-1, 2)
    return dataclasses.replace(FeatureTracks(session, i, camera, ids, uv), **changes)


def guesses(ids: np.ndarray = IDS, session: int = 0, **changes: Any) -> LandmarkGuesses:
    position = 1.0 + np.arange(3.0 * len(ids)).reshape(-1, 3)
    return dataclasses.replace(LandmarkGuesses(session, ids, position), **changes)


def scene_of(*measurements: Measurement, **config: Any) -> Scene:
    scene = Scene(SceneConfig(**config))
    for measurement in measurements:
        scene.add(measurement)
    return scene


def content(scene: Scene) -> tuple[Any, ...]:
    """Return what a scene knows, in a form that does not depend on row numbers."""
    views = sorted(
        (
            int(scene.keyframes.keyframe_id[s_kf]),
            int(camera),
            int(scene.landmarks.track_id[s_lm]),
            *map(float, uv),
            float(sigma),
            repr(float(depth)),
        )
        for s_kf, camera, s_lm, uv, sigma, depth in zip(
            scene.observations.keyframe,
            scene.observations.camera,
            scene.observations.landmark,
            scene.observations.uv,
            scene.observations.sigma_px,
            scene.observations.depth_m,
            strict=True,
        )
    )
    rows = np.argsort(scene.landmarks.track_id)
    table = scene.landmarks
    marks = [
        (int(table.track_id[r]), int(table.views[r]), bool(table.has_guess[r]), repr(table.guess[r].tolist()))
        for r in rows
    ]
    poses = [(int(scene.keyframes.keyframe_id[r]), scene.keyframes.position[r].tolist()) for r in scene.order]
    return views, marks, poses, len(scene.pending)


def check_links(scene: Scene) -> None:
    """Check that the views found through the links are those of the table, for every landmark."""
    for row in range(len(scene.landmarks)):
        expected = np.flatnonzero(scene.observations.landmark == row)
        assert sorted(scene.views_of(np.array([row])).tolist()) == expected.tolist()
        assert scene.landmarks.views[row] == len(expected)
    blocks = sorted((b.begin, b.end, row, b.camera) for row, of_row in enumerate(scene.blocks) for b in of_row)
    covered = [i for begin, end, _, _ in blocks for i in range(begin, end)]
    assert covered == list(range(len(scene.observations)))
    for begin, end, row, camera in blocks:
        assert (scene.observations.keyframe[begin:end] == row).all()
        assert (scene.observations.camera[begin:end] == camera).all()
