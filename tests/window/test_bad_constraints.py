# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is known beside pixels and wrong: it is counted, named or outvoted, and the map does not jump."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Estimate
from ba_node.measurements import GlobalFix, Keyframe, LandmarkPriors, Measurement, PosePrior, RelativePose
from ba_node.window import contradicted
from experiments.synthetic import SyntheticData
from tests.window.street import ANTENNA, ORIGIN, TURN, aligned_rms, first, fixes, pymap3d, stream, street_data, wheels

KILOMETRE = np.array([600.0, -800.0, 0.0])


def moved(fix: Measurement, by: FloatArray) -> GlobalFix:
    """Return a fix that is so far off, m east, north, up."""
    assert isinstance(fix, GlobalFix)
    place = np.array(pymap3d.geodetic2enu(*fix.geodetic, *ORIGIN)) + by
    return dataclasses.replace(fix, geodetic=np.array(pymap3d.enu2geodetic(*place, *ORIGIN), float))


def played(
    data: SyntheticData, more: Callable[[int, Keyframe], Iterable[Measurement]], **values: float
) -> tuple[Backend, Estimate, float]:
    """Return a back-end, its last estimate, and the largest move of a keyframe from one estimate to the next, m."""
    backend, jump = Backend(Config().with_values(values)), 0.0
    last: Estimate | None = None
    for event in backend.replay(stream(data, more)):
        if isinstance(event, Estimate):
            if last is not None:
                there, here = (one.trajectory.position[: len(last.trajectory)] for one in (event, last))
                jump = max(jump, float(np.linalg.norm(there - here, axis=1).max()))
            last = event
    assert last is not None
    return backend, last, jump


