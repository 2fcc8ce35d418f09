# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is known beside pixels: wheel odometry, GNSS, priors of points, loops; and what of it is turned away."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ba_node.backend import Adjustment, Backend, Work
from ba_node.backend.archive import unpack
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Estimate
from ba_node.measurements import (
    GlobalFix,
    GravityDirection,
    Keyframe,
    LandmarkPriors,
    Measurement,
    PosePrior,
    RelativePose,
    TrackMerge,
)
from ba_node.scene.map_content import MapContent, MapError
from ba_node.window import adjustment, constraints
from experiments.synthetic import SyntheticData
from tests.window.street import (
    ANTENNA,
    aligned_rms,
    error_in_world,
    first,
    fixes,
    loop_of,
    merges,
    replayed,
    round_trip,
    stream,
    street_data,
    wheels,
)


@pytest.fixture(scope="module")
def street() -> SyntheticData:
    return street_data()


@pytest.mark.slow
@pytest.mark.parametrize("outliers", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_wheels_and_gnss_bound_the_drift(street: SyntheticData, outliers: float) -> None:
    """The map ends where the world has it; fixes that are 1 km off are outvoted, and one origin is published."""
    sources = wheels(street), fixes(street, outliers)
    backend, estimate = replayed(street, lambda *at: [one for source in sources for one in source(*at)], **ANTENNA)
    assert error_in_world(estimate, street) < 0.5
    assert aligned_rms(estimate.trajectory.position, street.truth.position) < 0.3
    assert not backend.report.warnings
    assert backend.report.adjustments >= 1


@pytest.mark.slow
def test_two_kilometres_of_wheels_and_gnss_stay_within_0_3_m() -> None:
    """Wheels of 1 % and fixes of 1 m, where few tracks of much noise let vision alone drift by 100 m."""
    data = street_data(keyframes=800, length_m=2000.0, landmarks=20000, tracks=35, noise_px=1.5)
    _, alone = replayed(data)
    assert np.linalg.norm(alone.trajectory.position[-1] - data.truth.position[-1]) > 10.0
    sources = wheels(data), fixes(data, 0.0)
    backend, estimate = replayed(data, lambda *at: [one for source in sources for one in source(*at)], **ANTENNA)
    assert error_in_world(estimate, data) < 0.3
    assert not backend.report.warnings


@pytest.mark.slow
def test_priors_that_contradict_each_other_bend_nothing(street: SyntheticData) -> None:
    """Every second pose prior has a rotation and a place of its own, in the map's frame: the majority stands."""
    rotation, rng = geometry.matrix_from_quaternion(street.truth.orientation), np.random.default_rng(5)

    def of(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        place = street.truth.position[k] + rng.normal(0.0, 0.1, 3) + (k % 3 == 0) * rng.normal(0.0, 50.0, 3)
        yield PosePrior(
            keyframe.stamp_ns, "map", place, geometry.quaternion_from_matrix(rotation[k]), 0.01 * np.eye(6).ravel()
        )

    _, estimate = replayed(street, of)
    off = np.linalg.norm(estimate.trajectory.position - street.truth.position, axis=1)
    assert float(np.sqrt(np.mean(off**2))) < 0.15


@pytest.mark.slow
def test_known_points_hold_the_map(street: SyntheticData) -> None:
    """Surveyed points along the street bound the drift as pose priors do."""
    known = np.arange(0, len(street.track_id), 25)
    priors = LandmarkPriors(
        0,
        "map",
        street.track_id[known],
        street.landmarks[street.track_landmark[known]],
        np.tile(1e-4 * np.eye(3), (len(known), 1, 1)),
    )
    _, free = replayed(street)
    _, held = replayed(street, lambda k, _: [priors] if k == 0 else [])
    errors = [float(np.linalg.norm((one.trajectory.position - street.truth.position)[-1])) for one in (free, held)]
    assert errors[1] < 0.25 * errors[0]


@pytest.mark.slow
def test_a_loop_closes_and_the_odometry_frame_stays() -> None:
    data = round_trip(0.5)
    pairs = merges(data)
    assert len(pairs) == 20
    # One pair is of two points that one image sees both.
    table = np.array([*pairs, (pairs[0][1], pairs[1][1])], np.uint64)
    backend = Backend(Config())
    measurements = [*(one for _, _, one in data.timeline()), TrackMerge(0, table[:, 0], table[:, 1])]
    estimates = [event for event in backend.replay(measurements) if isinstance(event, Estimate)]
    before, after = (float(np.linalg.norm(one.trajectory.position[-1] - data.truth.position[len(one.trajectory) - 1]))
                     for one in estimates[-2:])  # fmt: skip
    assert before > 5.0
    assert after < 0.1 * before
    assert backend.report.adjustments == estimates[-2].report.adjustments + 1 and backend.report.merged_tracks == 20
    assert backend.report.rejected["bad_merge"] == 1
    # Beyond its gate the correction waits for others to agree: who steers by map -> odom sees no jump.
    assert backend.report.correction_held


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise_px", "baseline_m", "seed", "drift"),
    [(1.0, 0.12, 4, 0.5), (0.5, 0.0, 4, 1.0), (0.5, 0.0, 7, 1.0), (0.5, 0.0, 8, 3.0)],
)
def test_noisy_loops_close_to_a_tenth(noise_px: float, baseline_m: float, seed: int, drift: float) -> None:
    """What is closed is the pose of the end in the keyframe at the same place, which the merged tracks tell.

    Against the truth in the frame of the first keyframe is no measure: what the first steps are off turns all. With 3
    degrees a root metre one camera's windows leave gaps: all poses are far off until these are closed.
    """
    data = round_trip(noise_px, baseline_m=baseline_m, seed=seed, drift_rotation_deg=drift)
    table = np.array(merges(data), np.uint64)
    measurements = [*(one for _, _, one in data.timeline()), TrackMerge(0, table[:, 0], table[:, 1])]
    estimates = [one for one in Backend(Config()).replay(measurements) if isinstance(one, Estimate)]
    errors = [end_in_twelfth(one, data) for one in estimates[-2:]]
    assert errors[0] > 0.3 and errors[1] < 0.1 * errors[0], errors
    if drift > 1.0:
        rms = [
            aligned_rms(one.trajectory.position, data.truth.position[: len(one.trajectory)]) for one in estimates[-2:]
        ]
        assert rms[0] > 2.0 and rms[1] < 0.15 * rms[0], rms


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 5])
def test_a_loop_closes_where_the_first_keyframes_have_no_points(seed: int) -> None:
    """All their windows are held, steps being 3 degrees off: later points tell where the earlier keyframe is."""
    data = round_trip(0.5, seed=seed, drift_rotation_deg=3.0)
    table = np.array(merges(data), np.uint64)
    measurements = [*(one for _, _, one in data.timeline()), TrackMerge(0, table[:, 0], table[:, 1])]
    backend = Backend(Config())
    estimates = [one for one in backend.replay(measurements) if isinstance(one, Estimate)]
    assert backend.report.merged_tracks >= 19, backend.report.rejected
    rms = [aligned_rms(one.trajectory.position, data.truth.position[: len(one.trajectory)]) for one in estimates[-2:]]
    assert rms[0] > 1.0 and rms[1] < 0.5 * rms[0], rms
    assert end_in_twelfth(estimates[-1], data) < 0.2 * end_in_twelfth(estimates[-2], data) < 2.0


