# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Factors from the front-end's steps: what they measure, how much they count, and what they hold."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.core.factors import RelativePoses
from ba_node.estimate import Poses
from ba_node.evaluation.alignment import Kind
from ba_node.evaluation.metrics import AbsoluteError, absolute_error
from ba_node.measurements import FeatureTracks, Keyframe, Measurement
from ba_node.scene.scene import Scene
from ba_node.window import odometry, select
from ba_node.window.selection import Selection
from experiments.robustness.faults import SOUND, spoiled
from experiments.robustness.faults.recording import Recording, rows_of
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

GOOD = {"drift_rotation_deg": 0.2, "drift_translation": 0.01}
PRECISE = {"drift_rotation_deg": 0.02, "drift_translation": 0.002}
ON = Config()
OFF = ON.with_values({"odometry.enabled": False})


def made(**options: Any) -> SyntheticData:
    base: dict[str, Any] = {
        "seed": 3,
        "keyframes": 12,
        "length_m": 12.0,
        "path": "line",
        "landmarks": 800,
        "tracks": 80,
    }
    return generate(SyntheticOptions(**{**base, **GOOD, **options}))


def selected(data: SyntheticData, config: Config = ON) -> tuple[Scene, Selection]:
    scene = Scene(config.scene)
    for _, _, measurement in data.timeline():
        scene.add(measurement)
    selection = select(scene, config)
    assert isinstance(selection, Selection), selection
    return scene, selection


def kinds(selection: Selection) -> tuple[RelativePoses, RelativePoses]:
    """Return the factors on rotation and those on translation."""
    turn, move = selection.problem.factors
    assert isinstance(turn, RelativePoses) and isinstance(move, RelativePoses)
    return turn, move


def played(stream: list[Measurement], config: Config = ON) -> Backend:
    backend = Backend(config)
    for measurement in stream:
        if backend.completes(measurement):
            backend.solve()
        backend.add(measurement)
    backend.flush(final=True)
    while backend.ready:
        backend.solve()
    return backend


def errors(stream: list[Measurement], truth: Poses, config: Config = ON) -> tuple[float, float]:
    """Return the error of what came in and of what came out, m."""
    refined = played(stream, config).estimate().trajectory
    inputs = {one.keyframe_id: one for one in stream if isinstance(one, Keyframe)}
    given = [inputs[key] for key in refined.keyframe_id.tolist()]
    came = dataclasses.replace(
        refined,
        position=np.array([one.position for one in given]),
        orientation=np.array([one.orientation for one in given]),
    )
    before, after = (absolute_error(poses, truth).translation.rmse for poses in (came, refined))
    return before, after


def test_they_measure_the_steps_of_the_front_end() -> None:
    scene, selection = selected(made())
    table = scene.keyframes
    for kind in kinds(selection):
        assert len(kind) == selection.problem.n_keyframes - 1 == 11
        for (i, j), rotation, translation in zip(kind.keyframes, kind.rotation, kind.translation, strict=True):
            a, b = selection.keyframes[i], selection.keyframes[j]
            back = geometry.inverse(table.input_rotation[a], table.input_position[a])
            expected = geometry.compose(*back, table.input_rotation[b], table.input_position[b])
            np.testing.assert_allclose(rotation, expected[0], atol=1e-12)
            np.testing.assert_allclose(translation, expected[1], atol=1e-12)


def test_their_precision_is_that_of_the_parameters() -> None:
    sigmas = {"sigma_m": 0.5, "sigma_m_per_m": 0.25, "sigma_rad": 0.125, "sigma_rad_per_m": 2.0}
    config = Config().with_values({f"odometry.{name}": value for name, value in sigmas.items()})
    config = config.with_values({"odometry.sigma_rad_per_rad": 4.0})
    _, selection = selected(made(), config)
    turn, move = kinds(selection)
    length = np.linalg.norm(move.translation, axis=1)
    angle = np.linalg.norm(geometry.so3_log(move.rotation), axis=1)
    np.testing.assert_allclose(1.0 / move.root_information[:, 4, 4], 0.5 + 0.25 * length)
    # Through the arc cosine of the trace, which loses digits near zero.
    np.testing.assert_allclose(1.0 / turn.root_information[:, 1, 1], 0.125 + 2.0 * length + 4.0 * angle, rtol=1e-6)
    assert not move.root_information[:, :3].any() and not turn.root_information[:, 3:].any()


def test_they_bridge_keyframes_that_take_no_part() -> None:
    """The path, not the distance, tells how precise a step over several keyframes is."""
    scene, selection = selected(made())
    rows = selection.keyframes[[0, 3, 4]]
    problem = dataclasses.replace(selection.problem, fixed=np.zeros(3, bool), observations=_none(selection))
    _, move = odometry.factors(scene, Config().odometry, problem, rows)
    assert isinstance(move, RelativePoses)
    _, every = kinds(selection)
    travelled = np.linalg.norm(every.translation, axis=1)[:3].sum()
    config = Config().odometry
    assert 1.0 / move.root_information[0, 3, 3] == pytest.approx(config.sigma_m + config.sigma_m_per_m * travelled)


