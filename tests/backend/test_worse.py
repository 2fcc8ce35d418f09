# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Where a map as a whole explains what was observed worse than what came in, that stands at the end; what draws it."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.backend.worse import explains_worse, keep_lengths, most_moves, torn
from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.evaluation.metrics import absolute_error
from experiments.robustness.faults import SOUND, Recording, spoiled


def test_few_keyframes_at_their_optimum_that_windows_make_worse_are_kept() -> None:
    recording = spoiled("optimal_map", "mono", seed=331, path="loop", noise_px=1.0, keyframes=8)
    backend = Backend(Config())
    events = [one for one in backend.replay(iter(recording.measurements)) if isinstance(one, Estimate)]
    np.testing.assert_allclose(events[-1].trajectory.position, recording.odometry.position, atol=1e-9)
    (line,) = (line for line in backend.report.warnings if "worse than what came in" in line)
    assert "rms with none above 10 sigmas 0.995 -> 1.22 px" in line


def replayed(recording: Recording, **settings: object) -> Backend:
    """Return a back-end that has seen a recording."""
    backend = Backend(Config().with_values(settings))
    for _ in backend.replay(iter(recording.measurements)):
        pass
    return backend


@pytest.mark.parametrize("rig", ["stereo", "mono", "rgbd"])
def test_a_good_map_that_is_moved_aside_is_worse(rig: str) -> None:
    recording = spoiled(SOUND, rig, seed=12, keyframes=12, length_m=10.0)
    backend = replayed(recording)
    scene = backend.scene
    assert explains_worse(scene, backend.config) is None and scene.keyframes.refined.all()
    scene.keyframes.position[scene.order[::2], 2] += 0.3
    check = explains_worse(scene, backend.config)
    assert check is not None and check.found is not None and check.found.harmful


@pytest.mark.parametrize("rig", ["stereo", "mono"])
def test_a_step_that_few_tracks_bear_out_tears_the_map(rig: str) -> None:
    """As where one camera follows a vehicle that drives ahead: 0.01 m became 1.3 m, by one step of 4 m."""
    recording = spoiled(SOUND, rig, seed=12, keyframes=14, length_m=10.0)
    backend = replayed(recording)
    scene = backend.scene
    late = scene.places()[scene.observations.keyframe] >= 7
    scene.keyframes.position[scene.order[7:]] += [0.0, 4.0, 0.0]
    assert torn(scene, backend.config) is None, "nothing gave a reason to ask"
    scene.log.warn("stray", "one was placed by its tracks")
    assert torn(scene, backend.config) is None, "all tracks across the step agree, as where a front-end jumps"
    early = np.unique(scene.observations.landmark[~late])
    scene.observations.outlier[late & np.isin(scene.observations.landmark, early)] = True
    check = torn(scene, backend.config)
    assert check is not None and check.found is not None and check.found.harmful
    assert f"the step to keyframe {scene.keyframes.keyframe_id[scene.order[7]]}" in check.found.causes()
    assert most_moves(scene, backend.config) is None, "nothing moves"


@pytest.mark.parametrize(
    ("share", "settings", "said"),
    [
        (0.1, {"solver.loss": "squared", "tracks.outlier_px": 0.0}, True),
        (0.01, {"solver.loss": "squared", "tracks.outlier_px": 0.0}, True),
        (0.01, {"solver.loss": "squared"}, False),
        (0.01, {"tracks.outlier_px": 0.0}, False),
        (0.0, {"solver.loss": "squared", "tracks.outlier_px": 0.0}, False),
    ],
)
def test_mismatches_that_nothing_bounds_are_said(share: float, settings: dict[str, object], said: bool) -> None:
    recording = spoiled(SOUND, "mono", seed=7, keyframes=15, outlier_share=share)
    backend = replayed(recording, **settings)
    assert backend.solve_count
    assert any("nothing bounds how far each draws the map" in line for line in backend.report.warnings) == said


@pytest.mark.parametrize("rig", ["stereo", "rgbd"])
def test_lengths_that_are_doubted_are_those_of_the_front_end(rig: str) -> None:
    """The map keeps its shape; what follows from its last pose follows."""
    recording = spoiled(SOUND, rig, seed=12, keyframes=30, length_m=15.0)
    backend = replayed(recording)
    scene, config = backend.scene, backend.config
    assert not keep_lengths(scene, config), "the map is sound"
    table = scene.keyframes
    table.input_rotation[:], table.input_position[:] = table.rotation, table.position.copy()
    noise = np.random.default_rng(3).normal(size=table.position.shape)
    table.input_position[:] = table.position / 1.008 + 0.002 * noise
    before, points = table.position.copy(), scene.landmarks.position.copy()
    assert keep_lengths(scene, config) and scene.log.notices["lengths_kept"] == 1
    first, last = scene.order[[0, -1]]
    ratio = np.linalg.norm(before[last] - before[first]) / np.linalg.norm(table.position[last] - table.position[first])
    assert ratio == pytest.approx(1.008, abs=0.002)
    placed = scene.landmarks.has_position
    np.testing.assert_allclose(
        points[placed] - before[first], ratio * (scene.landmarks.position[placed] - before[first])
    )
    assert not keep_lengths(scene, config), "once is enough"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "rig", "amount", "seed"),
    [("baseline_off", "stereo", 0.98, 100), (SOUND, "mono", None, 7), ("focal_slightly_off", "mono", 0.95, 2)],
)
def test_lengths_that_images_tell_badly_do_no_harm(fault: str, rig: str, amount: float | None, seed: int) -> None:
    recording = spoiled(fault, rig, amount, seed)
    backend = replayed(recording)
    came, found = (
        absolute_error(poses, recording.truth, "se3").translation.rmse
        for poses in (recording.odometry, backend.estimate().trajectory)
    )
    assert found < came, f"{came:.4f} -> {found:.4f} m"
