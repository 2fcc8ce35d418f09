# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What begins a session and what does not: session ids, frames, rigs, silence, and messages of no use."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config, ConfigError
from ba_node.measurements import CameraRig, FeatureTracks, LandmarkGuesses, Measurement
from tests.backend.session_streams import (
    HOUR,
    YEAR,
    N,
    Played,
    all_ids,
    changed,
    data,
    groups,
    joined,
    messages,
    stamped,
    undisturbed,
)

USELESS: dict[str, Callable[[], Measurement]] = {
    "tracks without rows": lambda: _tracks(uv=np.empty((0, 2)), track_id=np.empty(0, np.uint64)),
    "tracks of NaN": lambda: _tracks(uv=np.full_like(data().tracks[5][0].uv, np.nan)),
    "sound tracks": lambda: data().tracks[5][0],
    "guesses without rows": lambda: LandmarkGuesses(0, np.empty(0, np.uint64), np.empty((0, 3))),
    "guesses of NaN": lambda: LandmarkGuesses(0, np.arange(3, dtype=np.uint64), np.full((3, 3), np.nan)),
    "a keyframe without a pose": lambda: dataclasses.replace(data().keyframes[5], orientation=np.zeros(4)),
    "a sound keyframe": lambda: data().keyframes[5],
}


def _tracks(**changes: Any) -> FeatureTracks:
    empty = np.empty(0)
    return dataclasses.replace(data().tracks[5][0], sigma_px=empty, depth_m=empty, **changes)


@pytest.mark.slow
@pytest.mark.parametrize("session", [1, 2**32 - 1])
@pytest.mark.parametrize("what", USELESS)
def test_one_message_of_a_higher_session_does_not_end_the_map(what: str, session: int) -> None:
    parts = [list(part) for part in groups()]
    parts[6] += changed([USELESS[what]()], session_id=session)
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.map.rejected.total() == 1, played.map.rejected
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("what", sorted(set(USELESS) - {"a keyframe without a pose", "a sound keyframe"}))
def test_one_message_of_a_higher_session_does_not_open_the_first_one(what: str) -> None:
    stray = changed([USELESS[what]()], session_id=7)
    played = Played([data().rig, *stray, *messages()[1:]])
    assert (played.ids, played.scene.session_id) == (all_ids(), 0)
    assert played.map.rejected.total() == 1, played.map.rejected


@pytest.mark.slow
def test_tracks_and_guesses_that_come_before_the_first_keyframe_of_their_session_are_used() -> None:
    first, *others = groups()
    backwards = joined([first[::-1], *others])
    for stream in (backwards, [*messages(), *changed(backwards[1:], session_id=4)]):
        played = Played(stream)
        assert played.ids == all_ids()
        assert not played.map.rejected
        assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.slow
def test_what_waits_for_a_session_is_bounded() -> None:
    ahead = changed([t for both in data().tracks for t in both], session_id=9)
    played = Played([*messages(), *ahead], final=False, settings={"scene.max_pending": 10})
    assert played.map.rejected["unknown_keyframe"] == len(ahead) - 10
    played.flush(final=True)
    assert played.map.rejected["unknown_keyframe"] == len(ahead)
    assert "of session 9, which no keyframe began" in played.rejection_notes[-1]


@pytest.mark.slow
@pytest.mark.parametrize("session", [3, 0])
def test_a_front_end_that_restarts_with_a_lower_session_is_not_refused_for_ever(session: int) -> None:
    last, again = changed(messages(), session_id=2**32 - 1), changed(messages()[1:], session_id=session)
    played = Played([*last, *again])
    assert [key for key, _ in played.finished] == [2**32 - 1]
    assert played.scene.session_id == session
    assert played.ids == all_ids()[2:], "two were turned away before it was clear"
    warning = played.scene.log.warnings["lower_session"]
    assert f"3 keyframes in a row are of session {session}, below the current 4294967295" in warning


@pytest.mark.slow
def test_messages_of_a_session_before_are_refused_while_the_current_goes_on() -> None:
    old, new = groups(), [changed(part, session_id=5) for part in groups()]
    played = Played(joined([*new[:6], old[3], new[6], old[4], old[5], *new[7:]]))
    assert (played.ids, played.finished, played.scene.session_id) == (all_ids(), [], 5)
    assert set(played.map.rejected) == {"stale_session"}


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["map", "/map", "odom2"])
def test_a_keyframe_in_another_frame_is_turned_away(frame: str) -> None:
    parts = groups()
    parts[5] = changed(parts[5], frame_id=frame)
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids()[:5] + all_ids()[6:], [])
    assert played.map.rejected == {"frame_changed": 1, "unknown_keyframe": 2}
    assert f"is in frame '{frame.lstrip('/')}', those before in 'odom'" in played.scene.log.warnings["frame_changed"]


