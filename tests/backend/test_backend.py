# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import itertools
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Estimate, Status
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement
from experiments.synthetic import SyntheticData, SyntheticOptions
from tests.generated import generated

if TYPE_CHECKING:
    from collections.abc import Iterable

SMALL: dict[str, Any] = {
    "keyframes": 12, "landmarks": 800, "tracks": 60, "length_m": 12.0, "path": "line", "ids": "random64",
}  # fmt: skip


def recording(**options: Any) -> SyntheticData:
    return generated(SyntheticOptions(**{**SMALL, **options}))


def messages(**options: Any) -> list[Measurement]:
    return [measurement for _, _, measurement in recording(**options).timeline()]


def replay(backend: Backend, stream: Iterable[Measurement]) -> list[Estimate]:
    """Solve once for every keyframe, in order."""
    return [event for event in backend.replay(stream) if isinstance(event, Estimate)]


def in_session(measurement: Any, session_id: int) -> Measurement:
    moved: Measurement = dataclasses.replace(measurement, session_id=session_id)
    return moved


def ids(stream: Iterable[Measurement]) -> list[int]:
    """Return the ids of the keyframes in a stream."""
    return [m.keyframe_id for m in stream if isinstance(m, Keyframe)]


def ready(backend: Backend) -> bool:
    """Ask anew: a type checker takes a property for a constant."""
    return backend.ready


def rmse(positions: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((positions - truth) ** 2, axis=1))))


def same(a: Estimate, b: Estimate) -> bool:
    parts = [
        (getattr(getattr(x, part), f.name).tobytes() for part in ("refined", "trajectory", "cloud") for f in
         dataclasses.fields(getattr(x, part)))
        for x in (a, b)
    ]  # fmt: skip
    return all(x == y for x, y in zip(*parts, strict=True)) and a.report == b.report


@pytest.mark.parametrize(
    "options",
    [{}, {"baseline_m": 0.0}, {"baseline_m": 0.0, "depth_share": 0.5}, {"guesses": True, "distortion": "equidistant"}],
    ids=["stereo", "one camera", "depth", "guesses"],
)
def test_replay_comes_nearer_to_the_truth(options: dict[str, Any]) -> None:
    size = {"keyframes": 20, "landmarks": 2000, "tracks": 120, "length_m": 20.0, "drift_rotation_deg": 1.0}
    data = recording(**{**size, **options})
    backend = Backend(Config())
    last = replay(backend, (m for _, _, m in data.timeline()))[-1]
    before = rmse(data.odometry.position, data.truth.position)
    after = rmse(last.trajectory.position, data.truth.position)
    assert after < 0.25 * before, f"{before:.3f} m before, {after:.3f} m after"
    assert backend.scene.keyframes.refined.all()


@pytest.mark.parametrize("baseline_m", [0.12, 0.0])
@pytest.mark.parametrize("seed", [3, 5, 9])
def test_keyframes_that_come_all_at_once_are_refined_together(seed: int, baseline_m: float) -> None:
    """None of them is refined yet, and the front-end's poses are off: that is no reason to take tracks for moving."""
    data = generated(SyntheticOptions(seed=seed, keyframes=6, length_m=10.0, path="line", baseline_m=baseline_m))
    backend = Backend(Config())
    for _, _, measurement in data.timeline():
        for admitted in backend.admit(measurement):
            backend.take(admitted)
    backend.flush(final=True)
    estimate = backend.solve()
    assert estimate is not None
    assert estimate.report.status is Status.CONVERGED, estimate.report.reason
    assert estimate.report.inlier_share > 0.9
    assert len(estimate.cloud) > 50


@pytest.mark.slow
def test_a_replay_solves_once_for_every_keyframe() -> None:
    data = recording(landmarks=2000, tracks=120)
    estimates = replay(Backend(Config()), (m for _, _, m in data.timeline()))
    newest = [estimate.report.newest_keyframe_id for estimate in estimates]
    assert newest == data.truth.keyframe_id.tolist()
    assert [estimate.report.status.usable for estimate in estimates] == [False] + [True] * 11
    assert [estimate.report.solve_count for estimate in estimates] == list(range(1, 13))
    assert estimates[0].report.reason == "one keyframe only: nothing to refine against"


