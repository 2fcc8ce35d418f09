# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A clock that is set shows against the times at which keyframes come; delays, pauses and a pace do not."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.backend import Backend, ClockWatch
from ba_node.backend.clock import clock_steps
from ba_node.config import Config
from ba_node.measurements import Keyframe

N = 60
SEEDS = range(20)


def drive(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps of keyframes at uneven times, and when they were recorded: some tens of milliseconds later."""
    rng = np.random.default_rng(seed)
    stamp = np.cumsum(rng.uniform(0.3, 0.7, N))
    return stamp, stamp + 0.05 + rng.gamma(2.0, 0.01, N)


@pytest.mark.parametrize("step_s", [3600.0, 0.6, -0.6, -7200.0])
@pytest.mark.parametrize("pace", [1.0, 0.5, 3.0])
def test_where_and_by_how_much_a_clock_is_set(step_s: float, pace: float) -> None:
    for seed in SEEDS:
        stamp, time = drive(seed)
        found = clock_steps(stamp + step_s * (np.arange(N) >= 23), time * pace)
        assert [at for at, _ in found] == [23], (seed, found)
        assert found[0][1] == pytest.approx(step_s, abs=0.05)


def test_two_steps() -> None:
    stamp, time = drive(0)
    set_twice = stamp + 60.0 * (np.arange(N) >= 20) - 60.0 * (np.arange(N) >= 40)
    assert [(at, round(step)) for at, step in clock_steps(set_twice, time)] == [(20, 60), (40, -60)]


def sound(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    stamp, time = drive(seed)
    rng, k = np.random.default_rng(1000 + seed), np.arange(N)
    if kind == "a pause of the robot":
        return stamp + 300.0 * (k >= 30), time + 300.0 * (k >= 30)
    if kind == "a pause of the player":
        return stamp, time + 30.0 * (k >= 30)
    if kind == "one wrong stamp":
        return stamp + 1e6 * (k == 25), time
    if kind == "a computer that falls behind and catches up":
        return stamp, np.maximum.accumulate(np.where((k >= 25) & (k < 29), stamp[29], time))
    if kind == "a delay that grows and stays":
        return stamp, time + np.cumsum(rng.uniform(0.0, 0.1, N))
    if kind == "keyframes in batches":
        return stamp, time[np.minimum(5 * (k // 5) + 4, N - 1)] + 0.001 * k
    if kind == "stamps of another unit":
        return stamp / 1000.0, time
    assert kind == "stamps for times"
    return stamp, stamp


SOUND = (
    "a pause of the robot",
    "a pause of the player",
    "one wrong stamp",
    "a computer that falls behind and catches up",
    "a delay that grows and stays",
    "keyframes in batches",
    "stamps of another unit",
    "stamps for times",
)


@pytest.mark.parametrize("kind", SOUND)
def test_what_is_no_step_of_the_clock(kind: str) -> None:
    for seed in SEEDS:
        assert clock_steps(*sound(kind, seed)) == [], (kind, seed)


def test_few_keyframes_tell_nothing() -> None:
    assert clock_steps(np.array([0.0, 1.0, 100.0]), np.array([0.0, 1.0, 2.0])) == []
    assert clock_steps(np.zeros(20), np.arange(20.0)) == []


def watched(stamp_s: np.ndarray, time_s: np.ndarray, backend: Backend) -> None:
    """Let keyframes come one after the other, as a node or a replay does."""
    watch = ClockWatch()
    for k, (stamp, time) in enumerate(zip(stamp_s, time_s, strict=True)):
        one = Keyframe(0, k, round(1e9 * (stamp + 1e6)), "odom", np.array([0.5 * k, 0.0, 0.0]), np.eye(4)[3])
        watch.came(backend, one, float(time))
        backend.add(one)


@pytest.mark.parametrize("step_s", [3600.0, 0.6, -0.15])
def test_a_step_is_said_while_keyframes_come(step_s: float) -> None:
    stamp, time = drive(3)
    backend = Backend(Config())
    watched((stamp + step_s * (np.arange(N) >= 23))[:28], time[:28], backend)
    where, named = "forward" if step_s > 0.0 else "back", backend.scene.log.warnings["clock_step"]
    assert f"jump {where} by " in named and "at keyframe 23 (" in named and "times more" not in named


def test_steps_are_counted_in_a_map_that_is_longer_than_what_is_kept() -> None:
    stamp, time = (np.concatenate([part, part[-1] + 0.5 + part]) for part in drive(4))
    k, backend = np.arange(2 * N), Backend(Config())
    watched(stamp + 60.0 * (k >= 20) + 7.0 * (k >= 70) - 3.0 * (k >= 100), time, backend)
    found = backend.scene.log.warnings["clock_step"]
    assert "forward by 59.99 s at keyframe 20 (" in found and ", and 2 times more" in found


@pytest.mark.parametrize("kind", SOUND)
def test_nothing_is_said_of_a_sound_clock_at_any_keyframe(kind: str) -> None:
    for seed in SEEDS:
        backend = Backend(Config())
        watched(*sound(kind, seed), backend)
        assert "clock_step" not in backend.scene.log.warnings, (kind, seed, backend.scene.log.warnings)


def test_a_recording_that_plays_again_is_no_step() -> None:
    stamp, time = drive(5)
    backend, watch = Backend(Config()), ClockWatch()
    for lap in range(2):
        for k in range(N):
            position = np.array([0.5 * k, 0.0, 0.0])
            one = Keyframe(0, k, round(1e9 * (stamp[k] + 1e6)), "odom", position, np.eye(4)[3])
            watch.came(backend, one, float(time[k] + lap * (time[-1] + 1.0)))
            backend.add(one)
    assert "clock_step" not in backend.scene.log.warnings
    assert backend.map.index == 1, "the second lap is a map of its own"


def test_steps_are_told_from_a_tenth_of_a_second_on() -> None:
    """Below that there is nothing to look at, however even the keyframes come."""
    time = 0.5 * np.arange(N)
    late = np.random.default_rng(0).uniform(0.0, 1e-3, N)
    for step_s, at in ((0.102, [23]), (-0.102, [23]), (0.098, []), (-0.098, []), (0.04, []), (0.06, [])):
        assert [k for k, _ in clock_steps(time + step_s * (np.arange(N) >= 23), time + late)] == at, step_s
