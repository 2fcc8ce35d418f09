# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Factors that most of their kind are outvoted are said, with the kind and what may be wrong; sound ones are not."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.measurements import GravityDirection, Keyframe, LandmarkPriors, Measurement, PosePrior, RelativePose
from experiments.robustness.faults import spoiled
from tests.window.street import More, stream

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
Change = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
SHORT = {"keyframes": 20, "length_m": 10.0, "tracks": 100}
DATA = {rig: spoiled("sound", rig, seed=2, **SHORT).sound for rig in ("stereo", "mono")}


def relative(change: Change, rig: str = "stereo") -> More:
    """Return steps of 1 % and 2 mrad; turn, move and standard deviations (m, rad) are given otherwise."""
    truth, rng = DATA[rig].truth, np.random.default_rng(4)
    rotation = geometry.matrix_from_quaternion(truth.orientation)

    def of(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        if k == 0:
            return
        back = geometry.inverse(rotation[k - 1], truth.position[k - 1])
        turn, move = geometry.compose(*back, rotation[k], truth.position[k])
        sigma = np.array([0.01 * np.linalg.norm(move)] * 3 + [0.002] * 3)
        turn, move = turn @ geometry.so3_exp(rng.normal(0.0, sigma[3:])), move + rng.normal(0.0, sigma[:3])
        turn, move, sigma = change(turn, move, sigma)
        pose = move, geometry.quaternion_from_matrix(turn)
        before = int(truth.keyframe_id[k - 1])
        yield RelativePose(0, before, keyframe.keyframe_id, False, *pose, np.diag(sigma**2).ravel())

    return of


def gravity(change: Callable[[FloatArray], FloatArray]) -> More:
    """Return directions of gravity of 0.01 rad, given otherwise."""
    rotation, rng = geometry.matrix_from_quaternion(DATA["stereo"].truth.orientation), np.random.default_rng(4)

    def of(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        down = geometry.so3_exp(rng.normal(0.0, 0.01, 3)) @ rotation[k].T @ np.array([0.0, 0.0, -1.0])
        yield GravityDirection(0, keyframe.keyframe_id, change(down), 0.01)

    return of


def told(more: More, rig: str = "stereo", covariance: FloatArray | None = None) -> dict[str, str]:
    """Return the warnings of a replay; ``covariance`` is that of the front-end's steps."""
    data = DATA[rig]
    if covariance is not None:
        keyframes = [data.keyframes[0], *(dataclasses.replace(k, covariance=covariance) for k in data.keyframes[1:])]
        data = dataclasses.replace(data, keyframes=tuple(keyframes))
    backend = Backend(Config())
    for _ in backend.replay(stream(data, more)):
        pass
    return backend.scene.log.warnings


# What the drift of these recordings is worth over a step.
STEPS = np.diag([0.015**2] * 3 + [0.004**2] * 3).ravel()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "named"),
    [
        pytest.param(relative(lambda r, t, s: (r, 1000.0 * t, s)), "relative poses .*in millimetres", id="millimetres"),
        pytest.param(relative(lambda r, t, s: (r.T, -r.T @ t, s)), "relative poses .*are inverted", id="inverted"),
        pytest.param(
            relative(lambda r, t, s: (OPTICAL.T @ r @ OPTICAL, OPTICAL.T @ t, s)),
            "relative poses .*another frame",
            id="optical",
        ),
        pytest.param(
            relative(lambda r, t, s: (r, t, 0.01 * s)), "relative poses .*covariance is too small", id="covariance"
        ),
        pytest.param(gravity(lambda down: -down), "directions of gravity .*they point up", id="up"),
        pytest.param(gravity(lambda down: OPTICAL.T @ down), "directions of gravity .*another", id="optical_down"),
    ],
)
def test_most_of_a_kind_are_outvoted_and_it_is_named(more: More, named: str) -> None:
    warnings = told(more)
    assert set(warnings) == {"outvoted"}, warnings
    assert re.search(named, warnings["outvoted"]), warnings


def test_steps_of_the_front_end_are_not_accused_of_what_relative_poses_are() -> None:
    """They are factors of one kind."""
    of_each = relative(lambda r, t, s: (r, 1000.0 * t, s))
    warnings = told(lambda k, one: of_each(k, one) if k % 2 else (), covariance=STEPS)
    assert re.match("10 of 10 relative poses .*in millimetres", warnings["outvoted"]), warnings
    assert "steps of the front-end" not in warnings["outvoted"], warnings


def test_sound_factors_and_steps_are_not_accused() -> None:
    sources = relative(lambda *step: step), gravity(lambda down: down)
    assert told(lambda k, one: [m for source in sources for m in source(k, one)], covariance=STEPS) == {}


@pytest.mark.slow
def test_steps_whose_covariance_is_far_too_small_are_said() -> None:
    warnings = told(lambda *_: (), covariance=1e-6 * STEPS)
    assert "pose.covariance in the keyframes is too small" in warnings.get("outvoted", ""), warnings


def test_relative_poses_that_spoil_every_solve_are_named_instead_of_the_cameras() -> None:
    """One camera takes its scale from them, and nothing is refined: what solves say then is not so."""
    warnings = told(relative(lambda r, t, s: (r, 0.001 * t, s), "mono"), "mono")
    assert set(warnings) == {"outvoted"}, warnings
    assert "in kilometres" in warnings["outvoted"], warnings


@pytest.mark.slow
def test_the_kind_and_the_unit_of_priors_far_beside_the_map_are_said() -> None:
    data = DATA["stereo"]
    known = np.arange(0, len(data.track_id), 10)
    points = data.landmarks[data.track_landmark[known]]
    variance = np.tile(1e-4 * np.eye(3), (len(known), 1, 1))
    priors = LandmarkPriors(0, "map", data.track_id[known], 1000.0 * points, variance)
    text = " ".join(told(lambda k, _: [priors] if k == 0 else []).values())
    assert "landmark priors: their positions are in millimetres" in text, text

    def poses(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        where = 1000.0 * data.truth.position[k], data.truth.orientation[k]
        yield PosePrior(keyframe.stamp_ns, "map", *where, np.diag([1e-2] * 3 + [1e-4] * 3).ravel())

    text = " ".join(told(poses).values())
    assert "pose priors: their positions are in millimetres" in text, text
