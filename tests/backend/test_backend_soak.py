# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Thousands of keyframes: what is kept stays within its bounds."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.measurements import FeatureTracks, Keyframe
from ba_node.scene.tables import Table
from tests.soak.drive import Drive

ROUNDS, LENGTH = 40, 50
SESSION_ROUNDS = 4
LIMITS = {
    "scene.max_keyframes": 120,
    "scene.max_landmarks": 2000,
    "scene.max_pending": 20,
    "window.max_keyframes": 4,
    "window.max_fixed_keyframes": 2,
    "solver.max_iterations": 2,
}


def sizes(backend: Backend) -> dict[str, int]:
    """Return how much the back-end holds: rows in use, rows of memory, and what waits."""
    scene = backend.scene
    tables: dict[str, Table] = {
        "keyframes": scene.keyframes, "landmarks": scene.landmarks, "observations": scene.observations
    }  # fmt: skip
    rows = {name: len(table) for name, table in tables.items()}
    room = {f"room for {name}": max(map(len, table._buffers.values())) for name, table in tables.items()}
    blocks = sum(len(blocks) for blocks in scene.blocks)
    others = {"pending": len(scene.pending), "blocks": blocks, "ids": len(scene._landmark_rows)}
    return {
        **rows, **room, **others, "notes": len(backend.rejection_notes), "keyframe rows": len(scene._keyframe_rows)
    }  # fmt: skip


@pytest.mark.slow
def test_sizes_stay_within_bounds_over_thousands_of_keyframes() -> None:
    """A drive is repeated with new ids; some tracks name keyframes that never come, and sessions end."""
    drive = Drive(length=LENGTH, tracks=40, session_rounds=SESSION_ROUNDS)
    backend = Backend(Config().with_values(LIMITS))
    backend.add(drive.rig)
    largest: list[dict[str, int]] = []
    rejected = 0
    frames = drive.frames()
    for _ in range(ROUNDS):
        for keyframe, *images in itertools.islice(frames, LENGTH):
            assert isinstance(keyframe, Keyframe)
            backend.add(keyframe)
            for image in images:
                backend.add(image)
            assert isinstance(images[0], FeatureTracks)
            backend.add(dataclasses.replace(images[0], keyframe_id=2**63 + keyframe.keyframe_id))
            estimate = backend.solve()
            assert estimate is not None
            assert np.isfinite(estimate.trajectory.position).all()
        rejected += backend.map.rejected.total()
        largest.append(sizes(backend))
    assert rejected > ROUNDS * LENGTH / 2, f"{rejected} messages turned away: the test is to have many"
    n_obs = 2 * 40 * LIMITS["scene.max_keyframes"]
    bounds = {
        "keyframes": 120, "landmarks": 2000, "observations": n_obs, "ids": 2000, "keyframe rows": 120,
        "blocks": 2 * 120, "pending": 20, "notes": 50, "room for keyframes": 4 * 120,
        "room for landmarks": 4 * 2000, "room for observations": 4 * n_obs,
    }  # fmt: skip
    for name, bound in bounds.items():
        most = max(size[name] for size in largest)
        assert most <= bound, f"{name}: {most}, at most {bound}"
    early, late = largest[: ROUNDS // 2], largest[ROUNDS // 2 :]
    for name in bounds:
        first, second = (max(size[name] for size in part) for part in (early, late))
        assert second <= first, f"{name} still grows: {first}, then {second}"