def test_a_frame_that_changes_for_good_begins_a_session() -> None:
    parts = groups()
    played = Played(joined([*parts[:8], *(changed(part, frame_id="map") for part in parts[8:])]))
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [8]
    assert (played.ids, played.scene.frame_id) == (all_ids()[8:], "map")
    assert not played.map.rejected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frame", "words"), [("/odom", "taken as 'odom': leave out"), ("", "names no frame"), ("//", "no")]
)
def test_a_frame_without_a_name_for_tf2_is_said(frame: str, words: str) -> None:
    played = Played(changed(messages(), frame_id=frame))
    assert played.ids == all_ids()
    assert words in played.scene.log.warnings["frame_name"]
    assert played.scene.log.notices["frame_name"] == N
    correction = played.estimate().correction
    assert correction is not None
    assert correction.odom_frame == "odom"


@pytest.mark.slow
def test_frames_that_are_named_with_and_without_a_slash_are_one() -> None:
    parts = [changed(part, frame_id=("odom", "/odom", "")[i % 3]) for i, part in enumerate(groups())]
    played = Played(joined(parts))
    assert (played.ids, played.finished, dict(played.map.rejected)) == (all_ids(), [], {})


@pytest.mark.slow
def test_an_empty_frame_is_no_fault_where_a_parameter_names_it() -> None:
    played = Played(changed(messages(), frame_id=""), settings={"frames.odom_frame": "vo"})
    assert not played.scene.log.warnings


def test_a_rig_that_comes_late_serves_the_session_after_a_jump_too() -> None:
    parts = groups()
    late = [m for part in [*parts[:3], *(stamped(part, -HOUR) for part in parts[3:8])] for m in part]
    played = Played([*late, data().rig, *(m for part in parts[8:] for m in stamped(part, -HOUR))])
    assert len(played.finished) == 1
    assert played.ids == all_ids()[3:]
    assert played.scene.keyframes.refined.all()


@pytest.mark.slow
def test_another_rig_is_used_from_a_session_on_that_a_jump_began() -> None:
    other = dataclasses.replace(data().rig, intrinsics=data().rig.intrinsics * 1.1)
    parts = groups()
    played = Played(joined([*parts[:5], [other], *(stamped(part, -HOUR) for part in parts[5:])]))
    assert played.scene.cameras is not None
    assert played.scene.cameras.params[0, 0] == pytest.approx(1.1 * data().rig.intrinsics[0, 0])


def test_reset_forgets_what_is_held() -> None:
    parts = groups()
    played = Played(joined([*parts[:5], stamped(parts[5], -HOUR)]), final=False)
    assert len(played.held) == 1
    played.reset()
    assert played.held == []


def test_silence_begins_a_session_that_was_asked_for_and_no_other() -> None:
    parts = groups()
    for after, begins in ((stamped(parts[5], -HOUR), False), (changed(parts[5], session_id=1), True)):
        played = Played(joined([*parts[:5], after]), final=False)
        assert len(played.held) == 1
        played.flush()
        assert len(played.held) == (0 if begins else 1)
        assert len(played.scene.keyframes) == (1 if begins else 5)


@pytest.mark.slow
def test_silence_begins_a_session_where_the_first_keyframe_comes_again_with_its_tracks() -> None:
    near = {"scene.max_reorder_s": 1.0}
    for again, begins in ((groups()[0], True), (groups()[0][:1], False), (groups()[1], False)):
        played = Played([*messages(), *again], final=False, settings=near)
        played.flush()
        assert len(played.scene.keyframes) == (1 if begins else N)
        assert not played.map.rejected


def test_the_same_stream_gives_the_same_bits_though_keyframes_are_held() -> None:
    parts = groups()
    parts[4], parts[7] = stamped(parts[4], at_ns=0), stamped(parts[7], YEAR)
    stream = joined([*parts[:10], *(stamped(part, -HOUR) for part in parts[10:])])
    first, second = Played(stream), Played(stream)
    assert first.scene.keyframes.position.tobytes() == second.scene.keyframes.position.tobytes()
    assert len(first.estimates) == len(second.estimates) == N - 2


def test_a_rig_is_never_held() -> None:
    assert isinstance(data().rig, CameraRig)
    backend = Backend(Config())
    assert len(backend.admit(data().rig)) == 1


@pytest.mark.parametrize("name", ["map_frame", "odom_frame", "base_frame"])
def test_a_parameter_that_names_a_frame_with_a_slash_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"frames.{name} = '/here': tf2 refuses .* take 'here'"):
        Config().with_values({f"frames.{name}": "/here"})
