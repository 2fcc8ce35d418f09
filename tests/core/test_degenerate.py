# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Problems that have no good answer: every method with both kernels ends with a status, a reason and finite numbers."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ba_node import native
from ba_node.core import methods
from ba_node.core.native_kernels import missing
from ba_node.core.problem import Observations, Problem, ProblemError, State
from ba_node.core.result import Result, Status
from ba_node.core.solver import solve

Make = Callable[..., tuple[Problem, State]]
Spoil = Callable[[Problem], Problem]


def _rows(problem: Problem, kept: np.ndarray) -> Problem:
    obs = problem.observations
    arrays = {f.name: getattr(obs, f.name) for f in dataclasses.fields(obs)}
    return dataclasses.replace(
        problem, observations=Observations(**{n: a[kept] if len(a) else a for n, a in arrays.items()})
    )


def _start(problem: Problem, **arrays: np.ndarray) -> Problem:
    return dataclasses.replace(problem, start=dataclasses.replace(problem.start, **arrays))


def _one_camera(problem: Problem) -> Problem:
    return _rows(problem, np.flatnonzero(problem.observations.keyframe == 0))


def _behind(problem: Problem) -> Problem:
    return _start(problem, points=problem.start.points * [1.0, 1.0, -1.0])


def _zero_focal(problem: Problem) -> Problem:
    if problem.free_intrinsics:
        return _start(problem, intrinsics=problem.start.intrinsics * [0.0, 1.0, 1.0])
    params = problem.cameras.params * np.r_[0.0, 0.0, np.ones(10)]
    return dataclasses.replace(problem, cameras=dataclasses.replace(problem.cameras, params=params))


def _same_place(problem: Problem) -> Problem:
    start = problem.start
    return _start(problem, rotation=start.rotation[[0] * len(start.rotation)], translation=start.translation * 0.0)


def _twice(problem: Problem) -> Problem:
    return _rows(problem, np.repeat(np.arange(len(problem.observations)), 2))


def _points_in_one(problem: Problem) -> Problem:
    return _start(problem, points=np.tile([0.0, 0.0, 5.0], (problem.n_points, 1)))


def _lone_rows(problem: Problem) -> Problem:
    """Keep one observation of each point: blocks of C of rank 2."""
    return _rows(problem, np.unique(problem.observations.point, return_index=True)[1])


def _no_weight(problem: Problem) -> Problem:
    obs = problem.observations
    return dataclasses.replace(problem, observations=dataclasses.replace(obs, uv=obs.uv + 1e7))


SPOILS: dict[str, Spoil] = {
    function.__name__.strip("_"): function
    for function in (
        _one_camera, _behind, _zero_focal, _same_place, _twice, _points_in_one, _lone_rows, _no_weight
    )
}  # fmt: skip


def check(result: Result) -> None:
    """Assert what holds for every result."""
    assert result.reason and result.state.is_finite()
    if result.status not in (Status.FAILED, Status.SKIPPED):
        objectives = [row.objective for row in result.trace]
        assert np.isfinite(objectives).all(), objectives
        assert np.isfinite([row.gradient_norm for row in result.trace]).all()
        assert all(b <= a for a, b in itertools.pairwise(objectives)), objectives


def backends(name: str) -> list[str]:
    """Return the kernels that can do a method."""
    chosen = methods.options(name)
    has_native = native.kernels is not None and not missing(chosen)
    return ["numpy", "native"] if has_native else ["numpy"]


@pytest.mark.parametrize("shape", [{}, {"free_intrinsics": True}], ids=["6", "9"])
@pytest.mark.parametrize("spoil", list(SPOILS))
@pytest.mark.parametrize("method", list(methods.METHODS))
def test_no_good_answer(method: str, spoil: str, shape: dict[str, object], make_problem: Make) -> None:
    problem = SPOILS[spoil](make_problem(points=12, keyframes=3, fixed=0, **shape)[0])
    for backend in backends(method):
        check(solve(problem, dataclasses.replace(methods.options(method), kernels=backend, max_iterations=8)))


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    method=st.sampled_from(list(methods.METHODS)),
    spoils=st.lists(st.sampled_from(list(SPOILS)), min_size=1, max_size=3, unique=True),
    free=st.booleans(),
    fixed=st.integers(0, 3),
    seed=st.integers(0, 1000),
    cheirality=st.sampled_from(["keep", "constant", "drop"]),
)
def test_several_faults_at_once(
    make_problem: Make, method: str, spoils: list[str], free: bool, fixed: int, seed: int, cheirality: str
) -> None:
    problem, _ = make_problem(points=8, keyframes=3, fixed=fixed, free_intrinsics=free, seed=seed)
    for spoil in spoils:
        problem = SPOILS[spoil](problem)
    options = dataclasses.replace(methods.options(method), cheirality=cheirality, max_iterations=6)
    for backend in backends(method):
        check(solve(problem, dataclasses.replace(options, kernels=backend)))


@pytest.mark.parametrize("field", ["rotation", "translation", "points"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_none_are_refused(field: str, value: float, make_problem: Make) -> None:
    problem, _ = make_problem()
    array = getattr(problem.start, field).copy()
    array.flat[0] = value
    with pytest.raises(ProblemError, match="not finite"):
        solve(_start(problem, **{field: array}), methods.options("local_dinm"))
