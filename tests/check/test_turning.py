# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A focal length that is a little off turns a map of one camera; odometry whose turns are off does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.evaluation.metrics import absolute_error
from ba_node.io.bal import read_bal
from ba_node.io.model import from_bal
from ba_node.measurements import FeatureTracks, Keyframe
from ba_node.offline.convert import timeline
from experiments.synthetic import SyntheticData
from tests.check.set_ups import intrinsics, poses, recording

PRECISE = {"drift_rotation_deg": 0.02, "drift_translation": 0.002, "keyframes": 50}


def replayed(data: SyntheticData) -> Backend:
    backend = Backend(Config())
    for _ in backend.replay(measurement for _, _, measurement in data.timeline()):
        pass
    return backend


def ratio(backend: Backend, data: SyntheticData) -> float:
    """Return the rotation error of the result, in those of what came in."""
    result, given = (absolute_error(one, data.truth) for one in (backend.estimate().trajectory, data.odometry))
    return result.rotation.rmse / given.rotation.rmse


@pytest.mark.parametrize(("factor", "seed"), [(0.98, 11), (1.02, 12)])
def test_a_focal_length_that_is_a_little_off_turns_no_map(factor: float, seed: int) -> None:
    sound = recording(seed, "", "mono", reobserve=False, **PRECISE)
    data = intrinsics(lambda k: k * [factor, factor, 1.0, 1.0])(sound)
    backend = replayed(data)
    reason = backend.setup.reason(backend.scene)
    assert f"focal length off by a factor of about {factor:.2f}" in reason, reason
    assert ratio(backend, data) < 1.05


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_odometry_whose_turns_are_off_is_bettered(factor: float) -> None:
    def scaled(rotation: np.ndarray, position: np.ndarray, _: SyntheticData) -> tuple[np.ndarray, np.ndarray]:
        number = np.arange(len(position))
        turn, move = geometry.steps_between(rotation, position, number[:-1], number[1:])
        turn = geometry.so3_exp(factor * geometry.so3_log(turn))
        rotation, position = rotation.copy(), position.copy()
        for k in number[:-1].tolist():
            rotation[k + 1], position[k + 1] = geometry.compose(rotation[k], position[k], turn[k], move[k])
        return rotation, position

    data = poses(scaled)(recording(13, "", "mono", **PRECISE))
    backend = replayed(data)
    assert not backend.setup.reason(backend.scene)
    assert ratio(backend, data) < 0.5


@pytest.mark.parametrize("keyframes", [9, 12])
def test_few_turns_of_a_sound_recording_tell_nothing(keyframes: int, shared_data: Path) -> None:
    """The first of Ladybug: images alone call its focal length 4 to 5 % off, seven turns one of 0.01."""
    model = from_bal(read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"))
    backend = Backend(Config())
    measurements = [measurement for _, _, measurement in timeline(model)]
    ids = [one.keyframe_id for one in measurements if isinstance(one, Keyframe)][:keyframes]
    first = [one for one in measurements if not isinstance(one, Keyframe | FeatureTracks) or one.keyframe_id in ids]
    for _ in backend.replay(first):
        pass
    assert backend.map.summary().refined == keyframes
    assert not backend.setup.reason(backend.scene)
