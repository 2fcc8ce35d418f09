# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: a back-end that took one over goes on as the first would have, and takes over only what is sound."""

from __future__ import annotations

import copy
import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from ba_node.backend import Backend
from ba_node.backend.archive import unpack
from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement, OfTime
from ba_node.scene.map_content import MapContent, MapError
from experiments.synthetic import SyntheticOptions, generate

if TYPE_CHECKING:
    from collections.abc import Callable

SETTINGS = {"solver.max_iterations": 3, "window.max_keyframes": 4, "scene.max_pending": 5, "scene.max_landmarks": 150}


@functools.cache
def stream(seed: int) -> tuple[Measurement, ...]:
    """Return a stream of three sessions, with some of the messages twice and some outliers."""
    out: list[Measurement] = []
    for session in range(3):
        options = SyntheticOptions(
            keyframes=5, landmarks=200, tracks=25, length_m=10.0, path="line", ids="random64", guesses=True,
            seed=seed, outlier_share=0.05, depth_share=0.3 * (seed % 2),
        )  # fmt: skip
        for _, _, m in generate(options).timeline():
            out.append(m if isinstance(m, CameraRig | OfTime) else dataclasses.replace(m, session_id=session))
    return tuple(out)


@st.composite
def cut_streams(draw: st.DrawFn) -> tuple[list[Measurement], int]:
    """Draw a stream that lost, repeated and swapped some messages, and where to cut it."""
    out = [m for m in stream(draw(st.integers(0, 3))) if draw(st.integers(0, 9))]
    for _ in range(draw(st.integers(0, 6))):
        i, j = draw(st.integers(0, len(out) - 1)), draw(st.integers(0, len(out) - 1))
        out.insert(j, out[i])
    return out, draw(st.integers(0, len(out)))


def backend() -> Backend:
    return Backend(Config().with_values(SETTINGS))


def feed(target: Backend, measurements: list[Measurement]) -> list[Estimate | None]:
    estimates = []
    for m in measurements:
        if target.completes(m):
            estimates.append(target.solve())
        target.add(m)
    return estimates


def bits(content: MapContent) -> dict[str, Any]:
    arrays = {name: (array.dtype, array.shape, array.tobytes()) for name, array in content.arrays.items()}
    return {**arrays, **content.facts}


def estimate_bits(estimate: Estimate | None) -> Any:
    assert estimate is not None
    parts = (estimate.refined, estimate.trajectory, estimate.cloud)
    arrays = [getattr(part, f.name).tobytes() for part in parts for f in dataclasses.fields(part)]
    return arrays, estimate.report, estimate.stamp_ns, estimate.frame_id


