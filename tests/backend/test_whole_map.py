# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Estimates share what has not changed, and stay as they were."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Cloud, Estimate, Poses
from ba_node.measurements import Measurement
from ba_node.scene.scene import Scene
from tests.soak.drive import Drive

LIMITS = {"window.max_keyframes": 5, "window.max_fixed_keyframes": 3, "solver.max_iterations": 3}


def as_in_the_tables(scene: Scene) -> tuple[Poses, Cloud]:
    """Return all poses and points by the other route: straight from the tables, row by row."""
    frames, points = scene.keyframes, scene.landmarks
    order = sorted(range(len(frames)), key=lambda row: (int(frames.stamp_ns[row]), row))
    good = [row for row in range(len(points)) if points.has_position[row] and points.views[row] > 1]
    by_id = sorted(good, key=lambda row: int(points.track_id[row]))
    orientation = geometry.quaternion_from_matrix(frames.rotation[order])
    poses = Poses(frames.keyframe_id[order], frames.stamp_ns[order], frames.position[order], orientation)
    cloud = Cloud(points.track_id[by_id], points.position[by_id], points.rms_px[by_id], points.views[by_id])
    return poses, cloud


def assert_same(found: Poses | Cloud, expected: Poses | Cloud) -> None:
    assert len(found) == len(expected)
    for name, values in vars(expected).items():
        assert np.array_equal(getattr(found, name), values, equal_nan=True), name


def shuffled(frames: Iterator[tuple[Measurement, ...]]) -> Iterator[tuple[Measurement, ...]]:
    """Yield frames with two in every seven in the wrong order."""
    while True:
        block = list(itertools.islice(frames, 7))
        yield from (*block[:3], block[4], block[3], *block[5:])


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{}, {"scene.max_keyframes": 25, "scene.max_landmarks": 300}])
def test_an_estimate_is_the_map_at_its_moment(limits: dict[str, int]) -> None:
    drive = Drive(length=20, tracks=25, session_rounds=0)
    backend = Backend(Config().with_values(LIMITS | limits))
    backend.add(drive.rig)
    kept: list[tuple[Estimate | None, tuple[Poses, Cloud]]] = []
    for count, frame in enumerate(itertools.islice(shuffled(drive.frames()), 70), start=1):
        for measurement in frame:
            backend.add(measurement)
        kept.append((backend.solve(), as_in_the_tables(backend.scene)))
        if count in (20, 50):
            kept.append((backend.optimize(), as_in_the_tables(backend.scene)))
        if count == 40:
            backend.scene.forget_solutions()
            kept.append((backend.estimate(), as_in_the_tables(backend.scene)))
    assert backend.map.rejected.total() < 20, backend.rejection_notes
    for estimate, (poses, cloud) in kept:
        assert estimate is not None
        assert_same(estimate.trajectory[-3:], poses[-3:])
        assert_same(estimate.trajectory, poses)
        assert_same(estimate.cloud, cloud)
        assert set(estimate.refined.keyframe_id.tolist()) <= set(poses.keyframe_id.tolist())


def test_what_has_not_changed_is_shared() -> None:
    """Of a map of thousands of keyframes a solve copies the pieces that its window lies in."""
    backend = Backend(Config())
    scene = backend.scene
    scene.landmarks.append(5000, track_id=np.arange(5000))
    first = scene.landmarks.copy()
    scene.landmarks.changed(np.array([4999, 4100]))
    second = scene.landmarks.copy()
    assert len(first.pieces) == len(second.pieces) == 10
    assert [a is b for a, b in zip(first.pieces, second.pieces, strict=True)] == [True] * 8 + [False] * 2
