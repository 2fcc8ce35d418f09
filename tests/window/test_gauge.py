# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.window import gauge

# (keyframe, camera, point) of each observation
Views = list[tuple[int, int, int]]


def problem_of(n_kf: int, views: Views, baseline_m: float = 0.0, depth_of: int | None = None) -> Problem:
    keyframe, camera, point = np.array(sorted(views, key=lambda v: (v[2], v[0], v[1])), np.intp).T
    n, n_pt = len(point), point.max() + 1
    depth = np.where(np.arange(n) == depth_of, 3.0, np.nan) if depth_of is not None else np.empty(0)
    state = State(np.tile(np.eye(3), (n_kf, 1, 1)), np.zeros((n_kf, 3)), np.zeros((n_pt, 3)), np.empty((0, 3)))
    translation = np.array([[0.0, 0, 0], [-baseline_m, 0, 0]])
    cameras = Cameras(np.tile(np.eye(3), (2, 1, 1)), translation, np.zeros(2, np.uint8), np.ones((2, 12)))
    obs = Observations(keyframe, camera, point, np.zeros((n, 2)), np.ones(n), depth, 0.02 * depth)
    return Problem(state, np.zeros(n_kf, bool), cameras, obs)


def chain(keyframes: range, first_point: int = 0, cameras: tuple[int, ...] = (0,)) -> Views:
    """Return views of twelve points between each keyframe and the next."""
    return [
        (k, c, first_point + 12 * i + p)
        for i, a in enumerate(keyframes[:-1])
        for k in (a, a + 1)
        for c in cameras
        for p in range(12)
    ]


def choose(problem: Problem, old: list[int], tied: list[int] | None = None) -> tuple[list[int], list[int]]:
    number = np.arange(problem.n_keyframes)
    held = gauge.choose(problem, np.isin(number, old), np.isin(number[:-1], tied or []))
    return np.flatnonzero(held.fixed).tolist(), held.unscaled.tolist()


@pytest.mark.parametrize(
    ("baseline_m", "old", "fixed", "unscaled"),
    [
        (0.1, [], [0], [-1] * 5),
        (0.1, [0], [0], [-1] * 5),
        (0.1, [0, 1], [0, 1], [-1] * 5),
        # Two cameras in one place show no scale.
        (0.0, [], [0], [0] * 5),
        (0.0, [0], [0, 1], [-1] * 5),
        (0.0, [0, 1], [0, 1], [-1] * 5),
        (0.0, [1], [0, 1], [-1] * 5),
    ],
)
def test_what_is_fixed(baseline_m: float, old: list[int], fixed: list[int], unscaled: list[int]) -> None:
    assert choose(problem_of(5, chain(range(5), cameras=(0, 1)), baseline_m), old) == (fixed, unscaled)


def test_two_cameras_that_never_see_the_same_point_at_once_show_no_scale() -> None:
    views = [(k, k % 2, p) for k in range(4) for p in range(12)]
    assert choose(problem_of(4, views, 0.5), []) == ([0], [0] * 4)


def test_a_rig_of_many_cameras_needs_no_table_of_all_pairs() -> None:
    """Its distances alone would be 3 GB."""
    problem = problem_of(5, chain(range(5), cameras=(0, 1)), 0.1)
    cams, n = problem.cameras, 10_000
    many = Cameras(
        np.tile(cams.rotation, (n, 1, 1)),
        np.tile(cams.translation, (n, 1)),
        np.tile(cams.model, n),
        np.tile(cams.params, (n, 1)),
    )
    problem = dataclasses.replace(problem, cameras=many)
    assert choose(problem, []) == ([0], [-1] * 5)


def test_one_depth_shows_scale() -> None:
    assert choose(problem_of(3, chain(range(3)), depth_of=5), []) == ([0], [-1] * 3)


def test_an_old_keyframe_with_few_observations_is_not_relied_on() -> None:
    views = [*chain(range(1, 4)), *((0, 0, p) for p in range(4))]
    assert choose(problem_of(4, views), [0]) == ([0, 1, 2], [-1] * 4)


def test_each_part_is_held_by_itself() -> None:
    views = [*chain(range(3)), *chain(range(3, 6), first_point=100)]
    assert choose(problem_of(6, views), [0, 1]) == ([0, 1, 3], [-1, -1, -1, 3, 3, 3])


def test_a_long_chain_is_one_part() -> None:
    assert choose(problem_of(60, chain(range(60))), [])[1] == [0] * 60


def test_steps_give_the_scale() -> None:
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.normal(size=(20, 3)), axis=0)
    assert gauge.step_ratio(2.5 * path, path) == pytest.approx(2.5, rel=1e-12)
    assert gauge.step_ratio(path, np.zeros_like(path)) == 1.0
    assert gauge.step_ratio(np.zeros_like(path), path) == 1.0


def test_steps_that_tie_all_to_an_old_keyframe_need_no_look_at_the_views() -> None:
    """Nothing else is held, whatever is seen; with one tie less all is looked at, for the same."""
    views = chain(range(5))
    for tied in ([0, 1, 2, 3], [0, 1, 2]):
        assert choose(problem_of(5, views), old=[0], tied=tied) == ([0], [-1] * 5), f"tied {tied}"