@pytest.mark.slow
@settings(max_examples=15, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(cut_streams())
def test_a_copy_goes_on_as_the_first_does(drawn: tuple[list[Measurement], int]) -> None:
    measurements, cut = drawn
    first, second = backend(), backend()
    feed(first, measurements[:cut])
    content = first.snapshot()
    second.take_over(unpack(content, second.config.scene))
    assert bits(second.snapshot()) == bits(content)
    # What is held until others tell what it is belongs to no map yet.
    second._sessions.state = first._sessions.state
    rest = [[*feed(each, measurements[cut:]), each.solve()] for each in (first, second)]
    assert [estimate_bits(e) for e in rest[0] if e] == [estimate_bits(e) for e in rest[1] if e]
    assert bits(first.snapshot()) == bits(second.snapshot())


@pytest.fixture(scope="module")
def known_content() -> MapContent:
    """Return what is known of two sessions; to be copied before it is changed."""
    return _knowing().snapshot()


@pytest.fixture(scope="module")
def untouched() -> Backend:
    """Return a back-end with a map that must stay as it is."""
    made = backend()
    feed(made, list(stream(2)))
    return made


@pytest.fixture
def known() -> Backend:
    """Return a back-end that knows two sessions, and tracks that wait for their keyframe."""
    return _knowing()


def _knowing() -> Backend:
    made = backend()
    measurements = list(stream(1))
    last = next(i for i, m in enumerate(measurements) if isinstance(m, Keyframe) and m.session_id == 2)
    feed(made, measurements[: last - 1])
    tracks = next(m for m in measurements if isinstance(m, FeatureTracks) and m.session_id == 1)
    made.add(dataclasses.replace(tracks, keyframe_id=12345))
    return made


def test_it_knows_all_of_that(known: Backend) -> None:
    content = known.snapshot()
    assert len(content.arrays["pending/keyframe_id"]) == 1
    assert content.facts["session_id"] == 1
    assert len(content.arrays["observations/uv"]) > 100


def test_a_snapshot_does_not_change_any_more(known: Backend) -> None:
    content = known.snapshot()
    before = bits(content)
    feed(known, list(stream(1)))
    assert bits(content) == before


def test_reset_forgets_all_but_the_cameras(known: Backend) -> None:
    count, cameras = known.solve_count, known.scene.cameras
    known.reset()
    content = known.snapshot()
    assert {name: len(array) for name, array in content.arrays.items() if len(array)}.keys() == {
        f"cameras/{name}" for name in ("rotation", "translation", "model", "params")
    }
    assert (content.facts["session_id"], content.facts["rejected"]) == (None, {})
    assert known.scene.cameras is cameras
    assert known.solve_count == count
    # A session that is not higher than the last is taken, too: the front-end need not know of the reset.
    estimates = feed(known, [m for m in stream(1) if isinstance(m, CameraRig | OfTime) or m.session_id == 0])
    assert estimates[-1] is not None
    assert estimates[-1].report.status.usable


def spoil(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[MapContent], None]:
    def apply(content: MapContent) -> None:
        array = content.arrays[name].copy()
        changed = change(array)
        content.arrays[name] = array if changed is None else changed

    return apply


def put(at: int, value: Any) -> Callable[[np.ndarray], None]:
    def apply(array: np.ndarray) -> None:
        array[at] = value

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.arrays.pop("landmarks/guess"), "landmarks/guess is missing"),
        (lambda c: c.arrays.pop("blocks/end"), "blocks/end is missing"),
        (lambda c: c.arrays.pop("cameras/params"), "cameras/params is missing"),
        (spoil("keyframes/position", lambda a: a[:, :2]), r"keyframes/position is \(5, 2\) float64, expected \(n, 3\)"),
        (spoil("keyframes/stamp_ns", lambda a: a.astype(float)), "keyframes/stamp_ns is .* expected .* int64"),
        (spoil("keyframes/refined", lambda a: a[1:]), "keyframes/refined has 4 rows, the first of keyframes 5"),
        (spoil("keyframes/keyframe_id", lambda a: np.full_like(a, 7)), "keyframes/keyframe_id = 7 occurs more"),
        (spoil("keyframes/rotation", put(1, 0.5)), "keyframes/rotation of row 1 .*expected a rotation"),
        (spoil("keyframes/input_position", put(2, np.nan)), "keyframes/input_position of row 2 .*at most 1e\\+09 m"),
        (spoil("keyframes/position", put(2, 1e300)), "keyframes/position of row 2 .*at most 2e\\+09 m"),
        (spoil("keyframes/stamp_ns", put(1, 2**63 - 1)), "keyframes/stamp_ns of row 1 .*seconds of 32 bits"),
        (spoil("correction/translation", lambda a: np.full_like(a, 1e300)), "correction/translation of row 0 .*1e12 m"),
        (spoil("landmarks/position", lambda a: np.full_like(a, 1e300)), "landmarks/position of row .* has_position"),
        (spoil("cameras/translation", put(1, 1e300)), "cameras/translation of row 1 .*at most 2e\\+09 m"),
        (spoil("cameras/params", put(1, 1e300)), "cameras/params of row 1 .*at most 1e\\+09, with fx, fy > 0"),
        (spoil("observations/sigma_px", put(4, 1e30)), "observations/sigma_px of row 4 = 1.*at most 1e\\+06"),
        (spoil("observations/depth_m", put(4, 1e30)), "observations/depth_m of row 4 = 1.*at most 1e\\+06"),
        (spoil("landmarks/position", lambda a: np.full_like(a, np.inf)), "landmarks/position of row .* has_position"),
        (spoil("observations/keyframe", put(3, 5)), "observations/keyframe of row 3 = 5: expected an index below 5"),
        (spoil("observations/landmark", put(0, -1)), "observations/landmark of row 0 = -1"),
        (spoil("observations/camera", put(9, 2)), "observations/camera of row 9 = 2: expected an index below 2"),
        (spoil("observations/uv", put(4, np.nan)), "observations/uv of row 4"),
        (spoil("observations/sigma_px", put(4, 0.0)), "observations/sigma_px of row 4 = 0.0: expected a number > 0"),
        (spoil("observations/depth_m", put(4, -1.0)), "observations/depth_m of row 4"),
        (
            lambda c: c.arrays["observations/landmark"].__setitem__(1, c.arrays["observations/landmark"][0]),
            "more than once",
        ),
        (spoil("blocks/camera", lambda a: 1 - a), "blocks/camera contradicts observations/camera"),
        (spoil("blocks/begin", put(1, 0)), "blocks do not cover the rows of observations once each"),
        (spoil("blocks/end", put(-1, 10**6)), "blocks/begin of row"),
        (spoil("cameras/model", put(0, 9)), r"cameras/model of row 0 = 9: expected one of \[0, 1\]"),
        (spoil("cameras/params", put(0, 0.0)), "cameras/params of row 0"),
        (spoil("pending/count", lambda a: a + 1), "pending_rows has"),
        (spoil("pending_rows/uv", put(0, np.nan)), "pending_rows: tracks of keyframe 12345 are not sound"),
        (lambda c: c.facts.pop("session_id"), "session_id = None, expected int or NoneType"),
        (lambda c: c.facts.update(session_id=True), "session_id = True"),
        (lambda c: c.facts.update(session_id=2**32), "session_id = 4294967296, expected 32 bits"),
        (lambda c: c.facts.update(solve_count=-1), "solve_count = -1, expected a count"),
        (lambda c: c.facts.update(solve_count=2**64), "solve_count = .*, expected 64 bits"),
        (lambda c: c.facts.update(current=99), "current = 99, expected one of 5 keyframes"),
        (lambda c: c.facts.update(rejected={"malformed": "two"}), "rejected: expected counts"),
        (lambda c: c.facts.update(delivered=[None]), "delivered"),
        (lambda c: c.facts["report"].update(status="FINE"), "status = 'FINE', expected one of CONVERGED"),
        (lambda c: c.facts["report"].update(iterations="3"), "iterations = '3', expected int"),
    ],
)
def test_what_is_not_sound_is_refused(
    known_content: MapContent, untouched: Backend, change: Callable[[MapContent], Any], message: str
) -> None:
    content = copy.deepcopy(known_content)
    change(content)
    before = bits(untouched.snapshot())
    with pytest.raises(MapError, match=message):
        untouched.take_over(unpack(content, untouched.config.scene))
    assert bits(untouched.snapshot()) == before


