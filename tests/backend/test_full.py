# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The solve of everything: on a copy, while windows go on, and put into a map that has changed meanwhile."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ba_node.arrays import FloatArray
from ba_node.backend import Backend, Optimization
from ba_node.backend.archive import unpack
from ba_node.config import Config
from ba_node.core import geometry, solver
from ba_node.core.problem import State
from ba_node.core.result import Iteration, Status
from ba_node.evaluation.alignment import align
from ba_node.measurements import CameraRig, Measurement, OfTime
from ba_node.window import full
from ba_node.window.merging import scaled
from ba_node.window.problems import some_observations
from experiments.synthetic import SyntheticData, SyntheticOptions
from tests.generated import generated

if TYPE_CHECKING:
    from collections.abc import Iterable

# With windows so small the scale of one camera drifts.
# By itself nothing but windows refines the map.
CONFIG = Config().with_values({"window.max_keyframes": 8, "guard.max_scale_error": 0.5, "factors.adjust_m": 0.0})
KINDS: dict[str, dict[str, Any]] = {"stereo": {}, "one camera": {"baseline_m": 0.0}, "depth": {"depth_share": 0.5}}


@functools.cache
def recording(**options: Any) -> SyntheticData:
    base: dict[str, Any] = {
        "keyframes": 30, "landmarks": 2500, "tracks": 120, "length_m": 30.0, "ids": "random64",
        "drift_rotation_deg": 1.0,
    }  # fmt: skip
    return generated(SyntheticOptions(**{**base, **options}))


def feed(backend: Backend, stream: Iterable[Measurement], flush: bool = True) -> None:
    for measurement in stream:
        if backend.completes(measurement):
            backend.solve()
        backend.add(measurement)
    if flush:
        backend.flush()
        while backend.ready:
            backend.solve()


def cut(data: SyntheticData, keyframes: int) -> tuple[list[Measurement], list[Measurement]]:
    """Return what came with the first keyframes, and the rest."""
    stream = [m for _, _, m in data.timeline()]
    late = set(data.truth.keyframe_id[keyframes:].tolist())
    first = next((i for i, m in enumerate(stream) if getattr(m, "keyframe_id", None) in late), len(stream))
    return stream[:first], stream[first:]


def everything(backend: Backend) -> Optimization:
    taken = backend.begin_optimization()
    assert isinstance(taken, Optimization)
    return taken


def objectives(backend: Backend, of: Optimization, seen_by: Optimization) -> tuple[float, float]:
    """Return the robust objective of observations of a copy, as it was then and as it is now.

    The few points that have lost their place since are left out of both, and keyframes that are not in ``seen_by``.
    """
    scene, selection = backend.scene, of.selection
    keyframes = scene.find_keyframes(of.keyframe_id)
    landmarks = scene.find_landmarks(of.track_id)
    placed = scene.landmarks.has_position[landmarks]
    assert placed.mean() > 0.97, f"{np.count_nonzero(~placed)} points of {len(placed)} have lost their place"
    poses = geometry.inverse(
        scene.keyframes.rotation[keyframes], scene.keyframes.position[keyframes] - selection.origin
    )
    points = np.nan_to_num(scene.landmarks.position[landmarks] - selection.origin)
    observations = selection.problem.observations
    counted = np.isin(of.keyframe_id, seen_by.keyframe_id)[observations.keyframe]
    problem = some_observations(selection.problem, np.flatnonzero(counted & placed[observations.point]))
    now = dataclasses.replace(problem.start, rotation=poses[0], translation=poses[1], points=points)
    chosen = full.options(backend.config.solver, max_iterations=1)
    before, after = (
        solver.solve(dataclasses.replace(problem, start=state), chosen).objective_before
        for state in (problem.start, now)
    )
    return before, after


def optimised(backend: Backend, later: list[Measurement], **choices: Any) -> Optimization:
    """Take a snapshot, solve, and let the back-end go on meanwhile."""
    taken = everything(backend)
    taken.solve(backend.config.solver, **choices)
    feed(backend, later)
    return taken


def error_m(backend: Backend, data: SyntheticData) -> float:
    positions, truth = backend.estimate().trajectory.position, data.truth.position
    return float(np.sqrt(np.mean(np.sum((align(positions, truth, "sim3").apply(positions) - truth) ** 2, axis=1))))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keyframes", [30, 20])