def end_in_twelfth(estimate: Estimate, data: SyntheticData) -> float:
    """Return how far the last keyframe is off, as seen from the one at the same place, m."""
    end, here = len(estimate.trajectory) - 1, estimate.trajectory
    turns = [geometry.matrix_from_quaternion(poses.orientation[12]) for poses in (here, data.truth)]
    moves = [poses.position[end] - poses.position[12] for poses in (here, data.truth)]
    return float(np.linalg.norm(turns[0].T @ moves[0] - turns[1].T @ moves[1]))


def test_what_cannot_be_is_counted(street: SyntheticData) -> None:
    good, pose = np.eye(6).ravel(), (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    negative = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0]).ravel()
    ids = np.array([1], np.uint64)
    sent: list[Measurement] = [
        RelativePose(0, 3, 10**9, False, *pose, good),
        RelativePose(0, 3, 3, False, *pose, good),
        RelativePose(0, 1, 2, False, *pose, negative),
        RelativePose(0, 1, 2, False, np.full(3, np.nan), pose[1], good),
        GravityDirection(0, 10**9, np.array([0.0, 0.0, -1.0]), 0.1),
        GravityDirection(0, 4, np.zeros(3), 0.1),
        GravityDirection(0, 4, np.array([0.0, 0.0, -1.0]), 0.0),
        LandmarkPriors(0, "map", ids, np.zeros((1, 3)), -np.eye(3)[None]),
        LandmarkPriors(0, "elsewhere", ids, np.zeros((1, 3)), np.eye(3)[None]),
        PosePrior(0, "", *pose, good),
        GlobalFix(0, "gps", np.array([91.0, 0.0, 0.0]), np.eye(3).ravel(), is_fix=True),
        GlobalFix(0, "gps", np.array([50.0, 0.0, 0.0]), np.eye(3).ravel(), is_fix=False),
    ]
    short = dataclasses.replace(
        street, keyframes=street.keyframes[:8], tracks=street.tracks[:8], guesses=street.guesses[:8]
    )
    prior = LandmarkPriors(0, "map", ids, np.zeros((1, 3)), np.eye(3)[None])
    _, plain = replayed(short)
    backend, estimate = replayed(short, lambda k, _: [prior, *sent] if k == 7 else [])
    counts = dict(backend.report.rejected)
    assert counts == {"unknown_keyframe": 2, "bad_factor": 4, "bad_covariance": 3, "other_world": 2}
    assert backend.scene.log.notices["no_fix"] == 1
    np.testing.assert_allclose(estimate.trajectory.position, plain.trajectory.position, atol=0.05)