def _none(selection: Selection) -> Any:
    obs = selection.problem.observations
    return dataclasses.replace(obs, **{name: array[:0] for name, array in vars(obs).items()})


def test_off_is_off() -> None:
    _, selection = selected(made(), OFF)
    assert selection.problem.factors == ()


def test_fixed_keyframes_are_not_tied_to_each_other() -> None:
    scene, selection = selected(made())
    fixed = np.arange(12) < 7
    problem = dataclasses.replace(selection.problem, fixed=fixed)
    turn, _ = odometry.factors(scene, Config().odometry, problem, selection.keyframes)
    assert turn.keyframes.tolist() == [[k, k + 1] for k in range(6, 11)]
    held = dataclasses.replace(selection.problem, fixed=np.ones(12, bool))
    assert odometry.factors(scene, Config().odometry, held, selection.keyframes) == ()


@pytest.mark.slow
def test_bad_odometry_counts_less_once_images_tell() -> None:
    """Where steps are off by 5 % of their length the standard deviation of 1 % grows about fivefold."""
    found = []
    for drift in (0.05, 0.002):
        data = made(keyframes=40, length_m=40.0, drift_rotation_deg=0.01, drift_translation=drift, landmarks=2000)
        backend = played([one for _, _, one in data.timeline()])
        selection = select(backend.scene, backend.config)
        assert isinstance(selection, Selection)
        _, move = kinds(selection)
        length = np.linalg.norm(move.translation, axis=1)
        config = Config().odometry
        found.append(
            float(np.median(1.0 / move.root_information[:, 3, 3] / (config.sigma_m + config.sigma_m_per_m * length)))
        )
    assert 2.5 < found[0] < 7.0 and found[1] <= 1.0, found


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["mono", "stereo"])
@pytest.mark.parametrize("fault", ["stands_still", "stops_midway"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_standing_still_keeps_the_scale(fault: str, rig: str, seed: int) -> None:
    recording = spoiled(fault, rig, seed=seed)
    before, after = errors([one for _, _, one in recording.timeline], recording.truth)
    assert after <= 1.1 * before, f"{before:.4f} -> {after:.4f} m"


@pytest.mark.slow
@pytest.mark.parametrize("baseline_m", [0.0, 0.12])
@pytest.mark.parametrize("seed", [0, 1])
def test_few_observations_do_no_harm(baseline_m: float, seed: int) -> None:
    """Without the steps 0.3 m became 1 to 600 m."""
    data = made(
        seed=seed, baseline_m=baseline_m, keyframes=300, length_m=200.0, path="loop", landmarks=10_000, tracks=20,
        drift_rotation_deg=0.6, drift_translation=0.03,
    )  # fmt: skip
    before, after = errors([one for _, _, one in data.timeline()], data.truth)
    assert after <= before, f"{before:.4f} -> {after:.4f} m"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("points", "seed"),
    [(8.0, 2), pytest.param(8.0, 1, marks=pytest.mark.slow), pytest.param(12.0, 2, marks=pytest.mark.slow)],
)
def test_few_points_of_two_cameras_tell_how_bad_steps_are(points: float, seed: int) -> None:
    """Each outvoted steps that were 2.4 of their sigmas off: 0.051 m became 0.066."""
    recording = spoiled("few_points", "stereo", points, seed)
    before, after = errors([one for _, _, one in recording.timeline], recording.truth)
    assert after <= 1.05 * before, f"{before:.4f} -> {after:.4f} m"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_twenty_tracks_on_a_long_path_do_better(seed: int) -> None:
    recording = spoiled("few_observations", "stereo", seed=seed)
    before, after = errors([one for _, _, one in recording.timeline], recording.truth)
    assert after <= 0.25 * before, f"{before:.4f} -> {after:.4f} m"


def test_keyframes_that_see_little_keep_to_turns_that_others_show_to_be_precise() -> None:
    data = made(tracks=150, keyframes=14, drift_rotation_deg=0.02)
    weak_id = int(data.truth.keyframe_id[12])

    def thinned(one: Measurement) -> Measurement:
        if not isinstance(one, FeatureTracks) or one.keyframe_id != weak_id:
            return one
        return rows_of(one, np.arange(min(20, len(one.uv))))

    backend = played([thinned(one) for _, _, one in data.timeline()])
    selection = select(backend.scene, ON)
    assert isinstance(selection, Selection)
    seen = np.bincount(selection.problem.observations.keyframe, minlength=selection.problem.n_keyframes)
    turn, move = kinds(selection)
    stated = odometry.stated(backend.scene, ON.odometry, selection.keyframes)
    weak = np.asarray((seen[turn.keyframes] < odometry.MANY_OBSERVATIONS).any(axis=1))
    assert np.count_nonzero(weak) == 2 and len(weak) == len(stated.first)
    share = 1.0 / turn.root_information[:, 1, 1] / stated.sigma_rad
    assert (share[weak] < 0.5).all() and (share[weak] >= 0.2).all() and (share[~weak] >= 1.0).all()
    assert (1.0 / move.root_information[:, 4, 4] >= stated.sigma_m).all(), "lengths of one camera follow the steps"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [101, 104, 109])