def test_it_explains_all_observations_better(kind: str, keyframes: int) -> None:
    data, backend = recording(**KINDS[kind]), Backend(CONFIG)
    early, late = cut(data, keyframes)
    feed(backend, early)
    taken = optimised(backend, late)
    reference, error = everything(backend), error_m(backend, data)
    merged = backend.merge(taken)
    assert merged is not None
    before, after = objectives(backend, reference, taken)
    # Keyframes that came later have only followed: the next windows fit them to what has moved.
    assert after < before, f"objective {before:.0f} -> {after:.0f}"
    assert error_m(backend, data) < error
    estimate, followed = merged
    assert followed == 30 - keyframes
    assert estimate.report.status.usable
    assert estimate.report.objective_after < estimate.report.objective_before
    assert estimate.report.rms_px_after < estimate.report.rms_px_before
    # With one camera the front-end's steps hold the scale.
    assert estimate.report.keyframes == keyframes - 1
    assert estimate.refined.keyframe_id.tolist() == data.truth.keyframe_id.tolist()


@pytest.mark.slow
def test_a_floating_scale_does_not_shrink_the_map() -> None:
    data, backend = recording(baseline_m=0.0), Backend(CONFIG)
    feed(backend, (m for _, _, m in data.timeline()))
    taken = optimised(backend, [])
    start, state = taken.selection.problem.start, taken.result.state
    before, after = (
        np.linalg.norm(np.diff(geometry.inverse(s.rotation, s.translation)[1], axis=0), axis=1).sum()
        for s in (start, state)
    )
    assert after == pytest.approx(before, rel=0.05)


def test_one_camera_takes_its_scale_from_all_steps() -> None:
    """The end is that of a solve from the true map, to the last digits; windows keep the scale of the first ones."""
    options = {"keyframes": 40, "length_m": 27.0, "drift_rotation_deg": 0.5, "drift_translation": 0.02}
    data, backend = recording(baseline_m=0.0, outlier_share=0.0, **options), Backend(Config())
    feed(backend, (m for _, _, m in data.timeline()))
    before = rms_m(backend, data)
    taken = everything(backend)
    problem, origin = taken.selection.problem, taken.selection.origin
    assert np.count_nonzero(problem.fixed) == 1
    row = [data.truth.keyframe_id.tolist().index(one) for one in taken.keyframe_id.tolist()]
    turned = geometry.matrix_from_quaternion(data.truth.orientation[row])
    point = {int(track): int(of) for track, of in zip(data.track_id, data.track_landmark, strict=True)}
    points = data.landmarks[[point[int(track)] for track in taken.track_id]] - origin
    poses = geometry.inverse(turned, data.truth.position[row] - origin)
    begun = dataclasses.replace(problem, start=State(*poses, points, problem.start.intrinsics))
    exact = dataclasses.replace(full.options(backend.config.solver), function_tolerance=1e-12, max_iterations=200)
    found = solver.solve(begun, exact).state
    _, best = geometry.inverse(found.rotation, found.translation)
    assert backend.optimize() is not None
    least = aligned_rms(best, data.truth.position[row])
    assert rms_m(backend, data) < 1.1 * least
    assert before > 1.2 * least


def rms_m(backend: Backend, data: SyntheticData) -> float:
    return aligned_rms(backend.estimate().trajectory.position, data.truth.position)


def aligned_rms(position: FloatArray, truth: FloatArray) -> float:
    """Return the rms distance after the best rotation and translation, m."""
    moved = align(position, truth, "se3").apply(position)
    return float(np.sqrt(np.mean(np.sum((moved - truth) ** 2, axis=1))))