@pytest.fixture(scope="module")
def street() -> SyntheticData:
    return street_data()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        pytest.param(lambda k: k < 5, False, id="first_fixes", marks=pytest.mark.slow),
        pytest.param(lambda k: 40 <= k < 55, False, id="burst", marks=pytest.mark.slow),
        pytest.param(lambda k: k >= 50, True, id="from_midway"),
    ],
)
def test_fixes_that_are_a_kilometre_off_move_nothing(
    street: SyntheticData, wrong: Callable[[int], bool], said: bool
) -> None:
    right, steps = fixes(street, 0.0), wheels(street)

    def more(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        yield from (moved(one, KILOMETRE * wrong(k)) for one in right(k, keyframe))
        yield from steps(k, keyframe)

    backend, last, jump = played(street, more, **ANTENNA)
    assert jump < 2.0
    assert aligned_rms(last.trajectory.position, street.truth.position) < 0.4
    told = [
        line for line in backend.report.warnings if re.match("50 of 100 priors in frame 'enu' lie (999|100[01])", line)
    ]
    assert len(backend.report.warnings) == len(told) == said, backend.report.warnings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off_m", "jumped"),
    [
        pytest.param(10.0, range(67, 100), id="end", marks=pytest.mark.slow),
        pytest.param(30.0, range(30, 60), id="stretch"),
        pytest.param(0.0, range(0), id="none", marks=pytest.mark.slow),
    ],
)
def test_a_stretch_of_fixes_that_jumped_is_left_out_and_said(
    street: SyntheticData, off_m: float, jumped: range
) -> None:
    """Fixes of 1 m jump by 10 m, too little to show in one: with them in it the map is 1.2 m off."""
    right, steps = fixes(street, 0.0), wheels(street)

    def more(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        yield from (moved(one, off_m / 1000.0 * KILOMETRE * (k in jumped)) for one in right(k, keyframe))
        yield from steps(k, keyframe)

    backend, last, _ = played(street, more, **ANTENNA)
    assert aligned_rms(last.trajectory.position, street.truth.position) < 0.3
    told = [line for line in backend.report.warnings if f"{len(jumped)} of 100 priors in frame 'enu' lie" in line]
    assert len(backend.report.warnings) == len(told) == bool(jumped), backend.report.warnings
    for line in told:
        count = int(line.split(" are of stretches")[0].split()[-1])
        assert abs(count - len(jumped)) <= 2, line


@pytest.mark.slow
def test_a_front_end_that_jumps_takes_no_fixes_out(street: SyntheticData) -> None:
    """Its poses go on 10 m beside from the fortieth keyframe on, and images say that the body did not jump."""
    far = np.array([6.0, -8.0, 0.0])
    moved_on = (dataclasses.replace(one, position=one.position + far) for one in street.keyframes[40:])
    data = first(dataclasses.replace(street, keyframes=(*street.keyframes[:40], *moved_on)), 80)
    backend, _, _ = played(data, fixes(street, 0.0), **ANTENNA)
    assert backend.scene.constraints.judged_at >= 70
    assert backend.scene.constraints.left_out == []


@pytest.mark.slow
def test_fixes_count_by_how_they_scatter_where_their_covariance_is_far_too_small(street: SyntheticData) -> None:
    """A receiver of 1 m that states 1 mm is taken for what it is, and it is said."""
    right, steps = fixes(street, 0.0), wheels(street)

    def more(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        (fix,) = right(k, keyframe)
        assert isinstance(fix, GlobalFix)
        yield dataclasses.replace(fix, covariance=1e-6 * np.eye(3).ravel())
        yield from steps(k, keyframe)

    backend, last, _ = played(first(street, 60), more, **ANTENNA)
    assert aligned_rms(last.trajectory.position, street.truth.position[:60]) < 0.3
    lines = backend.report.warnings
    told = [
        re.match(r"60 priors in frame 'enu' scatter by (\S+) m about the path, (\d+) times", line) for line in lines
    ]
    (found,) = (one for one in told if one)
    assert 0.5 < float(found[1]) < 1.5 and 500 < int(found[2]) < 1500, lines


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps_told", "drift_m"),
    [("relative", 10.0), pytest.param("covariance", 10.0, marks=pytest.mark.slow), ("relative", 0.0)],
)
def test_fixes_that_drift_along_with_the_map_are_said(street: SyntheticData, steps_told: str, drift_m: float) -> None:
    """4 % too long a way: the map lies between fixes and wheels, and nothing lies far beside it."""
    right, steps = fixes(street, 0.0), wheels(street)
    along = TURN @ (street.truth.position[-1] - street.truth.position[0])
    along *= drift_m / 100.0 / np.linalg.norm(along)
    data = street
    if steps_told == "covariance":
        told = np.diag([0.025**2] * 3 + [0.002**2] * 3).ravel()
        data = dataclasses.replace(
            street, keyframes=tuple(dataclasses.replace(one, covariance=told) for one in street.keyframes)
        )

    def more(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        yield from (moved(one, k * along) for one in right(k, keyframe))
        if steps_told == "relative":
            yield from steps(k, keyframe)

    backend, _, jump = played(data, more, **ANTENNA)
    assert jump < 1.0
    told_of = [re.match(r"priors in frame 'enu' and measured steps drift apart by (\S+) m over (\d+) m", line)
               for line in backend.report.warnings]  # fmt: skip
    found = [one for one in told_of if one]
    assert len(found) == (drift_m > 0.0), backend.report.warnings
    for one in found:
        assert abs(float(one[1]) / float(one[2]) - 0.04) < 0.01, one[0]


def test_measurements_in_a_row_on_one_side_of_the_map_tell_together() -> None:
    rng = np.random.default_rng(3)
    noise, sigma = rng.normal(0.0, 1.0, (100, 3)), np.full(100, np.sqrt(3.0))
    shifted = noise + np.array([3.0, 0.0, 0.0]) * (np.arange(100) >= 60)[:, None]
    assert not contradicted._astray_together(noise, sigma, 0.3).any()
    assert np.flatnonzero(contradicted._astray_together(shifted, sigma, 0.3)).tolist() == list(range(60, 100))
    assert not contradicted._astray_together(shifted, sigma, 5.0).any(), "what moves nothing is not worth a word"
    assert not contradicted._astray_together(shifted[60:69], sigma[60:69], 0.3).any(), "too few to tell"


@pytest.mark.slow
def test_a_receiver_without_a_place_yet_begins_no_frame(street: SyntheticData) -> None:
    nowhere = GlobalFix(0, "gps", np.zeros(3), np.eye(3).ravel(), is_fix=True)
    backend, _, _ = played(first(street, 5), lambda k, _: [nowhere] if k == 0 else [])
    assert backend.report.rejected["bad_factor"] == 1
    assert backend.scene.constraints.origin is None


@pytest.mark.slow
def test_priors_of_which_no_two_agree_leave_the_map_where_it_is(street: SyntheticData) -> None:
    data, rng = first(street, 50), np.random.default_rng(0)
    rotation = geometry.matrix_from_quaternion(street.truth.orientation)

    def more(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        place = street.truth.position[k] + rng.normal(0.0, 50.0, 3)
        told = geometry.quaternion_from_matrix(rotation[k]), np.diag([1e-2] * 3 + [1e-4] * 3).ravel()
        yield PosePrior(keyframe.stamp_ns, "map", place, *told)

    backend, last, jump = played(data, more)
    assert jump < 0.5
    assert aligned_rms(last.trajectory.position, street.truth.position[:50]) < 0.15
    assert any("of 50 recent priors in frame 'map' no two agree" in line for line in backend.report.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "wrong", "moves_m", "said"),
    [
        pytest.param((), (0,), 0.0, "the only recent prior in frame 'map' lies (49|50)", id="one_alone"),
        pytest.param((8, 16, 27), (0,), 0.0, "", id="the_first_of_four"),
        pytest.param((3,), (16,), 0.0, "of 2 recent priors in frame 'map' no two agree", id="one_of_two"),
        pytest.param((), (0, 5), 50.0, "", id="two_that_agree"),
    ],
)
def test_a_prior_moves_the_map_only_if_a_second_one_agrees(
    street: SyntheticData, right: tuple[int, ...], wrong: tuple[int, ...], moves_m: float, said: str
) -> None:
    data, turned = first(street, 30), np.diag([1e-4] * 3 + [1e-4] * 3).ravel()

    def more(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        yield from wheels_of(k, keyframe)
        if k in (*right, *wrong):
            place = street.truth.position[k] + np.array([30.0, -40.0, 0.0]) * (k in wrong)
            yield PosePrior(keyframe.stamp_ns, "map", place, street.truth.orientation[k], turned)

    wheels_of = wheels(street)
    backend, last, _ = played(data, more)
    away = last.trajectory.position - street.truth.position[:30]
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), moves_m, atol=1.0)
    assert any(re.match(said, line) for line in backend.report.warnings) == bool(said), backend.report.warnings


@pytest.mark.slow
def test_a_measurement_that_says_nothing_takes_no_place(street: SyntheticData) -> None:
    """A covariance of ten kilometres leaves the front-end's steps in; places of tracks that never come are counted."""
    data = first(street, 12)
    unit = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    unseen = LandmarkPriors(0, "map", np.array([2**60], np.uint64), np.zeros((1, 3)), np.eye(3)[None])

    def more(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        if k:
            before = int(data.keyframes[k - 1].keyframe_id)
            yield RelativePose(0, before, keyframe.keyframe_id, False, *unit, 1e8 * np.eye(6).ravel())
        else:
            yield unseen

    backend, last, _ = played(data, more)
    _, plain, _ = played(data, lambda *_: ())
    assert backend.scene.log.notices["unpaired"] == 1
    np.testing.assert_allclose(last.trajectory.position, plain.trajectory.position, atol=1e-3)
