# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations that images tell where there is no parallax."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.core.cameras import N_PARAMS
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.window import turns

FOCAL_PX = 400.0


def seen(
    rotation: np.ndarray, position: np.ndarray, mismatched: float = 0.0, points: int = 200, noise_px: float = 0.3
) -> Problem:
    """Return what a camera sees of points 4 to 9 m away; poses are body in world, and not told."""
    rng = np.random.default_rng(5)
    n = len(rotation)
    world = rng.uniform([-6.0, -4.0, 4.0], [6.0, 4.0, 9.0], (points, 3))
    body = (world[None] - position[:, None]) @ rotation
    uv = FOCAL_PX * body[..., :2] / body[..., 2:] + rng.normal(0.0, noise_px, (n, points, 2))
    wrong = rng.random((n, points)) < mismatched
    uv[wrong] += rng.uniform(-150.0, 150.0, (int(wrong.sum()), 2))
    point, keyframe = (a.ravel() for a in np.meshgrid(np.arange(points), np.arange(n), indexing="ij"))
    params = np.zeros((1, N_PARAMS))
    params[:, :2] = FOCAL_PX
    m = len(point)
    obs = Observations(
        keyframe, np.zeros(m, np.intp), point, uv[keyframe, point], np.full(m, noise_px), np.empty(0), np.empty(0)
    )
    start = State(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((points, 3)), np.empty((0, 3)))
    rig = Cameras(np.eye(3)[None], np.zeros((1, 3)), np.zeros(1, np.uint8), params)
    return Problem(start, np.zeros(n, bool), rig, obs)


def found(problem: Problem, placed: int = 0) -> turns.Turns | None:
    rows = np.arange(problem.n_keyframes) + 70
    used = np.ones(len(problem.observations), bool)
    return turns.find(problem, rows, used, np.arange(problem.n_points) < placed)


def turning(n: int, degrees: float) -> np.ndarray:
    angle = np.zeros((n, 3))
    angle[:, 1] = np.radians(degrees) * np.sin(np.arange(n))
    return geometry.so3_exp(angle)


@pytest.mark.parametrize("mismatched", [0.0, 0.15])
def test_a_camera_that_turns_on_the_spot(mismatched: float) -> None:
    """All are compared with the first one; of a quarter of the tracks one view or both are wrong."""
    rotation = turning(8, 4.0)
    result = found(seen(rotation, np.zeros((8, 3)), mismatched))
    assert result is not None
    assert result.anchor.tolist() == [-1] + 7 * [70]
    error = geometry.so3_log(np.swapaxes(rotation[0].T @ rotation[1:], 1, 2) @ result.rotation[1:])
    assert np.abs(error).max() < 3e-4, "a quarter of a pixel would be 6e-4 rad"
    np.testing.assert_allclose(result.sigma_rad, np.sqrt(2.0) * 0.3 / FOCAL_PX)


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], ids=["sideways", "ahead"])
def test_a_camera_that_moves_shows_parallax(direction: list[float]) -> None:
    position = 0.5 * np.arange(6)[:, None] * np.array(direction)
    assert found(seen(turning(6, 1.0), position)) is None


def test_slow_motion_is_told_once_it_has_added_up() -> None:
    """4 mm a step are less than a pixel; 40 of them are not."""
    position = 0.004 * np.arange(40)[:, None] * np.array([1.0, 0.0, 0.0])
    result = found(seen(turning(40, 0.5), position))
    assert result is not None
    still = np.flatnonzero(result.anchor >= 0)
    assert 3 < still.max() < 35, still.tolist()


def test_keyframes_that_see_many_points_are_left_alone() -> None:
    assert found(seen(turning(4, 2.0), np.zeros((4, 3))), placed=100) is None


def test_two_keyframes_with_few_tracks_in_common_tell_nothing() -> None:
    assert found(seen(turning(4, 2.0), np.zeros((4, 3)), points=9)) is None


def test_steps_between_any_two_of_a_run() -> None:
    rotation = turning(5, 3.0)
    result = found(seen(rotation, np.zeros((5, 3))))
    assert result is not None
    rows = np.arange(5) + 70
    first, second = np.array([0, 1, 2, 3]), np.array([1, 2, 3, 4])
    between, sigma = result.between(rows, first, second)
    np.testing.assert_allclose(between, np.swapaxes(rotation[first], 1, 2) @ rotation[second], atol=6e-4)
    assert np.isfinite(sigma).all()
    # Without the anchor they still know of each other.
    kept = result.take(np.array([False, True, True, False, True]))
    between, sigma = kept.between(rows[[1, 2, 4]], np.array([0, 1]), np.array([1, 2]))
    np.testing.assert_allclose(between[1], rotation[2].T @ rotation[4], atol=6e-4)
    assert np.isfinite(sigma).all()


def test_the_start_takes_the_rotations_and_keeps_the_steps() -> None:
    """Free keyframes turn; each keeps its place in the body of the one before."""
    rotation = turning(4, 3.0)
    problem = seen(rotation, np.zeros((4, 3)))
    result = found(problem)
    assert result is not None
    rng = np.random.default_rng(1)
    given = geometry.so3_exp(rng.normal(0.0, 0.03, (4, 3))), rng.normal(0.0, 0.1, (4, 3))
    back = geometry.inverse(*given)
    start = State(*back, problem.start.points, problem.start.intrinsics)
    moved = result.applied(
        Problem(start, problem.fixed, problem.cameras, problem.observations),
        np.arange(4) + 70,
        np.array([False, True, True, True]),
    ).start
    turned, position = geometry.inverse(moved.rotation, moved.translation)
    np.testing.assert_allclose(turned[0], given[0][0], atol=1e-12)
    for k in range(3):
        np.testing.assert_allclose(turned[k].T @ turned[k + 1], rotation[k].T @ rotation[k + 1], atol=6e-4)
        step = given[0][k].T @ (given[1][k + 1] - given[1][k])
        np.testing.assert_allclose(turned[k].T @ (position[k + 1] - position[k]), step, atol=1e-12)
