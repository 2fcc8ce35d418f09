# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ba_node.config import SceneConfig
from ba_node.core import geometry
from ba_node.measurements import (
    CameraRig,
    FeatureTracks,
    GravityDirection,
    Keyframe,
    LandmarkGuesses,
    Measurement,
    PosePrior,
    RelativePose,
)
from ba_node.scene.rejections import NOTES_KEPT, REASONS
from ba_node.scene.scene import Scene

IDS = np.array([0, 1, 2**53 + 1, 2**63, 2**64 - 2, 2**64 - 1], np.uint64)


def rig(n: int = 2, **changes: Any) -> CameraRig:
    plain = CameraRig(
        "body",
        tuple(f"camera{i}" for i in range(n)),
        ("plumb_bob",) * n,
        np.tile([500.0, 500.0, 320.0, 240.0], (n, 1)),
        (np.zeros(5),) * n,
        np.zeros((n, 2), np.int64),
        np.array([[0.1 * i, 0.0, 0.0] for i in range(n)]),
        np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
    )
    return dataclasses.replace(plain, **changes)


def keyframe(i: int, session: int = 0, stamp: int | None = None, **changes: Any) -> Keyframe:
    stamp = i if stamp is None else stamp
    plain = Keyframe(session, i, stamp, "map", np.array([0.5 * stamp, 0, 0]), np.array([0, 0, 0, 1.0]))
    return dataclasses.replace(plain, **changes)


def tracks(i: int, camera: int = 0, ids: np.ndarray = IDS, session: int = 0, **changes: Any) -> FeatureTracks:
    uv = np.linspace(100.0, 200.0, 2 * len(ids)).reshape(-1, 2)
    return dataclasses.replace(FeatureTracks(session, i, camera, ids, uv), **changes)


def guesses(ids: np.ndarray = IDS, session: int = 0, **changes: Any) -> LandmarkGuesses:
    position = 1.0 + np.arange(3.0 * len(ids)).reshape(-1, 3)
    return dataclasses.replace(LandmarkGuesses(session, ids, position), **changes)


def scene_of(*measurements: Measurement, **config: int) -> Scene:
    scene = Scene(SceneConfig(**config))
    for measurement in measurements:
        scene.add(measurement)
    return scene


def content(scene: Scene) -> tuple[Any, ...]:
    """Return what a scene knows, in a form that does not depend on row numbers."""
    views = sorted(
        (
            int(scene.keyframes.keyframe_id[s_kf]),
            int(camera),
            int(scene.landmarks.track_id[s_lm]),
            *map(float, uv),
            float(sigma),
            repr(float(depth)),
        )
        for s_kf, camera, s_lm, uv, sigma, depth in zip(
            scene.observations.keyframe,
            scene.observations.camera,
            scene.observations.landmark,
            scene.observations.uv,
            scene.observations.sigma_px,
            scene.observations.depth_m,
            strict=True,
        )
    )
    rows = np.argsort(scene.landmarks.track_id)
    table = scene.landmarks
    marks = [
        (int(table.track_id[r]), int(table.views[r]), bool(table.has_guess[r]), repr(table.guess[r].tolist()))
        for r in rows
    ]
    poses = [(int(scene.keyframes.keyframe_id[r]), scene.keyframes.position[r].tolist()) for r in scene.order]
    return views, marks, poses, len(scene.pending)


def check_links(scene: Scene) -> None:
    """Check that the views found through the links are those of the table, for every landmark."""
    for row in range(len(scene.landmarks)):
        expected = np.flatnonzero(scene.observations.landmark == row)
        assert sorted(scene.views_of(np.array([row])).tolist()) == expected.tolist()
        assert scene.landmarks.views[row] == len(expected)
    blocks = sorted((b.begin, b.end, row, b.camera) for row, of_row in enumerate(scene.blocks) for b in of_row)
    covered = [i for begin, end, _, _ in blocks for i in range(begin, end)]
    assert covered == list(range(len(scene.observations)))
    for begin, end, row, camera in blocks:
        assert (scene.observations.keyframe[begin:end] == row).all()
        assert (scene.observations.camera[begin:end] == camera).all()


def test_any_uint64_is_an_id() -> None:
    ends = [0, 2**53 + 1, 2**64 - 1]
    scene = scene_of(rig(), *(m for i, k in enumerate(ends) for m in (keyframe(k, stamp=i), tracks(k))))
    assert [int(k) for k in scene.keyframes.keyframe_id] == ends
    assert [int(t) for t in scene.landmarks.track_id[np.argsort(scene.landmarks.track_id)]] == IDS.tolist()
    assert (scene.landmarks.views == 3).all()
    assert not scene.log.rejected
    check_links(scene)