@pytest.mark.slow
def test_the_same_stream_gives_the_same_bits() -> None:
    stream = messages(outlier_share=0.1)
    first, second = (replay(Backend(Config()), stream) for _ in range(2))
    assert all(same(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.slow
def test_the_order_of_the_topics_does_not_matter() -> None:
    data = recording(guesses=True)
    as_published = [m for _, _, m in data.timeline()]
    groups: list[list[Measurement]] = [
        [*tracks[::-1], keyframe, *([guess] if guess else [])]
        for keyframe, tracks, guess in zip(data.keyframes, data.tracks, data.guesses, strict=True)
    ]
    results = []
    for stream in (as_published, [*groups[0], data.rig, *itertools.chain(*groups[1:])]):
        backend = Backend(Config())
        for measurement in stream:
            backend.add(measurement)
        results.append(backend.solve())
    assert results[0] is not None
    assert results[1] is not None
    assert same(results[0], results[1])


def test_ready_once_as_many_cameras_delivered_as_before() -> None:
    data = recording()
    backend = Backend(Config())
    seen = []
    for k in range(3):
        first: list[Measurement] = [data.rig] if k == 0 else []
        for measurement in [*first, data.keyframes[k], *data.tracks[k]]:
            backend.add(measurement)
            seen.append(backend.ready)
        backend.solve()
        seen.append(backend.ready)
    #         rig    keyframe left right  solved
    assert seen == [False, False, False, True, False] + 2 * [False, False, True, False]


def test_a_rig_of_many_cameras_of_which_each_keyframe_uses_one() -> None:
    data = recording(baseline_m=0.0)
    rig = data.rig
    many = CameraRig(
        rig.frame_id,
        rig.names * 9,
        rig.models * 9,
        np.repeat(rig.intrinsics, 9, axis=0),
        rig.distortion * 9,
        np.repeat(rig.image_size, 9, axis=0),
        np.repeat(rig.position, 9, axis=0),
        np.repeat(rig.orientation, 9, axis=0),
    )
    backend = Backend(Config())
    backend.add(many)
    seen = []
    for k in range(9):
        backend.add(data.keyframes[k])
        backend.add(dataclasses.replace(data.tracks[k][0], camera_index=k))
        seen.append(backend.ready)
        backend.solve()
    # How many cameras deliver is learned from the first keyframe, which the second one completes.
    assert seen == [False] + [True] * 8


def test_silence_completes_the_newest_and_keeps_what_waits() -> None:
    data = recording()
    backend = Backend(Config())
    stream: list[Measurement] = [data.rig, data.keyframes[0], data.tracks[0][0], data.tracks[1][0]]
    for measurement in stream:
        backend.add(measurement)
    assert not ready(backend)
    backend.flush()
    assert ready(backend)
    assert not backend.map.rejected
    backend.flush(final=True)
    assert backend.map.rejected == {"unknown_keyframe": 1}


def test_keyframes_that_came_while_solving_are_solved_together() -> None:
    data = recording()
    backend = Backend(Config())
    for _, _, measurement in data.timeline():
        backend.add(measurement)
    assert ready(backend)
    estimate = backend.solve()
    assert estimate is not None
    assert not ready(backend)
    assert estimate.report.keyframes + estimate.report.fixed_keyframes == 12
    assert backend.scene.keyframes.refined.all()


@pytest.mark.slow
@pytest.mark.parametrize("by_topic", [False, True])
def test_more_keyframes_at_once_than_a_window_holds(by_topic: bool) -> None:
    data = recording(keyframes=30, landmarks=2000, tracks=120, length_m=30.0, outlier_share=0.0)
    stream = [m for _, _, m in data.timeline()]
    if by_topic:
        stream.sort(key=lambda m: isinstance(m, FeatureTracks))
    backend = Backend(Config().with_values({"window.max_keyframes": 10}))
    for measurement in stream:
        backend.add(measurement)
    estimates = replay(backend, [])
    newest = [data.truth.keyframe_id.tolist().index(estimate.report.newest_keyframe_id) for estimate in estimates]
    # Five new ones in each solve; then the map, which has grown, is refined as a whole, with all that have come.
    assert newest == [4, 9, 14, 19, 29, 29]
    assert backend.scene.keyframes.refined.all()
    before = rmse(data.odometry.position, data.truth.position)
    after = rmse(estimates[-1].trajectory.position, data.truth.position)
    assert after < 0.25 * before, f"{before:.3f} m before, {after:.3f} m after"


def test_tracks_that_come_late_make_their_keyframe_due_again() -> None:
    data = recording(landmarks=2000, tracks=120)
    backend = Backend(Config())
    stream: list[Measurement] = [data.rig, *data.keyframes[:3], *data.tracks[0], *data.tracks[2]]
    for measurement in stream:
        backend.add(measurement)
    backend.flush()
    backend.solve()
    row = backend.scene.find_keyframe(data.keyframes[1].keyframe_id)
    assert not backend.scene.keyframes.refined[row]
    assert not ready(backend)
    backend.add(data.tracks[1][0])
    assert ready(backend)
    backend.solve()
    assert backend.scene.keyframes.refined[row]
    backend.add(data.tracks[1][1])
    assert not ready(backend)


def test_no_keyframe_no_estimate() -> None:
    assert Backend(Config()).solve() is None


@pytest.mark.slow
def test_a_higher_session_begins_a_new_map_and_keeps_the_rig() -> None:
    stream = messages()
    later = [in_session(m, 5) for m in stream[1:] if not isinstance(m, CameraRig)]
    backend = Backend(Config())
    first = replay(backend, stream)
    second = replay(backend, later)
    assert len(backend.scene.keyframes) == 12
    assert second[-1].trajectory.position.tobytes() == first[-1].trajectory.position.tobytes()
    backend.add(stream[1])
    assert backend.map.rejected == {"stale_session": 1}


def test_an_unsolved_keyframe_is_solved_before_its_session_ends() -> None:
    stream = messages()
    backend = Backend(Config())
    for measurement in stream:
        backend.add(measurement)
    first, second = (in_session(m, 1) for m in stream if isinstance(m, Keyframe) and m.keyframe_id in ids(stream)[:2])
    assert not backend.completes(first), "it is held until another one confirms it"
    backend.add(first)
    assert backend.completes(second)
    backend.solve()
    assert not backend.completes(second)


def test_a_malformed_message_does_not_end_a_session() -> None:
    stream = messages()
    backend = Backend(Config())
    replay(backend, stream)
    assert isinstance(stream[1], Keyframe)
    bad = dataclasses.replace(stream[1], session_id=9, orientation=np.zeros(4))
    assert not backend.completes(bad)
    backend.add(bad)
    assert len(backend.scene.keyframes) == 12
    assert sum(backend.map.rejected.values()) == 1


def test_another_rig_is_used_from_the_next_session_on() -> None:
    stream = messages()
    rig = stream[0]
    assert isinstance(rig, CameraRig)
    other = dataclasses.replace(rig, intrinsics=rig.intrinsics * 1.1)
    backend = Backend(Config())
    for measurement in (*stream, other):
        backend.add(measurement)
    assert backend.map.rejected == {"rig_changed": 1}
    for keyframe in [m for m in stream if isinstance(m, Keyframe)][:2]:
        backend.add(in_session(keyframe, 1))
    assert backend.scene.cameras is not None
    assert backend.scene.cameras.params[0, 0] == pytest.approx(1.1 * rig.intrinsics[0, 0])


def test_parameters_take_effect_at_the_next_solve() -> None:
    backend = Backend(Config())
    replay(backend, messages())
    backend.configure(
        Config().with_values({"window.max_keyframes": 3, "solver.max_iterations": 1, "factors.adjust_m": 0.0})
    )
    estimate = backend.solve()
    assert estimate is not None
    assert estimate.report.keyframes == 3
    assert estimate.report.iterations == 1


def test_the_report_tells_what_was_solved() -> None:
    backend = Backend(Config(), clock=itertools.count().__next__)
    last = replay(backend, messages(outlier_share=0.1))[-1]
    report = last.report
    assert report.status in (Status.CONVERGED, Status.MAX_ITERATIONS)
    assert report.objective_after < report.objective_before
    assert report.rms_px_after < report.rms_px_before
    assert report.outliers > 0
    assert report.solve_time_s > 0
    assert len(last.refined) == report.keyframes + report.fixed_keyframes
    assert len(last.cloud) >= report.landmarks
    assert (last.cloud.views >= 2).all()
    assert np.isfinite(last.cloud.position).all()
    assert np.all(np.diff(last.trajectory.stamp_ns) > 0)


def test_rms_counts_every_observation() -> None:
    backend = Backend(Config())
    replay(backend, messages(outlier_share=0.0, noise_px=0.5, drift_translation=0.05, seed=3))
    # Noise of 0.5 px in each coordinate, and points and poses that have partly taken it up.
    assert 0.3 < backend.map.rms_px() < 0.6, f"{backend.map.rms_px():.3f} px"
    assert backend.map.rms_px("input") > 2 * backend.map.rms_px()
    with pytest.raises(ValueError, match="expected one of input, refined"):
        backend.map.rms_px("middle")


@pytest.mark.slow
def test_stamps_that_jump_back_begin_a_new_session_with_the_same_result() -> None:
    once = messages()
    backend = Backend(Config().with_values({"scene.max_reorder_s": 1.0}))
    first = replay(backend, once)
    again = replay(backend, once)
    words = "older than the newest (scene.max_reorder_s = 1): a new session begins"
    assert words in backend.scene.log.warnings["clock_jump"]
    assert (backend.map.index, backend.scene.session_id) == (1, 0), "the front-end's id stays"
    assert len(backend.scene.keyframes) == SMALL["keyframes"]
    assert not backend.map.rejected
    np.testing.assert_array_equal(again[-1].trajectory.position, first[-1].trajectory.position)


@pytest.mark.parametrize("limit_s", [0.0, 100.0])
def test_stamps_within_the_bound_are_sorted(limit_s: float) -> None:
    stream = messages()
    keyframes = [m for m in stream if isinstance(m, Keyframe)]
    backend = Backend(Config().with_values({"scene.max_reorder_s": limit_s}))
    replay(backend, [m for m in stream if m is not keyframes[2]] + [keyframes[2]])
    assert backend.map.index == 0
    assert backend.scene.log.notices["reordered"] == 1
    stamps = backend.scene.keyframes.stamp_ns[backend.scene.order]
    assert (np.diff(stamps) > 0).all()