@pytest.mark.slow
def test_the_example_of_the_page_counts(street: SyntheticData) -> None:
    """The code in docs/factors.md, as it stands there: heights that wander come back to one."""
    page = (Path(__file__).parents[2] / "docs" / "factors.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(code.splitlines()) <= 32
    short = first(street, 40)
    _, free = replayed(short)
    known = list(constraints.SOURCES)
    try:
        exec(compile(code, "factors.md", "exec"), {"__name__": __name__})
        _, level = replayed(short)
    finally:
        constraints.SOURCES[:] = known
    spread = [float(np.std(one.trajectory.position[:, 2])) for one in (free, level)]
    assert spread[1] < 0.3 * spread[0]


@pytest.mark.slow
def test_a_saved_map_keeps_its_place_in_the_world(street: SyntheticData) -> None:
    backend, _ = replayed(first(street, 40), fixes(street, 0.0), **(ANTENNA | {"factors.align_m": 1.0}))
    known = backend.scene.constraints
    assert known.map_from_world is not None and known.origin is not None
    known.renamed = {5: 7, 7: 9}
    content = backend.snapshot()
    content.facts.update(json.loads(json.dumps(content.facts)))
    loaded = unpack(content, Config().scene).scene.constraints
    assert loaded.map_from_world is not None and loaded.origin is not None
    np.testing.assert_array_equal(loaded.origin, known.origin)
    for one, other in zip(loaded.map_from_world, known.map_from_world, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (loaded.world_frame, loaded.name_of(5)) == ("enu", 9)
    for name, value in (
        ("origin", [1.0, 2.0]),
        ("renamed", [[1, 2], [2, 1]]),
        ("map_from_world", [[2.0] * 9, [0.0] * 3]),
    ):
        broken = MapContent(content.arrays, content.facts | {"world": content.facts["world"] | {name: value}})
        with pytest.raises(MapError, match="world"):
            unpack(broken, Config().scene)


@pytest.mark.slow
def test_gravity_holds_the_tilt(street: SyntheticData) -> None:
    """A front-end that tells which way is down keeps the map level, however few tracks there are."""
    short = first(street, 60)
    rotation = geometry.matrix_from_quaternion(street.truth.orientation)

    def of(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        down = rotation[k].T @ np.array([0.0, 0.0, -9.81])
        yield GravityDirection(0, keyframe.keyframe_id, down, 0.002)

    tilt = []
    for more in ((lambda *_: ()), of):
        _, estimate = replayed(short, more)
        found = geometry.matrix_from_quaternion(estimate.trajectory.orientation)
        tilt.append(float(np.degrees(np.arccos(np.clip((found[:, 2] * rotation[:60, 2]).sum(axis=1), -1, 1)).max())))
    assert tilt[1] < 0.15
    assert tilt[1] < 0.3 * tilt[0]


def test_priors_without_keyframes_or_a_path_to_align_by_are_said(street: SyntheticData) -> None:
    backend = Backend(Config())
    fix = GlobalFix(0, "gps", np.array([48.0, 11.0, 500.0]), np.eye(3).ravel(), is_fix=True)
    assert list(backend.replay([fix, fix])) == []
    backend, _ = replayed(first(street, 3), fixes(street, 0.0))
    (text,) = backend.report.warnings
    assert text.startswith("3 priors in frame 'enu' were not used: the path is too short")


@pytest.mark.slow
@pytest.mark.parametrize(("off_m", "closes"), [(0.0, True), (300.0, False)])
def test_a_loop_by_pose_closes_or_is_refused(off_m: float, closes: bool) -> None:
    """A relative pose of the first and last keyframe; one that is 300 m off leaves the map as it is, and is said."""
    data = first(round_trip(0.5), 60)
    true = loop_of(data, 60)
    loop = dataclasses.replace(true, position=true.position + np.array([off_m, 0.0, 0.0]))
    _, plain = replayed(data)
    backend, estimate = replayed(data, lambda k, _: [loop] if k == 30 else [])
    ends = [float(np.linalg.norm(e.trajectory.position[-1] - data.truth.position[59])) for e in (plain, estimate)]
    assert ends[0] > 0.5
    if closes:
        assert ends[1] < 0.2 * ends[0]
        assert not any("the map stays as it is" in text for text in backend.report.warnings)
    else:
        assert ends[1] < 1.1 * ends[0]
        assert any("the map stays as it is" in text for text in backend.report.warnings)


@pytest.mark.slow
def test_a_loop_is_closed_while_windows_go_on() -> None:
    """The solve of everything runs elsewhere; keyframes that come meanwhile are solved, and follow."""
    data = first(round_trip(0.5), 46)
    backend = Backend(Config().with_values({"factors.adjust_m": 0.05}))
    handed = handed_over(backend)
    for _ in backend.replay(stream(data, lambda k, _: [loop_of(data, 40)] if k == 39 else [])):
        if handed and len(backend.scene.keyframes) == 44:
            break
    assert len(handed) == 1 and backend.report.adjustments == 0
    ids, solves = backend.scene.keyframes.keyframe_id.copy(), backend.solve_count

    def error(k: int) -> float:
        row = backend.scene.find_keyframe(int(data.truth.keyframe_id[k]))
        return float(np.linalg.norm(backend.scene.keyframes.position[row] - data.truth.position[k]))

    before = [error(k) for k in (39, len(ids) - 2)]
    handed[0].run()
    assert [error(k) for k in (39, len(ids) - 2)] == before, "nothing moves before it is taken in"
    assert backend.take_work(handed[0]) is not None
    assert backend.report.adjustments == 1 and backend.solve_count == solves + 1
    assert max(error(39), error(len(ids) - 2)) < 0.3 * min(before), (before, error(39), error(len(ids) - 2))
    assert backend.take_work(handed[0]) is None, "it is taken in once"


def handed_over(backend: Backend) -> list[Adjustment]:
    """Have loops and what is absolute handed over in a list, and other work done at once; return the list."""
    handed: list[Adjustment] = []

    def elsewhere(work: Work) -> None:
        if isinstance(work, Adjustment) and not work.due.grown:
            handed.append(work)
            return
        work.run()
        backend.take_work(work)

    backend.elsewhere = elsewhere
    return handed


@pytest.mark.slow
def test_gaps_that_were_closed_are_kept_where_poses_explain_the_tracks_better() -> None:
    data = first(round_trip(0.5), 46)
    backend = Backend(Config().with_values({"factors.adjust_m": 0.05}))
    handed = handed_over(backend)
    list(backend.replay(stream(data, lambda k, _: [loop_of(data, 40)] if k == 39 else [])))
    handed[0].run()
    taken, copy, config = handed[0].taken, handed[0]._copy, handed[0].config
    assert taken is not None
    state, rows = taken.result.state, copy.find_keyframes(taken.keyframe_id)
    off = np.random.default_rng(0).normal(0.0, 0.05, state.translation.shape)
    rotation, position = copy.keyframes.rotation.copy(), copy.keyframes.position.copy()
    rotation[rows], position[rows] = geometry.inverse(state.rotation, state.translation)
    position[rows] += taken.selection.origin
    worse = taken.with_result(state=dataclasses.replace(state, translation=state.translation + off))
    spoilt = position.copy()
    spoilt[rows] += off
    assert adjustment._explains_better(copy, taken, (rotation, spoilt), config)
    assert not adjustment._explains_better(copy, worse, (rotation, position), config)
    assert not adjustment._explains_better(copy, taken, (rotation, position), config), "as well is not better"


@pytest.mark.slow
def test_why_no_solve_of_everything_begins_is_said() -> None:
    """Points have a place, and no keyframe sees enough of them: the map is not bent behind their back."""
    data = first(round_trip(0.5), 40)
    backend = Backend(Config().with_values({"factors.adjust_m": 0.05}))
    handed = handed_over(backend)
    list(backend.replay(stream(data, lambda k, _: [loop_of(data, 36)] if k == 35 else [])))
    copy = handed[0]._copy
    handed[0].config = handed[0].config.with_values({"guard.min_points": 1000})
    before = backend.scene.keyframes.position.copy()
    handed[0].run()
    assert handed[0].why.startswith("no solve of everything can begin: no keyframe of the window sees enough points")
    assert backend.take_work(handed[0]) is None
    np.testing.assert_array_equal(backend.scene.keyframes.position, before)
    assert handed[0].why in " ".join(backend.report.warnings)
    copy.landmarks.has_position[:] = False
    handed[0].run()
    assert not handed[0].why and handed[0].taken is None, "without images there is nothing to refine"