BAD_ROWS = [
    ("non_finite", {"uv": [[np.nan, 1], [2, np.inf], [3, 3]]}, 2),
    ("out_of_range", {"uv": [[1e7, 1], [2, -1e7], [3, 3]]}, 2),
    ("non_finite", {"sigma_px": [np.nan, np.inf, 1]}, 2),
    ("bad_sigma", {"sigma_px": [0, -1, 1]}, 2),
    ("bad_sigma", {"sigma_px": [1e-44, 1e30, 1]}, 2),
    ("non_finite", {"depth_m": [np.inf, 1, np.nan]}, 1),
    ("duplicate_observation", {"track_id": [7, 7, 7]}, 2),
]


@pytest.mark.parametrize(("reason", "values", "count"), BAD_ROWS)
def test_bad_rows_are_dropped_one_by_one(reason: str, values: dict[str, list[Any]], count: int) -> None:
    arrays: dict[str, Any] = {k: np.array(v, np.uint64 if k == "track_id" else float) for k, v in values.items()}
    scene = scene_of(rig(), keyframe(4), tracks(4, ids=IDS[:3], **arrays))
    assert scene.log.rejected == {reason: count}
    assert len(scene.observations) == 3 - count
    assert f"({reason} = {count})" in scene.log.notes[-1]
    assert "keyframe 4" in scene.log.notes[-1]


def test_a_bad_depth_costs_the_depth_alone() -> None:
    scene = scene_of(rig(), keyframe(4), tracks(4, ids=IDS[:4], depth_m=np.array([-1.0, 0.0, 5.0, np.nan])))
    assert scene.log.rejected == {"bad_depth": 2}
    assert scene.observations.depth_m.tolist()[2] == 5.0
    assert np.isnan(scene.observations.depth_m[[0, 1, 3]]).all()


BAD_MESSAGES = [
    ("malformed", tracks(4, malformed="u has 3 entries, v has 2")),
    ("malformed", tracks(4, uv=np.zeros((2, 2)))),
    ("malformed", tracks(4, sigma_px=np.ones(2))),
    ("malformed", tracks(4, depth_m=np.ones(9))),
    ("malformed", tracks(4, ids=np.array([-1, 2, 3]))),
    ("unknown_camera", tracks(4, camera=2)),
    ("unknown_camera", tracks(4, camera=65535)),
    ("bad_pose", keyframe(5, position=np.array([np.nan, 0, 0]))),
    ("bad_pose", keyframe(5, orientation=np.zeros(4))),
    ("bad_pose", keyframe(5, orientation=np.array([0, 0, np.inf, 1]))),
    ("malformed", keyframe(5, position=np.zeros(2))),
    ("duplicate_keyframe", keyframe(4, position=np.ones(3))),
    ("malformed", guesses(malformed="18 positions for 5 ids")),
    ("malformed", guesses(position=np.zeros((2, 3)))),
    ("bad_guess", guesses(ids=IDS[:1], position=np.array([[np.nan, 0, 0]]))),
    ("stale_session", keyframe(9, session=-1)),
    ("unknown_model", rig(models=("plumb_bob", "fisheye62"))),
    ("unknown_model", rig(intrinsics=np.zeros((2, 4)))),
    ("bad_rig", rig(0)),
    ("bad_rig", rig(names=())),
    ("bad_rig", rig(image_size=np.zeros((1, 2), np.int64))),
    ("bad_rig", rig(malformed="camera 1 ('b'): k is all zero")),
    ("bad_rig", rig(orientation=np.zeros((2, 4)))),
    ("rig_changed", rig(1)),
]


@pytest.mark.parametrize(("reason", "bad"), BAD_MESSAGES)
def test_a_bad_message_is_counted_and_changes_nothing(reason: str, bad: Measurement) -> None:
    scene = scene_of(rig(), keyframe(4), tracks(4), guesses(ids=IDS[1:]))
    before, cameras = content(scene), scene.cameras
    scene.add(bad)
    assert scene.log.rejected == {reason: 1}, scene.log.notes
    assert content(scene) == before
    assert scene.cameras is cameras


def test_a_bad_message_does_not_decide_the_session() -> None:
    scene = scene_of(keyframe(1, session=99, orientation=np.zeros(4)), keyframe(1))
    assert scene.session_id == 0
    assert len(scene.keyframes) == 1


