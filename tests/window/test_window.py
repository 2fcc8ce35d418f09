# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node import native, window
from ba_node.arrays import IntArray
from ba_node.config import Config
from ba_node.core import geometry, native_kernels, objective
from ba_node.core.result import Result, Status
from ba_node.measurements import FeatureTracks, Keyframe, Measurement
from ba_node.scene.scene import Scene
from ba_node.window.merging import _doubted
from experiments.synthetic import SyntheticOptions, generate

TRACKS = Config().tracks
QUIET: dict[str, Any] = {
    "keyframes": 12, "landmarks": 800, "tracks": 60, "length_m": 12.0, "path": "line", "noise_px": 0.0,
    "outlier_share": 0.0, "drift_rotation_deg": 0.0, "drift_translation": 0.0, "ids": "random64",
}  # fmt: skip


def config(**changes: Any) -> Config:
    """Return parameters; no track is held out of a solve, so that all that is selected is solved."""
    values = {name.replace("__", "."): value for name, value in changes.items()}
    return Config().with_values({"guard.held_out_tracks": 0, **values})


def scene_of(settings: Config, offset: float = 0.0, **options: Any) -> Scene:
    """Return a scene of a synthetic recording, moved by ``offset`` along each axis, m."""
    scene = Scene(settings.scene)
    for _, _, measurement in generate(SyntheticOptions(**{**QUIET, **options})).timeline():
        scene.add(moved(measurement, offset))
    return scene


def moved(measurement: Measurement, offset: float) -> Measurement:
    if isinstance(measurement, Keyframe):
        return dataclasses.replace(measurement, position=measurement.position + offset)
    return measurement


def selected(scene: Scene, settings: Config) -> window.Selection:
    selection = window.select(scene, settings)
    assert isinstance(selection, window.Selection), selection
    selection.problem.check()
    return selection


def solved(selection: window.Selection, status: Status = Status.CONVERGED) -> Result:
    return Result(selection.problem.start, status, "", "test", ())


def test_newest_are_free_older_that_share_most_are_fixed() -> None:
    settings = config(window__max_keyframes=4, window__max_fixed_keyframes=3)
    scene = scene_of(settings)
    scene.keyframes.refined[:] = True
    selection = selected(scene, settings)
    order = scene.order.tolist()
    assert selection.window.tolist() == order[-4:]
    assert selection.keyframes[~selection.problem.fixed].tolist() == order[-4:]
    fixed = selection.keyframes[selection.problem.fixed].tolist()
    assert len(fixed) == 3
    # Counted another way: tracks in common with the window, keyframe by keyframe.
    seen = [set(scene.observations.landmark[scene.observations.keyframe == row].tolist()) for row in order]
    views = [scene.observations.landmark[scene.observations.keyframe == row].tolist() for row in order]
    in_window = set().union(*seen[-4:])
    shared = {row: sum(landmark in in_window for landmark in views[i]) for i, row in enumerate(order[:-4])}
    assert min(shared[row] for row in fixed) >= max(shared[row] for row in order[:-4] if row not in fixed)


