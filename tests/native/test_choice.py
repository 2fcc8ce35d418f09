# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What takes part in a window, chosen by the C++ kernels and by numpy."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ba_node import native
from ba_node.config import Config
from ba_node.core import triangulation
from ba_node.core.cameras import DISTORTION, Model
from ba_node.core.problem import Problem
from ba_node.scene.scene import Scene
from ba_node.synthetic import SyntheticOptions, generate
from ba_node.window import moving
from ba_node.window.problems import determined, part_of, problem_of

pytestmark = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")

Find = Callable[[], Any]
Both = Callable[[Find], tuple[Any, Any]]


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch) -> Both:
    """Return what gives the results of a function with the C++ kernels and without."""

    def results(function: Find) -> tuple[Any, Any]:
        compiled = function()
        with monkeypatch.context() as without:
            without.setattr(native, "kernels", None)
            return compiled, function()

    return results


def window(depth_share: float = 0.3) -> Problem:
    """Return a problem of all that a short drive sees."""
    options = SyntheticOptions(seed=5, keyframes=10, tracks=60, length_m=12.0, depth_share=depth_share)
    scene = Scene(Config().scene)
    for _, _, measurement in generate(options).timeline():
        scene.add(measurement)
    landmarks = np.arange(len(scene.landmarks))
    positions = np.random.default_rng(4).normal(size=(len(landmarks), 3))
    return problem_of(
        scene, np.arange(len(scene.observations)), scene.order, landmarks, np.zeros(3), positions, Config()
    )[0]


@pytest.mark.parametrize("kind", ["straight", "distorted", "fisheye", "without depths"])
def test_rays_are_those_of_numpy(kind: str) -> None:
    problem = window(0.0 if kind == "without depths" else 0.3)
    cams = problem.cameras
    params = cams.params.copy()
    if kind in ("distorted", "fisheye"):
        params[0, DISTORTION] = [-0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    model = np.array([Model.EQUIDISTANT, Model.RATIONAL], np.uint8) if kind == "fisheye" else cams.model
    uv = problem.observations.uv.copy()
    if kind != "straight":
        uv[::9] = 1e5  # where cameras with distortion see nothing
    problem = dataclasses.replace(
        problem,
        cameras=dataclasses.replace(cams, params=params, model=model),
        observations=dataclasses.replace(problem.observations, uv=uv),
    )
    compiled, plain = (triangulation.rays_of(problem, kernels) for kernels in ("native", "numpy"))
    assert (len(plain.point) < len(uv)) == (kind in ("distorted", "fisheye"))
    for field in dataclasses.fields(plain):
        np.testing.assert_allclose(
            getattr(compiled, field.name), getattr(plain, field.name), rtol=1e-13, atol=1e-14, err_msg=field.name
        )


@pytest.mark.parametrize("depth_share", [0.0, 0.3])
def test_what_determines_something_is_what_numpy_finds(depth_share: float, both: Both) -> None:
    problem, rng = window(depth_share), np.random.default_rng(6)
    usable = rng.random(len(problem.observations)) < 0.9
    moves = rng.random(problem.n_points) < 0.1
    problem.start.points[rng.random(problem.n_points) < 0.1] = np.nan
    least = rng.integers(5, 30, problem.n_keyframes)
    compiled, plain = both(lambda: determined(problem, usable, moves, 3 * problem.n_points // 4, least))
    assert 0 < np.count_nonzero(plain[1]) < problem.n_keyframes, "some keyframes are left"
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("depth_share", [0.0, 0.3])
def test_a_part_is_what_numpy_takes(depth_share: float, both: Both) -> None:
    problem = window(depth_share)
    points, keyframes = np.arange(problem.n_points) % 3 > 0, np.arange(problem.n_keyframes) % 4 > 0
    obs = problem.observations
    rows = np.flatnonzero(points[obs.point] & keyframes[obs.keyframe])
    compiled, plain = both(lambda: part_of(problem, rows, points, keyframes))
    for field in dataclasses.fields(plain.observations):
        a, b = (getattr(found.observations, field.name) for found in (compiled, plain))
        np.testing.assert_array_equal(a, b, err_msg=field.name)
        assert a.dtype == b.dtype, field.name


def test_what_moves_is_what_numpy_finds() -> None:
    problem, rng = window(), np.random.default_rng(7)
    norms = (
        np.abs(rng.normal(size=len(problem.observations)))
        * rng.choice([1.0, 4.0, 100.0], problem.n_points)[problem.observations.point]
    )
    norms[::11] = np.inf
    off = rng.uniform(1.0, 1.5, problem.n_keyframes)
    compiled, plain = (moving._leaves_more_than_noise(problem, norms, off, kernels) for kernels in ("native", "numpy"))
    assert 20 < np.count_nonzero(plain) < problem.n_points - 20
    np.testing.assert_array_equal(compiled, plain)
