# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The weighted pose: its errors and Jacobian by another route, and the pose that it finds."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node import native
from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end import pose
from ba_node.front_end.rectify import ideal_rig
from tests.front_end import world

pytest.importorskip("cv2", reason="needs opencv: pip install ba_node[front_end]")

RIG = ideal_rig(world.rig(), world.SIZE)
TRUE = Transform(geometry.so3_exp(np.array([0.05, -0.1, 0.02])), np.array([0.3, -0.1, 0.5]))


def seen(count: int, noise: float) -> pose.Seen:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-2, 2, count), rng.uniform(-1.5, 1.5, count), rng.uniform(2.0, 15.0, count)])
    sigma = rng.uniform(0.1, 0.5, count)
    along = points * rng.choice([0.0, 0.02, 0.1], count)[:, None]
    moved = points + along * rng.normal(size=(count, 1)) * noise
    uv = project(moved, TRUE) + sigma[:, None] * rng.normal(size=(count, 2)) * noise
    return pose.Seen(points, uv, sigma, along)


def project(points: FloatArray, at: Transform) -> FloatArray:
    x = points @ at.rotation.T + at.translation
    return np.asarray(RIG.focal * x[:, :2] / x[:, 2:] + RIG.centre)


def test_errors_are_whitened_and_the_jacobian_is_their_change() -> None:
    of, step = seen(40, 1.0), 1e-6
    error, jacobian = pose._linear(RIG, of, TRUE)
    columns = []
    for i in range(6):
        change = np.eye(6)[i] * step
        ends = [Transform(geometry.so3_exp(s * change[:3]), s * change[3:]).after(TRUE) for s in (1.0, -1.0)]
        columns.append((project(of.points, ends[0]) - project(of.points, ends[1])) / (2.0 * step))
    smear = (project(of.points + 1e-6 * of.along, TRUE) - project(of.points - 1e-6 * of.along, TRUE)) / 2e-6
    for i in range(len(of.points)):
        value, vector = np.linalg.eigh(of.sigma[i] ** 2 * np.eye(2) + np.outer(smear[i], smear[i]))
        whiten = vector @ np.diag(value**-0.5) @ vector.T
        assert error[i] == pytest.approx(whiten @ (of.uv[i] - project(of.points, TRUE)[i]), rel=1e-6, abs=1e-8)
        expected = whiten @ np.column_stack([column[i] for column in columns])
        assert np.abs(jacobian[i] - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
def test_both_have_the_same_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    """With points behind the camera, without an uncertain depth, and far off too; and none."""
    of = seen(40, 3.0)
    of.points[0] = [0.0, 0.0, -3.0]
    ours, of_none = pose._equations(RIG, of, TRUE), pose._equations(RIG, seen(0, 1.0), TRUE)
    monkeypatch.setattr(native, "kernels", None)
    for one, other in zip(ours, pose._equations(RIG, of, TRUE), strict=True):
        assert one.shape == other.shape
        assert np.abs(one - other).max() < 1e-9 * np.abs(other).max()
    assert [one.shape for one in of_none] == [(6, 6), (6,), (0,)]
    assert not of_none[0].any() and not of_none[1].any()


def test_a_point_behind_the_camera_has_finite_errors() -> None:
    of = seen(5, 0.0)
    of.points[0] = [0.0, 0.0, -3.0]
    error, jacobian = pose._linear(RIG, of, TRUE)
    assert np.isfinite(error).all() and np.isfinite(jacobian).all()


def test_the_pose_is_found_as_well_as_its_covariance_says() -> None:
    of = seen(200, 1.0)
    start = Transform(geometry.so3_exp(np.array([0.02, 0.02, -0.02])), np.array([0.1, 0.1, -0.1])).after(TRUE)
    found, covariance, size = pose.refine(RIG, of, start)
    turn = geometry.so3_log((found.rotation @ TRUE.rotation.T)[None])[0]
    off = np.concatenate([turn, found.translation - found.rotation @ TRUE.rotation.T @ TRUE.translation])
    assert off @ np.linalg.solve(covariance, off) < 22.5, "chi squared of 6, 0.1 %"
    assert np.median(size) == pytest.approx(1.18, abs=0.25), "of Rayleigh's distribution"
    exact, _, _ = pose.refine(RIG, seen(200, 0.0), start)
    assert np.abs(exact.rotation - TRUE.rotation).max() < 1e-6
    assert np.abs(exact.translation - TRUE.translation).max() < 1e-5
