# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A fisheye camera of 190 degrees: what it sees behind its image plane takes part."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import cameras
from ba_node.evaluation.alignment import align
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement

INTRINSICS = np.array([200.0, 200.0, 335.0, 335.0])
DISTORTION = np.array([0.01, -2e-3, 3e-4, -2e-5])
WIDEST = np.deg2rad(95.0)
N = 16


def scene(seed: int = 0) -> tuple[CameraRig, np.ndarray, np.ndarray]:
    """Return a rig that looks up, true positions along x, and points in a half-space and a little below."""
    rng = np.random.default_rng(seed)
    position = np.array([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0]])
    rig = CameraRig(
        "body",
        ("left", "right"),
        ("equidistant",) * 2,
        np.tile(INTRINSICS, (2, 1)),
        (DISTORTION,) * 2,
        np.full((2, 2), 670),
        position,
        np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
    )
    angle = np.arccos(rng.uniform(np.cos(WIDEST) - 0.05, 1.0, 700))
    turn, distance = rng.uniform(0.0, 2.0 * np.pi, 700), rng.uniform(1.5, 6.0, 700)
    ray = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    centres = np.stack([0.15 * np.arange(N), 0.1 * np.sin(0.5 * np.arange(N)), np.zeros(N)], axis=1)
    return rig, centres, ray * distance[:, None] + [0.07 * N, 0.0, 0.0]


def stream(only_in_front: bool) -> Iterator[Measurement]:
    rig, centres, points = scene()
    rng = np.random.default_rng(1)
    yield rig
    drift = np.cumsum(rng.normal(0.0, 0.01, (N, 3)), axis=0)
    model, params = cameras.parameters("equidistant", INTRINSICS, DISTORTION)
    for k in range(N):
        turned = np.append(0.5 * rng.normal(0.0, 0.01, 3), 1.0)
        yield Keyframe(0, k, 10**9 * k, "odom", centres[k] + drift[k] - drift[0], turned / np.linalg.norm(turned))
        for c in range(2):
            x = points - centres[k] - rig.position[c]
            angle = np.arccos(x[:, 2] / np.linalg.norm(x, axis=1))
            seen = np.flatnonzero(angle < (np.pi / 2 if only_in_front else WIDEST))
            uv = cameras.project(x[seen], np.array([model], np.uint8), params[None])
            noise = rng.normal(0.0, 0.3, (len(points), 2))[seen]
            yield FeatureTracks(0, k, c, seen.astype(np.uint64), uv + noise)


def run(only_in_front: bool, backend: str = "auto") -> Backend:
    config = Config().with_values({"solver.kernels": backend})
    node = Backend(config)
    for _event in node.replay(stream(only_in_front)):
        pass
    return node


def error_of(node: Backend, refined: bool) -> float:
    table = node.scene.keyframes
    position = table.position if refined else table.input_position
    moved = align(position, scene()[1], "se3").apply(position)
    return float(np.sqrt(np.mean(np.sum((moved - scene()[1]) ** 2, axis=1))))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["auto", "numpy"])
def test_what_is_seen_beyond_90_degrees_takes_part(backend: str) -> None:
    node = run(False, backend)
    table, points = node.scene.observations, node.scene.landmarks
    rig, centres, true = scene()
    track = points.track_id[table.landmark].astype(int)
    x = true[track] - centres[table.keyframe] - rig.position[table.camera]
    beyond = x[:, 2] < 0.0
    assert np.count_nonzero(beyond) > 500
    used = ~table.outlier & points.has_position[table.landmark]
    assert np.mean(used[beyond]) > 0.98
    assert error_of(node, refined=True) < 0.3 * error_of(node, refined=False)
    assert not node.scene.log.rejected


@pytest.mark.slow
def test_it_is_worth_more_than_the_front_alone() -> None:
    whole, front = run(False), run(True)
    assert len(whole.scene.observations) > len(front.scene.observations) + 500
    assert error_of(whole, refined=True) < 1.1 * error_of(front, refined=True)


@pytest.mark.slow
def test_a_depth_across_the_axis_is_no_distance() -> None:
    """A depth of a ray that points back contradicts it; it is left to the residuals to say so."""
    node = Backend(Config())
    for measurement in stream(False):
        one = measurement
        if isinstance(measurement, FeatureTracks):
            one = dataclasses.replace(measurement, depth_m=np.full(len(measurement.track_id), np.nan))
        if node.completes(one):
            node.solve()
        node.add(one)
    node.flush(final=True)
    assert node.solve() is not None
