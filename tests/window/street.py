# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A street and a loop, with wheel odometry, a receiver of GNSS, and tracks that are the same points."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Estimate
from ba_node.measurements import GlobalFix, Keyframe, Measurement, RelativePose
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from experiments.synthetic.world import Path as Motion
from experiments.synthetic.world import World

pymap3d = pytest.importorskip("pymap3d", reason="needs pymap3d")
ORIGIN = (48.0, 11.0, 500.0)
ARM = np.array([0.5, 0.1, 1.2])
TURN, SHIFT = geometry.so3_exp(np.array([0.0, 0.0, 0.7])), np.array([120.0, -40.0, 3.0])
More = Callable[[int, Keyframe], Iterable[Measurement]]


def stream(data: SyntheticData, more: More) -> Iterator[Measurement]:
    """Yield a recording, and more after each keyframe."""
    number = 0
    for _, _, measurement in data.timeline():
        yield measurement
        if isinstance(measurement, Keyframe):
            yield from more(number, measurement)
            number += 1


def replayed(data: SyntheticData, more: More = lambda *_: (), **values: object) -> tuple[Backend, Estimate]:
    """Return a back-end that has seen a recording, and its last estimate."""
    backend = Backend(Config().with_values(values))
    estimates = [event for event in backend.replay(stream(data, more)) if isinstance(event, Estimate)]
    return backend, estimates[-1]


def aligned_rms(position: FloatArray, truth: FloatArray) -> float:
    """Return the rms distance after the best rotation and translation, m."""
    here, there = position - position.mean(axis=0), truth - truth.mean(axis=0)
    turn = geometry.nearest_rotation(there.T @ here)
    return float(np.sqrt(np.mean(np.sum((here @ turn.T - there) ** 2, axis=1))))


def error_in_world(estimate: Estimate, data: SyntheticData) -> float:
    """Return the rms distance to the truth in the world that :func:`fixes` are in, m."""
    assert estimate.world is not None and estimate.world.geodetic is not None
    turn = geometry.matrix_from_quaternion(estimate.world.orientation)
    here = estimate.trajectory.position @ turn.T + estimate.world.position
    here = here + np.array(pymap3d.geodetic2enu(*estimate.world.geodetic, *ORIGIN))
    there = data.truth.position @ TURN.T + SHIFT
    return float(np.sqrt(np.mean(np.sum((here - there) ** 2, axis=1))))


def street_data(**changes: Any) -> SyntheticData:
    """Return a street of 300 m that few tracks with much noise show: vision drifts by metres."""
    options = SyntheticOptions(
        seed=3, keyframes=100, length_m=250.0, landmarks=5000, path="line", noise_px=1.0, tracks=60, track_loss=0.1,
        max_range_m=40.0, reobserve=False, drift_rotation_deg=0.3, drift_translation=0.02,
    )  # fmt: skip
    return generate(dataclasses.replace(options, **changes))


def first(data: SyntheticData, n: int) -> SyntheticData:
    """Return the first keyframes of a recording."""
    return dataclasses.replace(data, keyframes=data.keyframes[:n], tracks=data.tracks[:n], guesses=data.guesses[:n])


def fixes(data: SyntheticData, outliers: float) -> More:
    """Return a receiver of 1 m noise on an antenna beside the body; some fixes are 1 km off."""
    rng, rotation = np.random.default_rng(1), geometry.matrix_from_quaternion(data.truth.orientation)

    def of(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        place = TURN @ (data.truth.position[k] + rotation[k] @ ARM) + SHIFT + rng.normal(0.0, 1.0, 3)
        place = place + 1000.0 * (rng.random() < outliers) * np.array([0.6, -0.8, 0.0])
        geodetic = np.array(pymap3d.enu2geodetic(*place, *ORIGIN), float)
        yield GlobalFix(keyframe.stamp_ns, "gps", geodetic, np.eye(3).ravel(), is_fix=True)

    return of


def wheels(data: SyntheticData) -> More:
    """Return wheel odometry of 1 %."""
    rng, rotation = np.random.default_rng(2), geometry.matrix_from_quaternion(data.truth.orientation)

    def of(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        if k == 0:
            return
        back = geometry.inverse(rotation[k - 1], data.truth.position[k - 1])
        turn, move = geometry.compose(*back, rotation[k], data.truth.position[k])
        sigma = np.array([0.01 * np.linalg.norm(move)] * 3 + [0.002] * 3)
        turn, move = turn @ geometry.so3_exp(rng.normal(0.0, sigma[3:])), move + rng.normal(0.0, sigma[:3])
        before = int(data.truth.keyframe_id[k - 1])
        pose = move, geometry.quaternion_from_matrix(turn)
        yield RelativePose(0, before, keyframe.keyframe_id, False, *pose, np.diag(sigma**2).ravel())

    return of


ANTENNA = {"factors.antenna_x_m": 0.5, "factors.antenna_y_m": 0.1, "factors.antenna_z_m": 1.2}


def round_trip(noise_px: float, **changes: Any) -> SyntheticData:
    """Return a loop of which the last keyframes see the first ones' points again, under other ids."""
    n = 200
    options = SyntheticOptions(
        seed=3, keyframes=n, length_m=200.0, landmarks=12000, reobserve=False, noise_px=noise_px, tracks=150,
        track_loss=0.3, drift_rotation_deg=3.0, drift_translation=0.02,
    )  # fmt: skip

    def again(world: World, path: Motion) -> tuple[World, Motion]:
        rows = np.concatenate([np.linspace(0, n - 1, n - 12).round().astype(int)[:-1], np.arange(13)])
        step = np.linalg.norm(np.diff(path.position[rows], axis=0), axis=1)
        return world, Motion(path.position[rows], path.rotation[rows], np.append(0.0, np.cumsum(step + 1e-3)))

    return generate(dataclasses.replace(options, **changes), again)


def merges(data: SyntheticData, count: int = 20) -> list[tuple[int, int]]:
    """Return pairs of late and early tracks of the same points."""
    n = len(data.keyframes)
    last: dict[int, int] = {}
    begun: dict[int, int] = {}
    for k, images in enumerate(data.tracks):
        for track in images[0].track_id.tolist():
            last[track] = k
            begun.setdefault(track, k)
    early = {int(data.track_landmark[t]): t for t in last if last[t] < n // 10}
    late = [t for t in last if begun[t] > n // 2 and last[t] >= n - 6 and int(data.track_landmark[t]) in early]
    return [(t, early[int(data.track_landmark[t])]) for t in late][:count]


def loop_of(data: SyntheticData, n: int) -> RelativePose:
    """Return the true pose of keyframe n - 1 in the first one."""
    rotation = geometry.matrix_from_quaternion(data.truth.orientation)
    back = geometry.inverse(rotation[0], data.truth.position[0])
    turn, move = geometry.compose(*back, rotation[n - 1], data.truth.position[n - 1])
    first_id, last_id = (int(data.truth.keyframe_id[k]) for k in (0, n - 1))
    covariance = np.diag([1e-4] * 3 + [1e-6] * 3).ravel()
    return RelativePose(0, first_id, last_id, True, move, geometry.quaternion_from_matrix(turn), covariance)