def test_what_another_version_adds_or_lacks_is_passed_over(known: Backend) -> None:
    content = known.snapshot()
    content.arrays["keyframes/colour"] = np.zeros(3)
    content.facts["weather"] = "fine"
    content.facts["rejected"]["no_such_reason"] = 4
    content.facts["report"]["no_such_field"] = 4
    del content.facts["report"]["reason"]
    target = backend()
    target.take_over(unpack(content, target.config.scene))
    assert "no_such_reason" not in target.map.rejected


def test_a_map_that_is_larger_than_allowed_is_cut_when_more_comes(known: Backend) -> None:
    target = Backend(Config().with_values({**SETTINGS, "scene.max_landmarks": 100}))
    target.take_over(unpack(known.snapshot(), target.config.scene))
    feed(target, [m for m in stream(1) if isinstance(m, CameraRig | OfTime) or m.session_id == 1])
    assert len(target.scene.landmarks) <= 100


def test_taking_over_keeps_parameters_and_counts_on(known: Backend) -> None:
    target = Backend(Config())
    target.solve_count = 1000
    target.take_over(unpack(known.snapshot(), Config().scene))
    assert target.scene.config is target.config.scene
    assert target.solve_count == 1000
    assert bits(target.snapshot()) == {**bits(known.snapshot()), "solve_count": 1000}
