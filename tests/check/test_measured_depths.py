# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Depths that err by more or less with the distance are told from depths that are noisy or scaled."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from ba_node.arrays import FloatArray, changed
from ba_node.backend import Backend
from ba_node.check.measured_depths import depths_err
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.measurements import FeatureTracks
from ba_node.scene.scene import Scene
from experiments.synthetic import SyntheticData
from tests.check.set_ups import recording, scene_of

KEYFRAMES = 30


def refined(data: SyntheticData, measured: Callable[[FloatArray], FloatArray] = lambda depth: depth) -> Scene:
    """Return a scene whose keyframes are where they truly are, with other depths."""
    scene = scene_of(data, KEYFRAMES)
    table = scene.keyframes
    place = [data.truth.keyframe_id.tolist().index(number) for number in table.keyframe_id.tolist()]
    table.position[:] = data.truth.position[place]
    table.rotation[:] = geometry.matrix_from_quaternion(data.truth.orientation[place])
    table.refined[:] = True
    scene.observations.depth_m[:] = measured(scene.observations.depth_m.astype(float))
    return scene


def cause(scene: Scene) -> str:
    check = depths_err(scene)
    return check.found.causes() if check is not None and check.found is not None else ""


@pytest.mark.parametrize("offset", [-0.2, 0.2])
def test_an_offset_is_measured(offset: float) -> None:
    found = re.fullmatch(
        r"depth_m is off by about ([+-]\d\.\d\d) m at all distances",
        cause(refined(recording(mode="rgbd", path="line"), lambda depth: depth + offset)),
    )
    assert found
    assert float(found[1]) == pytest.approx(offset, abs=0.06)


@pytest.mark.parametrize("measured", [lambda d: np.minimum(d, 9.0), lambda d: np.round(0.4 * d) / 0.4])
def test_depths_that_are_cut_off_or_rounded_are_named(measured: Callable[[FloatArray], FloatArray]) -> None:
    assert "cut off or rounded" in cause(refined(recording(mode="rgbd", path="line"), measured))


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.1])
def test_a_scale_is_no_offset(factor: float) -> None:
    """Lengths are compared with steps elsewhere."""
    assert cause(refined(recording(mode="rgbd", path="line"), lambda depth: factor * depth)) == ""


@pytest.mark.slow
@pytest.mark.parametrize("path", ["line", "loop"])
def test_noise_is_no_error(path: str) -> None:
    """Noise of a share of depth, or of its square, as of depths by two images."""
    data = recording(mode="rgbd", path=path)
    for seed in range(10):
        for share, square in ((0.0, 0.0), (0.03, 0.0), (0.0, 0.004)):
            noise = np.random.default_rng(seed)
            scene = refined(data, lambda d: d * (1.0 + (share + square * d) * noise.normal(size=len(d))))  # noqa: B023
            assert cause(scene) == "", f"seed {seed}, {share} of depth, {square} of its square"


def test_nothing_is_asked_where_much_moves() -> None:
    scene = refined(recording(mode="rgbd", path="line"), lambda depth: depth + 0.2)
    assert cause(scene)
    scene.log.warn("moving", "much of what is seen moves")
    assert cause(scene) == ""


@pytest.mark.slow
def test_what_came_in_stands_where_depths_have_an_offset() -> None:
    data = recording(mode="rgbd", path="line")
    stream = [
        changed(one, depth_m=one.depth_m - 0.15) if isinstance(one, FeatureTracks) and len(one.depth_m) else one
        for _, _, one in data.timeline()
    ]
    backend = Backend(Config())
    for _ in backend.replay(stream):
        pass
    table = backend.scene.keyframes
    assert re.search(r"depth_m is off by about -0\.\d\d m", backend.scene.log.warnings["setup"])
    assert not table.refined.any()
    assert np.array_equal(table.position, table.input_position)
