# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements whose parts do not fit together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.core.priors import root_information
from ba_node.measurements import CameraRig
from ba_node.scene.constraints import positive_covariance
from ba_node.scene.ingest import rig_cameras
from ba_node.scene.rejections import RejectionLog


@pytest.mark.parametrize(
    "change",
    [
        {"names": ("left",)},
        {"image_size": np.zeros((1, 2), np.int64)},
        {"distortion": ()},
        {"position": np.zeros((3, 3))},
        {"intrinsics": np.zeros((2, 3))},
    ],
    ids=lambda change: next(iter(change)),
)
def test_rig_of_different_lengths_is_refused(rig: CameraRig, change: dict[str, object]) -> None:
    log = RejectionLog()
    assert rig_cameras(dataclasses.replace(rig, **change), log) is None  # type: ignore[arg-type]
    assert log.rejected == {"bad_rig": 1}
    assert "camera rig of 2 cameras: shapes " in log.notes[-1]


def test_variances_that_say_unknown_leave_the_others_as_they_are() -> None:
    """1e223 m^2 beside 1 once left no inverse."""
    log = RejectionLog()
    told = np.diag([1.0, 1e-4, 1e223])
    found = positive_covariance("one", told, 3, log)
    assert found is not None and not log.rejected
    np.testing.assert_allclose(found, np.diag([1.0, 1e-4, 1e8]), atol=1e-6)
    turn = geometry.so3_exp(np.array([0.3, -0.5, 0.7]))
    information = root_information(turn @ found @ turn.T)
    expected = turn @ np.diag([1.0, 1e4, 1e-8]) @ turn.T
    np.testing.assert_allclose(information.T @ information, expected, atol=1.0)


@pytest.mark.parametrize("seed", range(40))
def test_whatever_covariance_is_taken_has_a_root(seed: int) -> None:
    """Also where rounding leaves its inverse no longer positive definite: variances of 1e-12 beside 1e20, any axes."""
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    matrix = (axes * 10.0 ** rng.uniform(-12, 20, 6)) @ axes.T
    taken = positive_covariance("it", 0.5 * (matrix + matrix.T), 6, RejectionLog())
    if taken is None:  # rounding has made it indefinite
        return
    root = root_information(taken)
    np.testing.assert_array_equal(root, np.triu(root))
    whole = root @ taken @ root.T
    np.testing.assert_allclose(whole, np.eye(6), atol=1e-3)