def test_every_reason_is_documented() -> None:
    assert {reason for reason, _ in BAD_MESSAGES} | {reason for reason, _, _ in BAD_ROWS} <= set(REASONS)


@pytest.mark.parametrize(("east_m", "words"), [(16_000.0, ""), (16_400.0, "0.002 m"), (-5_412_345.0, "0.5 m")])
def test_far_from_the_origin_is_warned_about(east_m: float, words: str) -> None:
    """From 2^14 m on the float32 of a cloud has steps of more than a millimetre."""
    scene = Scene(SceneConfig())
    scene.add(keyframe(1, position=np.array([0.0, east_m, 0.0])))
    told = scene.log.warnings.get("far_from_origin", "")
    assert bool(told) == bool(words) and words in told, told


def test_an_identical_rig_again_is_fine() -> None:
    scene = scene_of(rig(), keyframe(4), tracks(4), rig())
    assert not scene.log.rejected


def test_tracks_wait_for_their_keyframe_and_for_the_rig() -> None:
    expected = content(scene_of(rig(), keyframe(4), tracks(4), tracks(4, camera=1)))
    assert content(scene_of(tracks(4), keyframe(4), tracks(4, camera=1), rig())) == expected
    assert content(scene_of(tracks(4), rig(), tracks(4, camera=1), keyframe(4))) == expected


def test_waiting_is_bounded_and_given_up_in_the_end() -> None:
    scene = scene_of(rig(), keyframe(0), *(tracks(i) for i in range(1, 6)), max_pending=3)
    assert scene.log.rejected == {"unknown_keyframe": 2}
    assert [t.keyframe_id for t in scene.pending] == [3, 4, 5]
    scene.end_pending()
    assert scene.log.rejected == {"unknown_keyframe": 5}
    without_rig = scene_of(keyframe(0), *(tracks(0, camera=i) for i in range(5)), max_pending=3)
    assert without_rig.log.rejected == {"pending_overflow": 2}


def test_a_late_stamp_is_sorted_in() -> None:
    scene = scene_of(keyframe(1), keyframe(3), keyframe(2), keyframe(7, stamp=2))
    assert [int(scene.keyframes.keyframe_id[r]) for r in scene.order] == [1, 2, 7, 3]
    assert scene.log.notices == {"reordered": 2}
    assert not scene.log.rejected


@pytest.mark.parametrize("newest", [1, 3, 7, 100])
def test_the_newest_views_are_the_last_rows_of_each_landmark(newest: int) -> None:
    scene = scene_of(rig(), *(m for i in range(8) for m in (keyframe(i), tracks(i, ids=IDS[: 2 + i % 3]))))
    landmarks = np.array([0, 2, 3])
    found = scene.views_of(landmarks, newest)
    for row in landmarks:
        expected = np.flatnonzero(scene.observations.landmark == row)[-newest:]
        assert sorted(found[scene.observations.landmark[found] == row].tolist()) == expected.tolist()


def test_new_keyframes_follow_the_correction_of_their_predecessor() -> None:
    scene = scene_of(keyframe(1), keyframe(2))
    turn = geometry.so3_exp(np.array([0.0, 0.0, 0.3]))
    scene.keyframes.rotation[1], scene.keyframes.position[1] = turn, [10.0, 0, 0]
    scene.keyframes.refined[1] = True
    scene.moved(np.array([1]))
    scene.add(keyframe(3, position=np.array([1.5, 0.25, 0])))
    scene.propagate_corrections()
    # Keyframe 2 came in at x = 1: keyframe 3 is (0.5, 0.25, 0) further on, seen from it.
    np.testing.assert_allclose(scene.keyframes.position[2], [10.0, 0, 0] + turn @ [0.5, 0.25, 0], atol=1e-14)
    np.testing.assert_allclose(scene.keyframes.rotation[2], turn, atol=1e-14)
    # What came before the first refined keyframe moves with it.
    np.testing.assert_allclose(scene.keyframes.position[0], [10.0, 0, 0] + turn @ [-0.5, 0, 0], atol=1e-14)


