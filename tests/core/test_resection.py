# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""One keyframe is placed by points that others see, in C++ as in numpy; points that it alone sees go along."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core import geometry
from ba_node.core.cameras import Model
from ba_node.core.problem import Problem, State
from ba_node.core.resection import resected
from tests.core.conftest import MakeProblem
from tests.core.kernels import COST_MODELS, built, near

KINDS = ["pinhole", "distorted", "fisheye", "depths"]
LAST = 4


def shifted(make_problem: MakeProblem, kind: str, noise_px: float = 0.5) -> tuple[Problem, State]:
    """Return a problem at the truth but for its last keyframe, which is off, and the truth; one point it sees alone."""
    problem, truth = make_problem(
        points=120, stereo=True, depth=kind == "depths", distorted=kind == "distorted", noise_px=noise_px
    )
    obs, cams = problem.observations, problem.cameras
    problem = dataclasses.replace(
        problem, observations=obs.take(np.flatnonzero((obs.point > 0) | (obs.keyframe == LAST)))
    )
    if kind == "fisheye":
        problem = dataclasses.replace(
            problem, cameras=dataclasses.replace(cams, model=np.array([Model.EQUIDISTANT, 0], np.uint8))
        )
    rotation, translation = truth.rotation.copy(), truth.translation.copy()
    rotation[LAST] = geometry.so3_exp(np.array([0.01, -0.02, 0.005])) @ rotation[LAST]
    translation[LAST] += [0.05, -0.02, 0.1]
    start = dataclasses.replace(truth, rotation=rotation, translation=translation)
    return dataclasses.replace(problem, start=start), truth


def test_it_goes_where_known_points_want_it(make_problem: MakeProblem) -> None:
    problem, truth = shifted(make_problem, "distorted", noise_px=0.0)
    found = resected(problem, SolverOptions(kernels="numpy"), LAST)
    assert np.array_equal(found.rotation[:LAST], problem.start.rotation[:LAST])
    np.testing.assert_allclose(found.rotation[LAST], truth.rotation[LAST], atol=1e-6)
    np.testing.assert_allclose(found.translation[LAST], truth.translation[LAST], atol=1e-5)
    assert np.array_equal(found.points[1:], problem.start.points[1:])

    def in_body(state: State) -> np.ndarray:
        return np.asarray(state.rotation[LAST] @ state.points[0] + state.translation[LAST])

    np.testing.assert_allclose(in_body(found), in_body(problem.start), atol=1e-12)


@built
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("options", COST_MODELS, ids=lambda o: f"{o.loss} {o.cheirality}")
def test_kernels_agree(make_problem: MakeProblem, kind: str, options: SolverOptions) -> None:
    problem, _ = shifted(make_problem, kind)
    points = problem.start.points.copy()
    points[5::11, 2] *= -1.0
    problem = dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points))
    numpy, compiled = (
        resected(problem, dataclasses.replace(options, kernels=name), LAST) for name in ("numpy", "native")
    )
    assert not np.array_equal(numpy.rotation[LAST], problem.start.rotation[LAST])
    for a, b in zip(vars(numpy).values(), vars(compiled).values(), strict=True):
        near(a, b, 1e-9)


@pytest.mark.parametrize("kernels", ["numpy", pytest.param("native", marks=built)])
def test_it_stays_where_it_sees_too_little_or_agrees(make_problem: MakeProblem, kernels: str) -> None:
    problem, _ = shifted(make_problem, "pinhole")
    options = SolverOptions(kernels=kernels)
    seen = problem.observations
    others = np.flatnonzero(seen.keyframe != LAST)
    few = np.concatenate([others, np.flatnonzero(seen.keyframe == LAST)[:49]])
    assert resected(dataclasses.replace(problem, observations=seen.take(few)), options, LAST) is problem.start
    there = dataclasses.replace(problem, start=resected(problem, options, LAST))
    again = resected(there, options, LAST)
    np.testing.assert_allclose(again.translation, there.start.translation, atol=1e-3)