def test_the_same_gives_the_same_bits() -> None:
    data = recording(keyframes=15, landmarks=600, tracks=60)
    results = []
    for _ in range(2):
        backend = Backend(CONFIG)
        early, late = cut(data, 10)
        feed(backend, early)
        merged = backend.merge(optimised(backend, late))
        assert merged is not None
        results.append(merged[0])
    assert results[0].trajectory.position.tobytes() == results[1].trajectory.position.tobytes()
    assert results[0].cloud.position.tobytes() == results[1].cloud.position.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_what_came_later_follows_the_end_of_the_copy(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A result that only moves and turns (one camera: and stretches) the copy does so to everything."""
    monkeypatch.setattr(full, "_join", lambda *_: None)
    data = recording(baseline_m=0.0, keyframes=20, landmarks=1000)
    backend = Backend(CONFIG)
    early, late = cut(data, 12)
    feed(backend, early)
    taken = everything(backend)
    feed(backend, late)
    before = backend.estimate()
    turn, shift = geometry.so3_exp(np.array([0.1, -0.3, 0.2])), np.array([5.0, -2.0, 1.0])

    def moved(positions: np.ndarray) -> np.ndarray:
        return np.asarray(scale * positions @ turn.T + shift)

    snapshot, scene = taken, backend.scene
    chosen = snapshot.selection
    rotation, position = scene.keyframes.rotation[chosen.keyframes], scene.keyframes.position[chosen.keyframes]
    state = dataclasses.replace(
        chosen.problem.start, points=moved(scene.landmarks.position[chosen.landmarks]) - chosen.origin
    )
    inverse = geometry.inverse(turn @ rotation, moved(position) - chosen.origin)
    state = dataclasses.replace(state, rotation=inverse[0], translation=inverse[1])
    # The scale is given to the map by its steps, so they are stretched with it.
    snapshot = dataclasses.replace(snapshot, position=moved(position))
    state = scaled(snapshot.selection, snapshot.position, state)
    late_ids = backend.map.refined_among(data.truth.keyframe_id[12:].tolist())
    assert len(late_ids) >= 6, f"{len(late_ids)} of the 8 later keyframes were refined"
    assert full.merge_snapshot(scene, backend.config, snapshot, state) == len(late_ids)
    after = backend.estimate()
    # Those that no solve has had follow the front-end's steps, which are not stretched.
    had = scene.keyframes.refined[scene.order]
    assert np.count_nonzero(had) >= 15
    np.testing.assert_allclose(after.trajectory.position[had], moved(before.trajectory.position[had]), atol=1e-9)
    kept = np.isin(after.cloud.track_id, before.cloud.track_id)
    rows = np.searchsorted(before.cloud.track_id, after.cloud.track_id[kept])
    followed = np.isclose(after.cloud.position[kept], moved(before.cloud.position[rows]), rtol=1e-6, atol=1e-6)
    # Points that most of their views contradict are placed anew.
    assert followed.all(axis=1).mean() > 0.98
    assert kept.sum() > 100


@pytest.mark.parametrize("lost", ["reset", "session", "map"])
def test_the_result_of_a_map_that_is_gone_changes_nothing(lost: str) -> None:
    data = recording(keyframes=8, landmarks=600, tracks=60)
    stream = [m for _, _, m in data.timeline()]
    backend = Backend(CONFIG)
    feed(backend, stream)
    taken = optimised(backend, [])
    if lost == "reset":
        backend.reset()
    elif lost == "map":
        backend.take_over(unpack(backend.snapshot(), CONFIG.scene))
    else:
        feed(
            backend, [m if isinstance(m, CameraRig | OfTime) else dataclasses.replace(m, session_id=1) for m in stream]
        )
    before = backend.estimate().trajectory.position
    assert backend.merge(taken) is None
    np.testing.assert_array_equal(backend.estimate().trajectory.position, before)


@pytest.mark.slow
def test_forgotten_keyframes_are_passed_over() -> None:
    data = recording()
    backend = Backend(CONFIG.with_values({"scene.max_keyframes": 20}))
    early, late = cut(data, 18)
    late = late[: len(late) * 2 // 3]
    feed(backend, early)
    taken = optimised(backend, late)
    known = backend.scene.find_keyframes(taken.keyframe_id)
    assert (known < 0).any()
    assert (known >= 0).any()
    reference = everything(backend)
    assert backend.merge(taken) is not None
    before, after = objectives(backend, reference, reference)
    assert after < before


def test_when_nothing_of_it_is_left_nothing_changes() -> None:
    data = recording()
    backend = Backend(CONFIG.with_values({"scene.max_keyframes": 12}))
    early, late = cut(data, 10)
    feed(backend, early)
    taken = optimised(backend, late)
    assert (backend.scene.find_keyframes(taken.keyframe_id) < 0).all()
    before = backend.estimate().trajectory.position
    assert backend.merge(taken) is None
    np.testing.assert_array_equal(backend.estimate().trajectory.position, before)


@pytest.mark.parametrize("status", [Status.FAILED, Status.SKIPPED])
def test_a_result_of_no_use_changes_nothing(status: Status) -> None:
    backend = Backend(CONFIG)
    feed(backend, [m for _, _, m in recording(keyframes=8, landmarks=600, tracks=60).timeline()])
    taken = optimised(backend, [])
    before = backend.estimate()
    count = backend.solve_count
    assert backend.merge(taken.with_result(status=status)) is None
    nan = dataclasses.replace(taken.result.state, points=taken.result.state.points * np.nan)
    assert backend.merge(taken.with_result(state=nan)) is None
    np.testing.assert_array_equal(backend.estimate().trajectory.position, before.trajectory.position)
    assert backend.solve_count == count


def test_there_is_a_reason_where_there_is_nothing_to_solve() -> None:
    backend = Backend(CONFIG)
    assert backend.begin_optimization() == "no camera rig yet: nothing is known about the cameras"
    assert backend.estimate().trajectory.keyframe_id.tolist() == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_observations_are_the_same_bits_after_a_solve_that_did_without_them(kind: str) -> None:
    backend = Backend(CONFIG)
    feed(backend, cut(recording(**KINDS[kind], outlier_share=0.1), 12)[0])
    taken = everything(backend)
    whole, during = taken.selection.observations, []
    assert 0 < np.count_nonzero(~taken.selection.inlier) < 0.5 * len(whole)

    def look(_row: Iteration) -> bool:
        during.append(len(taken.selection.observations))
        return True

    taken.solve(backend.config.solver, max_iterations=2, on_iteration=look)
    assert set(during) == {np.count_nonzero(~taken.selection.inlier)}
    for was, now in zip(vars(whole).values(), vars(taken.selection.observations).values(), strict=True):
        np.testing.assert_array_equal(now, was)


def test_a_solve_is_stopped_after_an_iteration() -> None:
    backend = Backend(CONFIG)
    feed(backend, [m for _, _, m in recording(keyframes=8, landmarks=600, tracks=60).timeline()])
    taken = everything(backend)
    seen: list[int] = []

    def watch(row: Iteration) -> bool:
        seen.append(row.iteration)
        return len(seen) < 3

    taken.solve(CONFIG.solver, "lma_cd", 30, on_iteration=watch)
    assert seen == [0, 1, 2]
    assert taken.result.status is Status.MAX_ITERATIONS
    assert taken.result.method == "lma_cd"


@pytest.mark.slow
def test_what_is_chosen_of_a_copy_is_the_map_at_that_moment() -> None:
    """Windows go on before the problem of the copy is put together, and the result is merged as that of the map."""
    first, rest = cut(recording(), 20)
    backend = Backend(CONFIG)
    feed(backend, first)
    direct, begin = everything(backend), backend.copied()
    feed(backend, rest)
    taken = begin()
    assert isinstance(taken, Optimization)
    assert taken.scene is direct.scene is backend.scene
    assert np.array_equal(taken.keyframe_id, direct.keyframe_id)
    assert np.array_equal(taken.track_id, direct.track_id)
    ours, theirs = taken.selection.problem, direct.selection.problem
    assert np.array_equal(ours.start.points, theirs.start.points)
    assert np.array_equal(ours.start.rotation, theirs.start.rotation)
    assert np.array_equal(ours.observations.uv, theirs.observations.uv)
    taken.solve(backend.config.solver)
    merged = backend.merge(taken)
    assert merged is not None
    assert merged[1] == 10, f"{merged[1]} of the 10 later keyframes followed"


@pytest.mark.slow
@settings(max_examples=25)
@given(st.data())
def test_whatever_happens_meanwhile_merging_does_not_raise(data: st.DataObject) -> None:
    made = recording(keyframes=12, landmarks=400, tracks=40, seed=data.draw(st.integers(0, 2)))
    stream = [m for _, _, m in made.timeline()]
    limits = {"scene.max_keyframes": data.draw(st.sampled_from([10, 100])), "scene.max_landmarks": 150}
    backend = Backend(CONFIG.with_values({**limits, "solver.max_iterations": 2}))
    at, end = sorted(data.draw(st.integers(0, len(stream))) for _ in range(2))
    feed(backend, stream[:at], flush=data.draw(st.booleans()))
    taken = backend.begin_optimization()
    if isinstance(taken, str):
        return
    taken.solve(backend.config.solver, max_iterations=2)
    lost = data.draw(st.integers(0, 2))
    feed(backend, [m for i, m in enumerate(stream[at:end]) if not lost or i % (lost + 1)], flush=False)
    rows = data.draw(st.lists(st.integers(0, len(backend.scene.landmarks) - 1), max_size=50))
    backend.scene.landmarks.has_position[rows] = False
    backend.scene.landmarks.changed()
    backend.merge(taken)
    backend.merge(taken)
    assert np.isfinite(backend.scene.keyframes.position).all()
    assert np.isfinite(backend.scene.landmarks.position[backend.scene.landmarks.has_position]).all()
    feed(backend, stream[end:])
