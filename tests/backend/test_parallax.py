# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""One camera waits for parallax: a drive that begins without any is sound."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.core.result import Status
from ba_node.estimate import Estimate
from ba_node.evaluation.metrics import absolute_error
from experiments.synthetic import SyntheticOptions, generate
from experiments.synthetic.world import Path, World


def begun(at: FloatArray, turned_deg: FloatArray) -> Callable[[World, Path], tuple[World, Path]]:
    """Return what makes a drive begin at places (n,) along its path, in steps of it, turned by angles (n,)."""

    def moved(world: World, path: Path) -> tuple[World, Path]:
        k = np.arange(len(path.position))
        along = np.append(at, at[-1] + 1.0 + k)[: len(k)]
        position = np.stack([np.interp(along, k, axis) for axis in path.position.T], axis=1)
        angle = np.zeros((len(k), 3))
        angle[: len(turned_deg), 2] = np.radians(turned_deg)
        rotation = path.rotation[np.round(along).astype(int)] @ geometry.so3_exp(angle)
        return world, Path(position, rotation, np.interp(along, k, path.distance) + 1e-3 * np.minimum(k, len(at)))

    return moved


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "turned_deg"),
    [
        (np.array([0.0, 0.02]), np.zeros(2)),
        (np.array([0.0, 0.3]), np.zeros(2)),
        (np.zeros(20), np.zeros(20)),
        (0.05 * np.arange(10.0), np.zeros(10)),
        (np.zeros(8), np.linspace(-21.0, 0.0, 8)),
    ],
    ids=["near first pair", "nearer than usual", "stands for 5 s", "creeps", "turns on the spot"],
)
def test_one_camera_waits_for_parallax(at: FloatArray, turned_deg: FloatArray) -> None:
    """A sound drive that begins with none is refined once there is some, and there is nothing to look at."""
    small = {"landmarks": 600, "tracks": 60, "path": "line", "length_m": 12.0, "outlier_share": 0.0, "guesses": True}
    drift = {"baseline_m": 0.0, "drift_rotation_deg": 0.3, "drift_translation": 0.02}
    options = SyntheticOptions(keyframes=len(at) + 14, **small, **drift)  # type: ignore[arg-type]
    data = generate(options, begun(at, turned_deg))
    backend = Backend(Config())
    stream = (measurement for _, _, measurement in data.timeline())
    found = [one for one in backend.replay(stream) if isinstance(one, Estimate)]
    waited = [one.report.status is Status.SKIPPED for one in found]
    assert all(a or one.report.status.usable for a, one in zip(waited, found, strict=True))
    assert waited == sorted(waited, reverse=True), "once it has begun it goes on"
    assert not backend.scene.log.warnings
    assert backend.scene.keyframes.refined[backend.scene.order[len(at) :]].all()
    before, after = (absolute_error(one, data.truth).translation.rmse for one in (data.odometry, found[-1].trajectory))
    assert after < 1.1 * before, f"{before:.4f} -> {after:.4f} m"