def test_who_stands_still_gathers_no_more_views_than_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same images again and again: what is gathered stays bounded, and the newest keyframes are held fixed."""
    settings = config(window__max_keyframes=4, window__max_fixed_keyframes=3)
    scene = scene_of(settings, guesses=True)
    data = generate(SyntheticOptions(**QUIET))
    keyframe, (left, right) = data.keyframes[-1], data.tracks[-1]
    first = selected(scene, settings)
    scene.landmarks.position[first.landmarks] = first.problem.start.points + first.origin
    scene.landmarks.has_position[first.landmarks] = True
    scene.landmarks.has_guess[:] = False
    gathered: list[int] = []
    views_of = scene.views_of

    def counted(landmarks: IntArray, newest: int | None = None) -> IntArray:
        found = views_of(landmarks, newest)
        gathered.append(len(found))
        return found

    monkeypatch.setattr(scene, "views_of", counted)
    for i in range(1, 60):
        scene.add(dataclasses.replace(keyframe, keyframe_id=i, stamp_ns=keyframe.stamp_ns + i * 10**8))
        for image in (left, right):
            scene.add(dataclasses.replace(image, keyframe_id=i))
        scene.keyframes.refined[:] = True
        selection = selected(scene, settings)
    assert selection.keyframes.tolist() == scene.order[-7:].tolist()
    most = len(left.track_id) * (20 + 4 * 2)
    assert max(gathered) <= most < len(left.track_id) * 2 * 60


def test_older_keyframes_that_were_never_refined_hold_nothing() -> None:
    settings = config(window__max_keyframes=4)
    scene = scene_of(settings)
    scene.keyframes.refined[scene.order[6]] = True
    selection = selected(scene, settings)
    assert selection.keyframes.tolist() == scene.order[[6, 8, 9, 10, 11]].tolist()
    assert selection.problem.fixed.tolist() == [True, False, False, False, False]


def test_without_noise_triangulated_points_have_no_error() -> None:
    settings = config(tracks__min_parallax_deg=0.1)
    selection = selected(scene_of(settings), settings)
    error = objective.reprojection_errors(selection.problem, selection.problem.start)
    # Pixels are float32.
    assert np.abs(error).max() < 2e-3, f"largest error {np.abs(error).max():.1e} px"
    assert selection.problem.n_points > 50


def test_points_have_two_views_and_ids_ascend() -> None:
    settings = config()
    scene = scene_of(settings)
    selection = selected(scene, settings)
    assert np.bincount(selection.problem.observations.point).min() >= 2
    ids = scene.landmarks.track_id[selection.landmarks]
    assert (ids[1:] > ids[:-1]).all()


def test_far_from_the_origin_nothing_is_lost() -> None:
    settings = config()
    near, far = selected(scene_of(settings), settings), selected(scene_of(settings, offset=5e6), settings)
    assert near.problem.n_points == far.problem.n_points
    # 5e6 m leaves 1e-9 m to a double.
    np.testing.assert_allclose(far.problem.start.points, near.problem.start.points, atol=1e-5)
    np.testing.assert_allclose(far.problem.start.translation, near.problem.start.translation, atol=1e-8)


def test_merge_puts_back_what_was_solved_and_nothing_else() -> None:
    settings = config(window__max_keyframes=4)
    scene = scene_of(settings)
    selection = selected(scene, settings)
    state = selection.problem.start
    free = ~selection.problem.fixed
    rotation, translation = state.rotation.copy(), state.translation.copy()
    rotation[free] = geometry.so3_exp(np.array([0.0, 0.0, 0.01])) @ rotation[free]
    translation[free] += 0.1
    moved_state = dataclasses.replace(state, rotation=rotation, translation=translation, points=state.points + 0.05)
    before = scene.keyframes.position.copy()
    window.merge(
        scene,
        selection,
        dataclasses.replace(solved(selection), state=moved_state),
        dataclasses.replace(TRACKS, outlier_px=0.0),
    )
    _, position = geometry.inverse(rotation, translation)
    np.testing.assert_allclose(
        scene.keyframes.position[selection.keyframes[free]], (position + selection.origin)[free], atol=1e-12
    )
    others = np.setdiff1d(scene.order, selection.keyframes[free])
    assert np.array_equal(scene.keyframes.position[others], before[others])
    np.testing.assert_allclose(
        scene.landmarks.position[selection.landmarks], state.points + 0.05 + selection.origin, atol=1e-12
    )
    assert scene.landmarks.has_position.sum() == selection.problem.n_points


@pytest.mark.parametrize("status", [Status.FAILED, Status.SKIPPED])
def test_a_failed_solve_changes_nothing(status: Status) -> None:
    scene = scene_of(config())
    selection = selected(scene, config())
    window.merge(scene, selection, solved(selection, status), TRACKS)
    assert not scene.landmarks.has_position.any()
    assert not scene.keyframes.refined.any()


def test_a_solution_that_is_not_finite_changes_nothing() -> None:
    scene = scene_of(config())
    selection = selected(scene, config())
    bad = dataclasses.replace(selection.problem.start, points=selection.problem.start.points * np.nan)
    window.merge(scene, selection, dataclasses.replace(solved(selection), state=bad), TRACKS)
    assert not scene.landmarks.has_position.any()


def test_outliers_are_left_out_and_come_back() -> None:
    settings = config()
    scene = scene_of(settings)
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    long = np.flatnonzero(scene.landmarks.views[scene.observations.landmark] > 6)[::40]
    true = scene.observations.uv[long].copy()
    scene.observations.uv[long] += 50.0
    selection = selected(scene, settings)
    window.merge(scene, selection, solved(selection), TRACKS)
    assert np.flatnonzero(scene.observations.outlier).tolist() == long.tolist()
    selection = selected(scene, settings)
    assert not np.isin(long, selection.rows[selection.inlier]).any()
    assert np.isin(long, selection.rows).all()
    scene.observations.uv[long] = true
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    assert not scene.observations.outlier.any()


def test_a_bad_window_does_not_lose_its_points() -> None:
    settings = config()
    scene = scene_of(settings)
    rng = np.random.default_rng(0)
    selection = selected(scene, settings)
    scene.observations.uv[:] += rng.normal(0.0, 40.0, scene.observations.uv.shape)
    selection = dataclasses.replace(
        selection,
        observations=dataclasses.replace(
            selection.observations, uv=scene.observations.uv[selection.rows].astype(float)
        ),
    )
    window.merge(scene, selection, solved(selection), TRACKS)
    share = scene.observations.outlier.mean()
    assert share < 0.01, f"{share:.1%} of the observations were left out"


def test_a_point_that_its_views_contradict_is_placed_anew() -> None:
    settings = config()
    scene = scene_of(settings)
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    wrong = selection.landmarks[::50]
    true = scene.landmarks.position[wrong].copy()
    scene.landmarks.position[wrong] += [0.0, 0.0, 3.0]
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    assert scene.landmarks.has_position[wrong].all()
    assert not scene.observations.outlier.any()
    np.testing.assert_allclose(scene.landmarks.position[wrong], true, atol=1e-2)


def test_a_point_whose_views_agree_on_nothing_loses_its_position() -> None:
    settings = config()
    scene = scene_of(settings)
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    wrong = selection.landmarks[::50]
    rows = scene.views_of(wrong)
    scene.observations.uv[rows] = np.random.default_rng(0).uniform(0.0, 480.0, (len(rows), 2))
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    assert not scene.landmarks.has_position[wrong].any()
    assert not scene.observations.outlier.any()


def test_wrong_first_views_do_not_outvote_the_later_ones() -> None:
    """A point stands where its first two views meet, both wrong; twenty later views agree on another place."""
    settings = config()
    scene = scene_of(settings)
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    views = np.bincount(selection.observations.point)
    at = selection.landmarks[np.argmax(views)]
    true = scene.landmarks.position[at].copy()
    rows = np.sort(scene.views_of(np.array([at])))
    scene.observations.uv[rows[:2]] -= [60.0, 0.0]
    scene.observations.outlier[rows[2:]] = True
    camera = scene.keyframes.position[scene.observations.keyframe[rows[0]]]
    scene.landmarks.position[at] = camera + 0.8 * (true - camera) + [0.0, 0.3, 0.0]
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    assert scene.observations.outlier[rows].tolist() == [True, True] + [False] * (len(rows) - 2)
    np.testing.assert_allclose(scene.landmarks.position[at], true, atol=1e-2)


def test_a_point_in_the_plane_of_a_camera_sits_out_the_solve() -> None:
    """Its residual (1e8 px here) would outweigh all others: the objective stays that of the rest."""
    settings = config()
    scene = scene_of(settings)
    window.merge(scene, selection := selected(scene, settings), solved(selection), TRACKS)
    row = scene.order[3]
    camera = scene.keyframes.position[row]
    forward = scene.keyframes.rotation[row][:, 0]
    sideways = scene.keyframes.rotation[row][:, 1]
    seen = scene.observations.landmark[(scene.observations.keyframe == row)][0]
    scene.landmarks.position[seen] = camera + 5.0 * sideways + 1e-5 * forward
    selection = selected(scene, settings)
    assert seen in selection.lost.tolist()
    assert seen not in selection.landmarks.tolist()
    errors = objective.reprojection_errors(selection.problem, selection.problem.start)
    assert np.nanmax(np.abs(errors)) < 1.0


def test_the_cap_keeps_the_points_with_most_views() -> None:
    settings = config(window__max_landmarks=20)
    scene = scene_of(settings)
    everything = selected(scene, config())
    capped = selected(scene, settings)
    assert capped.problem.n_points == 20
    views = np.sort(np.bincount(everything.problem.observations.point))[::-1]
    assert np.bincount(capped.problem.observations.point).min() >= views[19]


def test_a_keyframe_that_sees_too_little_is_held_out() -> None:
    settings = config()
    scene = scene_of(settings)
    stamp = int(scene.keyframes.stamp_ns.max()) + 1
    scene.add(Keyframe(0, 12345, stamp, "odom", np.array([99.0, 0, 0]), np.array([0, 0, 0, 1.0])))
    ids = scene.landmarks.track_id[scene.landmarks.views > 5][: window.MIN_OBSERVATIONS - 1]
    scene.add(FeatureTracks(0, 12345, 0, ids, np.full((len(ids), 2), 100.0)))
    selection = selected(scene, settings)
    row = scene.find_keyframe(12345)
    assert row in selection.window
    assert row not in selection.keyframes


def test_reasons_for_nothing_to_solve() -> None:
    timeline = [m for _, _, m in generate(SyntheticOptions(**QUIET)).timeline()]
    scene = Scene(Config().scene)
    expected = []
    for measurement in (timeline[1], timeline[0], timeline[2], timeline[4]):
        scene.add(measurement)
        expected.append(window.select(scene, Config()))
    assert expected == [
        "no camera rig yet: nothing is known about the cameras",
        "one keyframe only: nothing to refine against",
        "one keyframe only: nothing to refine against",
        "no keyframe of the window sees enough points that others see from another place, by rays that meet",
    ]


def test_points_by_depth_need_one_view() -> None:
    settings = config()
    scene = scene_of(settings, baseline_m=0.0, depth_share=1.0, depth_noise=0.0, max_track_keyframes=3)
    selection = selected(scene, settings)
    assert len(selection.problem.observations.depth_m) == len(selection.problem.observations)
    error = objective.reprojection_errors(selection.problem, selection.problem.start)
    assert np.abs(error).max() < 2e-3
    assert (selection.unscaled == -1).all()
    assert np.count_nonzero(selection.problem.fixed) == 1


def test_one_camera_takes_its_scale_from_the_steps_of_the_front_end() -> None:
    settings = config()
    scene = scene_of(settings, baseline_m=0.0)
    selection = selected(scene, settings)
    assert (selection.unscaled == 0).all()
    state = selection.problem.start
    rotation, position = geometry.inverse(state.rotation, state.translation)
    shrunk = geometry.inverse(rotation, 0.7 * position)
    result = dataclasses.replace(
        solved(selection), state=dataclasses.replace(state, translation=shrunk[1], points=0.7 * state.points)
    )
    window.merge(scene, selection, result, TRACKS)
    np.testing.assert_allclose(scene.keyframes.position, scene.keyframes.input_position, atol=1e-9)
    np.testing.assert_allclose(
        scene.landmarks.position[selection.landmarks], state.points + selection.origin, atol=1e-9
    )


def test_guesses_move_with_the_map() -> None:
    settings = config()
    scene = scene_of(settings, guesses=True, guess_noise=0.0)
    turn, shift = geometry.so3_exp(np.array([0.1, -0.2, 0.3])), np.array([4.0, 5.0, 6.0])
    table = scene.keyframes
    table.rotation[:], table.position[:] = geometry.compose(turn, shift, table.input_rotation, table.input_position)
    table.refined[:] = True
    rows = np.flatnonzero(scene.landmarks.has_guess)
    expected = scene.landmarks.guess[rows] @ turn.T + shift
    np.testing.assert_allclose(window.moved_guesses(scene, rows), expected, atol=1e-9)


@pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
def test_both_kernels_doubt_the_same_points() -> None:
    settings = config()
    selection = selected(scene_of(settings), settings)
    rng, state = np.random.default_rng(2), selection.problem.start
    scale = np.where(rng.random((len(state.points), 1)) < 0.2, [[100.0]], [[0.1]])
    state = dataclasses.replace(state, points=state.points + scale * rng.normal(size=state.points.shape))
    norms = native_kernels.residual_norms(selection.whole, state, "numpy")
    by_numpy, by_native = (_doubted(selection, state, norms, 3.0, kernels) for kernels in ("numpy", "native"))
    assert 0.1 < np.mean(by_numpy[0]) < 1.0
    for ours, theirs in zip(by_native, by_numpy, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.skipif(native.kernels is None, reason="needs the C++ kernels")
def test_what_keyframes_see_is_counted_alike() -> None:
    rng = np.random.default_rng(3)
    obs: Any = SimpleNamespace(keyframe=rng.integers(0, 7, 500), point=rng.integers(0, 90, 500))
    used, marked = rng.random(500) < 0.6, rng.random(90) < 0.3
    every, well = native.kernels.seen_by_keyframe(obs, used, marked, 9)
    np.testing.assert_array_equal(every, np.bincount(obs.keyframe[used], minlength=9))
    np.testing.assert_array_equal(well, np.bincount(obs.keyframe[used & marked[obs.point]], minlength=9))
