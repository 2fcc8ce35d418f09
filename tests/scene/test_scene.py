# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ba_node.config import SceneConfig
from ba_node.core import geometry
from ba_node.measurements import (
    Measurement,
)
from ba_node.scene.rejections import NOTES_KEPT, REASONS
from ba_node.scene.scene import Scene
from tests.scene.small import IDS, check_links, content, guesses, keyframe, rig, scene_of, tracks


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
    scene = scene_of(rig(), keyframe(4), tracks(4, ids=IDS[:5], depth_m=np.array([-1.0, 0.0, 5.0, np.nan, np.inf])))
    assert scene.log.rejected == {"bad_depth": 3}
    assert scene.observations.depth_m.tolist()[2] == 5.0
    assert np.isnan(scene.observations.depth_m[[0, 1, 3, 4]]).all()


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


def test_notes_are_bounded_and_name_the_case() -> None:
    scene = scene_of(*(keyframe(1) for _ in range(200)))
    assert len(scene.log.notes) == NOTES_KEPT
    assert scene.log.notes[-1] == "keyframe 1 is known already; dropped (duplicate_keyframe = 199)"


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
