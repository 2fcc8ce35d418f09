# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.config import FramesConfig
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.window.correction import MapCorrection, Move

S = 1_000_000_000
IDENTITY = Transform(np.eye(3), np.zeros(3))
NO_GATE = FramesConfig(gate_m=0.0, gate_rad=0.0)


def transform(turn: tuple[float, float, float] = (0.0, 0.0, 0.0), *move: float) -> Transform:
    return Transform(geometry.so3_exp(np.array(turn)), np.array(move or (0.0, 0.0, 0.0)))


def turned_about(body: Transform, angle_rad: float, move_m: float = 0.0) -> Transform:
    """Return a correction that turns a body about itself and moves it along x."""
    rotation = body.rotation @ geometry.so3_exp(np.array([0.0, 0.0, angle_rad]))
    wanted = Transform(rotation, body.translation + np.array([move_m, 0.0, 0.0]))
    return wanted.after(body.inverse())


def assert_same(a: Transform | None, b: Transform) -> None:
    assert a is not None
    np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-9)
    np.testing.assert_allclose(a.translation, b.translation, atol=1e-7)


coordinate = st.floats(-1e3, 1e3)
poses = st.builds(
    lambda turn, move: Transform(geometry.so3_exp(np.array(turn)), np.array(move)),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[coordinate] * 3),
)


@given(found=st.lists(poses, min_size=1, max_size=5), body=poses)
def test_without_gate_and_smoothing_it_is_what_was_found(found: list[Transform], body: Transform) -> None:
    correction = MapCorrection()
    for i, one in enumerate(found):
        assert not correction.update(NO_GATE, one, body, i * S).held
        assert_same(correction.published, one)


@given(body=poses, angle=st.floats(-3.0, 3.0), move=st.floats(-100.0, 100.0))
def test_size_is_measured_at_the_body(body: Transform, angle: float, move: float) -> None:
    correction = MapCorrection()
    assert correction.update(NO_GATE, IDENTITY, body, 0) == Move()
    size = correction.update(NO_GATE, turned_about(body, angle, move), body, S)
    assert size.distance_m == pytest.approx(abs(move), abs=1e-8)
    assert size.angle_rad == pytest.approx(abs(angle), abs=1e-7)


@pytest.mark.parametrize("large", [{"angle_rad": 0.3}, {"angle_rad": 0.0, "move_m": 2.0}], ids=["turn", "move"])
def test_a_large_correction_waits_until_others_agree(large: dict[str, float]) -> None:
    config = FramesConfig(gate_m=1.0, gate_rad=0.2, gate_confirmations=2)
    correction, body = MapCorrection(), transform((0.1, 0.2, 0.3), 50.0, 20.0, 0.0)
    correction.update(config, IDENTITY, body, 0)
    jump = turned_about(body, **large)
    moves = [correction.update(config, jump, body, i * S) for i in range(1, 5)]
    assert [move.held for move in moves] == [True, True, False, False]
    assert moves[2].distance_m == pytest.approx(large.get("move_m", 0.0), abs=1e-9)
    assert moves[3].distance_m == pytest.approx(0.0, abs=1e-9)
    assert_same(correction.published, jump)


def test_while_held_it_stays_as_it_was() -> None:
    config, body = FramesConfig(), transform((0.0, 0.0, 0.0), 5.0, 0.0, 0.0)
    correction = MapCorrection()
    correction.update(config, IDENTITY, body, 0)
    assert correction.update(config, transform((0, 0, 0), 9.0, 0.0, 0.0), body, S).held
    assert_same(correction.published, IDENTITY)
    small = transform((0, 0, 0), 0.1, 0.0, 0.0)
    assert not correction.update(config, small, body, 2 * S).held, "one that passes the gate is taken at once"
    assert_same(correction.published, small)


def test_corrections_that_disagree_confirm_nothing() -> None:
    config, body, correction = FramesConfig(), transform(), MapCorrection()
    correction.update(config, IDENTITY, body, 0)
    for i in range(1, 10):
        far = transform((0, 0, 0), 10.0 * (-1) ** i, 0.0, 0.0)
        assert correction.update(config, far, body, i * S).held
    assert_same(correction.published, IDENTITY)


def test_smoothing_follows_the_stamps() -> None:
    config, body = FramesConfig(smoothing_s=2.0), transform((0.0, 0.0, 1.0), 30.0, -10.0, 2.0)
    step = turned_about(body, 0.1, 0.5)
    fast, slow = MapCorrection(), MapCorrection()
    for correction in (fast, slow):
        correction.update(config, IDENTITY, body, 0)
    fast.update(config, step, body, 3 * S)
    for tenth in range(1, 31):
        slow.update(config, step, body, tenth * S // 10)
    assert slow.published is not None
    # However many solves there are between: the share is that of 3 s.
    assert_same(fast.published, slow.published)
    moved = slow.published.after(body)
    share = 1 - np.exp(-1.5)
    assert moved.translation[0] - 30.0 == pytest.approx(0.5 * share, rel=1e-6)
    assert np.linalg.norm(geometry.so3_log(body.rotation.T @ moved.rotation)) == pytest.approx(0.1 * share, rel=1e-6)


def test_smoothing_does_not_go_back_with_a_stamp_from_before() -> None:
    config, body, correction = FramesConfig(smoothing_s=1.0), transform(), MapCorrection()
    correction.update(config, IDENTITY, body, 10 * S)
    correction.update(config, transform((0, 0, 0), 0.5, 0, 0), body, 5 * S)
    assert_same(correction.published, IDENTITY)
