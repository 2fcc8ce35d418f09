# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of the guard by themselves."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ba_node.config import Config, GuardConfig
from ba_node.core import geometry
from ba_node.window import guard, steps, trial
from ba_node.window.trust import Odd, Trust

CONFIG = Config()
FIRST = np.arange(11)  # of the steps between 12 keyframes


def poses(rng: np.random.Generator, n: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return body from world of a path with steps of a metre and turns of 20 degrees."""
    turns = geometry.so3_exp(np.cumsum(np.tile([0.0, 0.0, 0.35], (n, 1)), axis=0))
    position = scale * np.cumsum((turns @ np.array([1.0, 0.0, 0.0])) + 0.02 * rng.normal(size=(n, 3)), axis=0)
    return geometry.inverse(turns, position)


def steps_of(found: tuple[np.ndarray, np.ndarray]) -> steps.Steps:
    first = np.arange(len(found[0]) - 1)
    return steps.between(*found, first, first + 1)


def led_by(made: steps.Steps) -> tuple[np.ndarray, np.ndarray]:
    """Return body from world where steps lead from the origin."""
    rotation, translation = [np.eye(3)], [np.zeros(3)]
    for turn, move in zip(made.turn, made.move, strict=True):
        rotation.append(turn.T @ rotation[-1])
        translation.append(turn.T @ (translation[-1] - move))
    return np.array(rotation), np.array(translation)


def test_steps_that_are_off_to_one_side_stand_out_of_noise() -> None:
    """Six means of independent errors leave 6, a shift of 5 % of a metre leaves far more."""
    rng = np.random.default_rng(3)
    measured = steps.Steps(np.tile(np.eye(3), (20, 1, 1)), np.tile([1.0, 0.0, 0.0], (20, 1)))
    found = []
    for _ in range(400):
        turn, move = geometry.so3_exp(0.01 * rng.normal(size=(20, 3))), 0.02 * rng.normal(size=(20, 3))
        found.append(steps.bias(steps.Steps(turn, measured.move + move), measured))
    assert np.mean(found) == pytest.approx(6.0, abs=0.5)
    assert np.mean(np.array(found) > 24.0) < 0.02
    moved = steps.Steps(turn, measured.move + move + [0.0, 0.05, 0.0])
    assert steps.bias(moved, measured) > 30.0
    few = steps.Steps(moved.turn[:7], moved.move[:7])
    assert steps.bias(few, steps.Steps(measured.turn[:7], measured.move[:7])) == 0.0


def test_steps_do_not_depend_on_where_the_map_lies() -> None:
    rotation, translation = poses(np.random.default_rng(0), 8)
    turn, shift = geometry.so3_exp(np.array([0.3, -0.2, 1.0])), np.array([5.0, -2.0, 8.0])
    moved = steps_of((rotation @ turn.T, translation - (rotation @ turn.T @ shift)))
    as_it_was = steps_of((rotation, translation))
    np.testing.assert_allclose(moved.move, as_it_was.move, atol=1e-12)
    np.testing.assert_allclose(moved.turn, as_it_was.turn, atol=1e-12)
    world = np.swapaxes(rotation, 1, 2)
    centre = -(world @ translation[:, :, None])[..., 0]
    np.testing.assert_allclose(as_it_was.length, np.linalg.norm(np.diff(centre, axis=0), axis=1), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.1, 1.0, 3.0, np.pi])
def test_angle(angle: float) -> None:
    assert steps.angle_of(geometry.so3_exp(np.array([[0.0, angle, 0.0]])))[0] == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize("scale", [0.8, 1.2, 1000.0])
def test_a_common_scale_is_found(scale: float) -> None:
    found, measured = poses(np.random.default_rng(1), 12, scale), poses(np.random.default_rng(2), 12)
    beside = steps.against(found, measured, FIRST, FIRST + 1, GuardConfig())
    assert beside.scale == pytest.approx(scale, rel=0.05)
    assert beside.turn == 1.0


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_no_scale(seed: int) -> None:
    """Steps that are off by 15 % each way in random directions."""
    rng = np.random.default_rng(seed)
    found, measured = poses(rng, 12), steps_of(poses(rng, 12))
    noisy = led_by(steps.Steps(measured.turn, measured.move + 0.15 * rng.normal(size=measured.move.shape)))
    beside = steps.against(found, noisy, FIRST, FIRST + 1, GuardConfig())
    assert abs(np.log(beside.scale)) < np.log1p(GuardConfig().max_scale_error)


def test_a_fixed_choice_of_tracks() -> None:
    ids = np.random.default_rng(3).integers(0, 2**64 - 1, 1000, dtype=np.uint64, endpoint=True)
    point = np.repeat(np.arange(1000), 6)
    tried, aside = trial.choose(ids, point, 16)
    assert len(tried) == 16 and aside.tolist() == tried[: 1000 // 128].tolist()
    # Another order, and others beside them, leave the choice as it is where these stay.
    order = np.random.default_rng(4).permutation(1000)
    again, _ = trial.choose(ids[order], point, 16)
    assert ids[order][again].tolist() == ids[tried].tolist()
    assert [len(part) for part in trial.choose(ids[:40], point[:240], 16)] == [16, 0]
    assert [len(part) for part in trial.choose(ids, point, 0)] == [0, 0]


def test_doubt_grows_and_fades() -> None:
    trust = Trust()
    assert trust.hear("a", None, (), CONFIG) == "a"
    # One bad window costs nothing more.
    assert trust.hear("", None, (), CONFIG) == ""
    for _ in range(10):
        trust.hear("wrong", None, (), CONFIG)
    assert trust.lost
    assert trust.bounds(CONFIG).guard.min_inlier_share > CONFIG.guard.min_inlier_share
    waits = [trust.hear("", None, (), CONFIG) for _ in range(12)]
    assert sum(map(bool, waits)) == 10 and "wrong" in waits[0] and waits[-1] == ""
    assert trust.bounds(CONFIG) is CONFIG


def test_what_was_given_up_before_is_given_up_sooner() -> None:
    """Solves that pass for a while between many that are held are no better than these."""
    trust = Trust()
    assert trust.hear("wrong", None, (), CONFIG) == "wrong" and not trust.lost
    trust.given_up = True
    assert not trust.hear("", None, (), CONFIG) and not trust.lost
    assert trust.hear("wrong", None, (), CONFIG) == "wrong" and trust.lost


def test_always_other_keyframes_to_blame_is_doubtful() -> None:
    trust = Trust()
    assert trust.hear("", None, (4,), CONFIG) != ""
    same, others = Trust(), Trust()
    assert [bool(same.hear("", None, (4,), CONFIG)) for _ in range(4)] == [True, False, False, False]
    assert all(others.hear("", None, (k,), CONFIG) for k in range(4))


def test_odd_steps_wait_for_others_that_agree() -> None:
    step = steps.Steps(np.eye(3)[None], np.array([[5.0, 0.0, 0.0]]))
    other = steps.Steps(np.eye(3)[None], np.array([[9.0, 0.0, 0.0]]))
    trust = Trust()
    for found, agreeing in ((step, 1), (step, 2), (other, 1), (other, 2)):
        assert trust.hear("odd", Odd(((3, 4),), found), (), CONFIG) == "odd"
        assert trust.agreeing == agreeing
        assert (trust.confirmed(2) is not None) is (agreeing >= 2)
    assert trust.doubt == 0


@pytest.mark.parametrize("has_scale", [True, False])
def test_one_camera_that_turns_on_the_spot_is_not_said_to_be_wrong_alone(has_scale: bool) -> None:
    selection: Any = SimpleNamespace(problem=SimpleNamespace(has_scale=has_scale))
    text = guard._misfit(selection, cast("Any", None), guard._Agreeing([1], [20]), Config())
    assert text.startswith("only 5 % of the observations agree with it")
    assert ("the camera hardly moves, and these are mismatches" in text) != has_scale