def test_the_oldest_keyframes_are_forgotten_with_their_observations() -> None:
    scene = scene_of(rig(), max_keyframes=20)
    for i in range(100):
        scene.add(keyframe(i))
        scene.add(tracks(i, ids=np.array([i // 2, 1000], np.uint64)))
        assert len(scene.keyframes) <= 20
    assert [int(k) for k in scene.keyframes.keyframe_id][-1] == 99
    assert len(scene.observations) == 2 * len(scene.keyframes)
    check_links(scene)


def test_landmarks_seen_longest_ago_are_forgotten() -> None:
    scene = scene_of(rig(), max_landmarks=100)
    for i in range(30):
        scene.add(keyframe(i))
        scene.add(tracks(i, ids=np.array([2**64 - 1, *range(10 * i, 10 * i + 10)], np.uint64)))
        assert len(scene.landmarks) <= 100
    known = {int(t) for t in scene.landmarks.track_id}
    assert set(range(290, 300)) | {2**64 - 1} <= known
    assert not known & set(range(150))
    check_links(scene)


def test_notes_are_bounded_and_name_the_case() -> None:
    scene = scene_of(*(keyframe(1) for _ in range(200)))
    assert len(scene.log.notes) == NOTES_KEPT
    assert scene.log.notes[-1] == "keyframe 1 is known already; dropped (duplicate_keyframe = 199)"


some_ids = st.lists(st.sampled_from(IDS.tolist()), min_size=0, max_size=6).map(lambda x: np.array(x, np.uint64))
coordinates = st.floats(-2000, 2000) | st.sampled_from([np.nan, np.inf, -np.inf, 1e9, 0.0])


@st.composite
def some_tracks(draw: st.DrawFn) -> FeatureTracks:
    ids = draw(some_ids)
    n = len(ids) if draw(st.integers(0, 9)) else draw(st.integers(0, 6))
    values = [draw(st.lists(coordinates, min_size=k, max_size=k)) for k in (2 * n, len(ids), len(ids))]
    uv, sigma, depth = (np.array(v, float) for v in values)
    return FeatureTracks(
        draw(st.integers(0, 1)),
        draw(st.integers(0, 4) | st.just(2**64 - 1)),
        draw(st.integers(0, 3)),
        ids,
        uv.reshape(-1, 2),
        sigma if draw(st.booleans()) else np.empty(0),
        depth if draw(st.booleans()) else np.empty(0),
        draw(st.sampled_from(["", "", "", "bad"])),
    )


@st.composite
def some_keyframe(draw: st.DrawFn) -> Keyframe:
    position = np.array([draw(coordinates) for _ in range(3)])
    if draw(st.booleans()):
        position = np.nan_to_num(position, posinf=1.0, neginf=0.0)
    quaternion = np.array(draw(st.sampled_from([[0, 0, 0, 1.0], [0, 0, 0, 0.0], [1, 1, 0, 0], [np.nan, 0, 0, 1]])))
    number = draw(st.integers(0, 4) | st.just(2**64 - 1))
    return Keyframe(draw(st.integers(0, 1)), number, draw(st.integers(-5, 5)), "map", position, quaternion)


@st.composite
def some_guesses(draw: st.DrawFn) -> LandmarkGuesses:
    ids = draw(some_ids)
    position = np.array([draw(coordinates) for _ in range(3 * len(ids))], float).reshape(-1, 3)
    return LandmarkGuesses(draw(st.integers(0, 1)), ids, position)


some_rig = st.sampled_from([rig(1), rig(2), rig(3), rig(0), rig(models=("plumb_bob", "unknown"))])
some_measurement = some_tracks() | some_keyframe() | some_guesses() | some_rig


@settings(max_examples=80)
@given(st.lists(some_measurement, max_size=25))
def test_no_stream_raises_or_breaks_the_links(stream: list[Measurement]) -> None:
    scene = Scene(SceneConfig(max_pending=3))
    for measurement in stream:
        known = {int(k) for k in scene.keyframes.keyframe_id}
        scene.add(measurement)
        assert known <= {int(k) for k in scene.keyframes.keyframe_id}
        assert len(scene.pending) <= 3
    assert np.isfinite(scene.keyframes.position).all()
    assert np.isfinite(scene.observations.uv).all()
    assert (scene.observations.sigma_px > 0).all()
    assert np.isfinite(scene.landmarks.guess[scene.landmarks.has_guess]).all()
    check_links(scene)


@settings(max_examples=60)
@given(st.lists(some_measurement, max_size=15), st.randoms(use_true_random=False))
def test_sending_everything_again_changes_only_counters(stream: list[Measurement], random: Any) -> None:
    scene = scene_of(*stream)
    scene.end_pending()
    before = content(scene)
    again = [m for m in stream if not isinstance(m, CameraRig)]
    random.shuffle(again)
    known = {int(k) for k in scene.keyframes.keyframe_id}
    for measurement in again:
        # Tracks that had no keyframe or no such camera may only wait again; a first keyframe cannot be repeated.
        if not isinstance(measurement, FeatureTracks) or (measurement.keyframe_id in known and scene.cameras):
            scene.add(measurement)
    scene.end_pending()
    assert content(scene) == before


@settings(max_examples=60)
@given(st.permutations(range(7)), st.integers(2, 7))
def test_order_within_a_keyframe_does_not_matter(order: list[int], split: int) -> None:
    messages: list[Measurement] = [
        rig(),
        keyframe(1),
        tracks(1),
        tracks(1, camera=1, ids=IDS[::2]),
        guesses(ids=IDS[:3]),
        guesses(ids=IDS[3:]),
        tracks(1, camera=0, ids=np.array([77], np.uint64)),
    ]
    shuffled = [messages[i] for i in order]
    scene = scene_of(*shuffled[:split], *shuffled)
    assert content(scene) == content(scene_of(*messages))


def test_corrections_are_propagated_as_if_all_were_done_anew() -> None:
    """Poses and refinements change at random, keyframes come late: each follows the last refined one before it."""
    rng = np.random.default_rng(5)
    scene = scene_of()
    for count in range(120):
        stamp = count - 4 if count % 9 == 8 else count
        scene.add(keyframe(count, stamp=stamp, position=rng.normal(size=3)))
        for row in rng.integers(0, len(scene.keyframes), rng.integers(0, 3)):
            scene.keyframes.position[row] = rng.normal(size=3)
            scene.keyframes.refined[row] = rng.random() < 0.7
            scene.moved(np.array([row]))
        scene.propagate_corrections()
        table, order = scene.keyframes, scene.order.tolist()
        assert order == sorted(range(len(table)), key=lambda row: (int(table.stamp_ns[row]), row))
        assert scene.places()[order].tolist() == list(range(len(order)))
        refined = [row for row in order if table.refined[row]]
        for place, row in enumerate(order if refined else []):
            before = [other for other in order[: place + 1] if table.refined[other]]
            anchor = before[-1] if before else refined[0]
            step = table.input_position[row] - table.input_position[anchor]
            np.testing.assert_allclose(table.position[row], table.position[anchor] + step, atol=1e-12)


def test_rows_are_numbered_and_told_apart_without_regard_to_the_rest() -> None:
    scene = scene_of(rig(), keyframe(1), tracks(1, ids=np.arange(50, dtype=np.uint64)))
    rows = np.array([7, 3, 7, 40, 3, 9], np.int32)
    for _ in range(2):
        assert scene.distinct(rows).tolist() == [3, 7, 9, 40]
        assert scene.numbers(rows, np.array([40, 7])).tolist() == [1, -1, 1, 0, -1, -1]


def test_observations_are_bounded_however_many_an_image_shows() -> None:
    """The oldest keyframes go, a tenth of the bound at once, and no row of what stays is lost."""
    scene, n = scene_of(rig(), max_observations=1000), 0
    for i in range(300):
        ids = np.arange(10 * i, 10 * i + 60 + i % 7, dtype=np.uint64)
        scene.add(keyframe(i))
        scene.add(tracks(i, ids=ids))
        assert len(scene.observations) <= 1000 + len(ids)
        n = max(n, len(scene.observations))
        assert int(scene.keyframes.keyframe_id[scene.order[-1]]) == i
        last = scene.blocks[scene.order[-1]][0]
        seen = scene.landmarks.track_id[scene.observations.landmark[last.begin : last.end]]
        assert seen.tolist() == ids.tolist()
    assert n > 950
    scene.add(tracks(299, camera=1, ids=np.arange(5000, dtype=np.uint64)))
    scene.add(keyframe(300))
    assert scene.keyframes.keyframe_id.tolist() == [299, 300], "the newest stay, whatever they see"


def test_what_hangs_on_forgotten_keyframes_is_forgotten_too() -> None:
    scene, eye = scene_of(max_keyframes=20), np.eye(6)
    origin, upright = np.zeros(3), np.array([0.0, 0, 0, 1])
    for i in range(200):
        scene.add(keyframe(i))
        scene.add(RelativePose(0, i, i + 1, False, origin, upright, eye.ravel()))
        scene.add(GravityDirection(0, i, np.array([0.0, 0, 1]), 0.01))
        scene.add(PosePrior(i, "site", origin, upright, eye.ravel()))
    kept = scene.keyframes.keyframe_id.tolist()
    assert len(kept) <= 20
    known = scene.constraints
    assert list(known.relative) == [(key, key + 1) for key in kept]
    assert list(known.gravity) == kept
    assert [one.stamp_ns for one in known.absolute] == kept