def test_a_turn_on_the_spot_past_a_bare_wall_is_no_worse_than_it_came(seed: int) -> None:
    recording = spoiled("pure_rotation", "mono", 8.0, seed, path="loop", length_m=30.0, keyframes=60)
    refined = played(list(recording.measurements)).estimate().trajectory
    before, after = (
        absolute_error(poses, recording.truth, "none").rotation.rmse for poses in (recording.odometry, refined)
    )
    assert after < 1.1 * before, (before, after)


def test_steps_that_err_aside_count_as_long_as_they_are() -> None:
    """Turned by an angle against the map's steps they are along these by its cosine shorter."""
    scene, selection = selected(made(baseline_m=0.0, drift_rotation_deg=0.0, drift_translation=0.0))
    table = scene.keyframes
    table.refined[:] = True
    turn = geometry.so3_exp(np.array([0.0, 0.0, 0.2]))
    table.input_rotation[:] = table.input_rotation @ turn
    _, move = odometry.factors(scene, ON.odometry, selection.problem, selection.keyframes)
    assert isinstance(move, RelativePoses)
    pairs = selection.keyframes[move.keyframes.T]
    _, steps = geometry.steps_between(table.rotation, table.position, *pairs)
    along = np.sum(move.translation * steps, axis=1) / np.sum(steps * steps, axis=1)
    assert float(np.median(along)) == pytest.approx(1.0, abs=0.002), along


def test_a_front_end_that_moves_in_a_plane_does_not_shorten_the_map_of_one_camera() -> None:
    """Of steps that lead up and down it has what is level alone; the map's would be shorter by 1.2 %."""
    data = made(keyframes=40, length_m=20.0, baseline_m=0.0, landmarks=2500, tracks=150, **PRECISE)
    stream: list[Measurement] = []
    for _, _, one in data.timeline():
        if not isinstance(one, Keyframe):
            stream.append(one)
            continue
        turn = geometry.matrix_from_quaternion(one.orientation)
        turn = geometry.so3_exp(np.array([0.0, 0.0, np.arctan2(turn[1, 0], turn[0, 0])]))
        level, orientation = one.position * [1.0, 1.0, 0.0], geometry.quaternion_from_matrix(turn)
        stream.append(dataclasses.replace(one, position=level, orientation=orientation))
    refined = played(stream).estimate().trajectory
    lengths = [float(np.linalg.norm(poses.position[-1] - poses.position[0])) for poses in (refined, data.truth)]
    assert lengths[0] / lengths[1] == pytest.approx(1.0, abs=0.006)


def test_steps_of_a_body_that_turns_on_the_spot_tell_no_length() -> None:
    recording = spoiled("stands_still", "mono", 5.0, 4, keyframes=12, length_m=10.0)
    scene = Scene(ON.scene)
    for measurement in recording.measurements:
        scene.add(measurement)
    still = odometry.tell_nothing(scene, ON.odometry, scene.order)
    assert still.tolist() == 5 * [True] + 7 * [False]
    assert not odometry.tell_nothing(scene, OFF.odometry, scene.order).any(), "nobody steps"


def of_a_replay(recording: Recording, alignment: Kind) -> list[AbsoluteError]:
    """Return how wrong the front-end's poses of a recording are, and those of a replay."""
    refined = played(list(recording.measurements)).estimate().trajectory
    return [absolute_error(poses, recording.truth, alignment) for poses in (recording.odometry, refined)]


@pytest.mark.parametrize("fault", ["pure_rotation", "far_points"])
def test_tracks_whose_noise_feigns_parallax_turn_no_keyframe(fault: str) -> None:
    """Their rotation alone is 8 degrees a keyframe; points that are far away let a camera that moves be turned."""
    recording = spoiled(fault, "mono", {"pure_rotation": 8.0, "far_points": 1.0}[fault], 2)
    before, after = (error.rotation.rmse for error in of_a_replay(recording, "none"))
    assert after < (1.1 if fault == "pure_rotation" else 0.5) * before, f"{before:.3f} -> {after:.3f} deg"


@pytest.mark.parametrize(("seed", "look_deg"), [(703, 0.0), (703, 90.0)])
def test_images_far_noisier_than_they_say_do_not_outvote_steps(seed: int, look_deg: float) -> None:
    """They are six times as far off as sigma_px says."""
    recording = spoiled(SOUND, "stereo", seed=seed, look_deg=look_deg, noise_px=3.0)
    recording = recording.changed(
        FeatureTracks, lambda image: dataclasses.replace(image, sigma_px=image.sigma_px / 6.0)
    )
    before, after = (error.translation.rmse for error in of_a_replay(recording, "se3"))
    assert after < 1.1 * before, f"{before:.4f} -> {after:.4f} m"
