# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What begins a session and what does not: stamps, session ids, frames, repeated ids, and messages of no use."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config, ConfigError
from ba_node.estimate import Estimate
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.synthetic import SyntheticData, SyntheticOptions, generate

S = 1_000_000_000
HOUR = 3600 * S
YEAR = 365 * 24 * HOUR
N = 16


@functools.cache
def data() -> SyntheticData:
    options = SyntheticOptions(
        keyframes=N, landmarks=700, tracks=50, length_m=16.0, path="line", ids="random64", seed=3, guesses=True
    )
    return generate(options)


def messages() -> list[Measurement]:
    return [measurement for _, _, measurement in data().timeline()]


def groups() -> list[list[Measurement]]:
    """Return the messages of each keyframe, the keyframe first; without the rig."""
    out: list[list[Measurement]] = []
    for keyframe, tracks, guess in zip(data().keyframes, data().tracks, data().guesses, strict=True):
        out.append([keyframe, *([guess] if guess else []), *tracks])
    return out


def stamped(group: Iterable[Measurement], shift_ns: int = 0, at_ns: int | None = None) -> list[Measurement]:
    """Return messages with the stamp of their keyframe moved or set."""

    def moved(m: Measurement) -> Measurement:
        if not isinstance(m, Keyframe):
            return m
        return dataclasses.replace(m, stamp_ns=m.stamp_ns + shift_ns if at_ns is None else at_ns)

    return [moved(m) for m in group]


def changed(group: Iterable[Measurement], **changes: Any) -> list[Measurement]:
    """Return messages with fields changed in all that have them."""

    def other(m: Any) -> Measurement:
        names = {f.name for f in dataclasses.fields(m)}
        mine: Measurement = dataclasses.replace(m, **{k: v for k, v in changes.items() if k in names})
        return mine

    return [other(m) for m in group]


class Played(Backend):
    """A back-end and what it gave for each keyframe of a stream."""

    def __init__(
        self, stream: Iterable[Measurement], final: bool = True, settings: dict[str, Any] | None = None
    ) -> None:
        super().__init__(Config().with_values(settings or {}))
        self.estimates: list[Estimate | None] = []
        self.play(stream, final)

    def play(self, stream: Iterable[Measurement], final: bool = True) -> None:
        for measurement in stream:
            self._take(self.admit(measurement))
        if final:
            self._take(self.admit_rest())
            self.flush(final=True)
            while self.ready:
                self.estimates.append(self.solve())

    def _take(self, several: Iterable[Any]) -> None:
        for admitted in several:
            if self.completes(admitted):
                self.estimates.append(self.solve())
            self.take(admitted)

    @property
    def ids(self) -> list[int]:
        """Return the ids of the current map by time."""
        return [int(key) for key in self.scene.keyframes.keyframe_id[self.scene.order]]

    @property
    def errors_m(self) -> tuple[float, float]:
        """Return the error of the current map before and after, both moved onto the truth at their first keyframe."""
        rows = [data().truth.keyframe_id.tolist().index(key) for key in self.ids]
        truth = data().truth.position[rows]
        last = self.estimates[-1]
        assert last is not None
        before = np.array([data().keyframes[row].position for row in rows])
        return _rmse(before, truth), _rmse(last.trajectory.position, truth)


def _rmse(found: Any, truth: Any) -> float:
    return float(np.sqrt(np.mean(np.sum((found - found[0] - truth + truth[0]) ** 2, axis=1))))


def joined(parts: Iterable[Iterable[Measurement]]) -> list[Measurement]:
    return [data().rig, *(m for part in parts for m in part)]


def all_ids() -> list[int]:
    return [keyframe.keyframe_id for keyframe in data().keyframes]


@functools.cache
def undisturbed() -> Played:
    return Played(messages())


@pytest.mark.parametrize("first", ["keyframe first", "tracks first"])
def test_a_clock_that_is_set_back_begins_a_session_with_nothing_lost(first: str) -> None:
    parts = groups()
    if first == "tracks first":
        parts = [part[::-1] for part in parts]
    played = Played(joined([*parts[:8], *(stamped(part, -HOUR) for part in parts[8:])]))
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [8]
    assert played.ids == all_ids()[8:]
    assert not played.rejected
    assert len(played.scene.observations) == sum(len(t.track_id) for both in data().tracks[8:] for t in both)
    assert len(played.estimates) == N, "one solve for each keyframe"
    alone = Played(joined(parts[8:]))
    # Guesses that come before their keyframe belong to the session that it is not yet known to begin.
    np.testing.assert_allclose(played.scene.keyframes.position, alone.scene.keyframes.position, atol=1e-3)
    (warning,) = played.scene.log.warnings.values()
    assert "is 3599." in warning and "older than the newest" in warning and "a new session begins" in warning


ABSURD: dict[str, Callable[[list[Measurement]], list[Measurement]]] = {
    "zero": lambda part: stamped(part, at_ns=0),
    "negative": lambda part: stamped(part, at_ns=-5 * S),
    "the least": lambda part: stamped(part, at_ns=-(2**63)),
    "the largest": lambda part: stamped(part, at_ns=2**63 - 1),
    "an hour behind": lambda part: stamped(part, -HOUR),
    "11 s behind": lambda part: stamped(part, -11 * S),
    "12 s ahead": lambda part: stamped(part, 12 * S),
    "an hour ahead": lambda part: stamped(part, HOUR),
    "a year ahead": lambda part: stamped(part, YEAR),
}


@pytest.mark.parametrize("at", [1, 2, 7, N - 2, N - 1])
@pytest.mark.parametrize("name", ABSURD)
def test_one_absurd_stamp_costs_its_keyframe_alone(name: str, at: int) -> None:
    parts = groups()
    parts[at] = ABSURD[name](parts[at])
    played = Played(joined(parts))
    if name == "12 s ahead" and at == N - 1:
        assert played.ids == all_ids(), "a pause before the last"
        return
    assert played.ids == all_ids()[:at] + all_ids()[at + 1 :]
    assert played.finished == []
    assert played.rejected == {"bad_stamp": 1, "unknown_keyframe": 2}
    assert f"keyframe {all_ids()[at]} is" in played.scene.log.warnings["bad_stamp"]
    before, after = played.errors_m
    assert after < 0.6 * before, f"{before:.4f} -> {after:.4f} m"


@pytest.mark.parametrize("name", set(ABSURD) - {"12 s ahead", "zero", "negative", "the least"})
def test_a_first_keyframe_with_an_absurd_stamp_costs_itself_alone(name: str) -> None:
    parts = groups()
    parts[0] = ABSURD[name](parts[0])
    played = Played(joined(parts))
    if "behind" in name:
        assert played.ids == all_ids(), "it may have waited for the others"
        return
    assert played.ids == all_ids()[1:]
    assert played.finished == []
    assert played.rejected == {"bad_stamp": 1}


@pytest.mark.parametrize("at_ns", [0, -5 * S, -(2**63)])
def test_a_first_keyframe_from_before_the_clock_was_set_costs_itself_alone(at_ns: int) -> None:
    parts = groups()
    parts[0] = stamped(parts[0], at_ns=at_ns)
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids()[1:], [])
    assert played.rejected == {"bad_stamp": 1}


@pytest.mark.parametrize("pause_ns", [9 * S, 15 * S, HOUR, YEAR])
def test_after_a_pause_the_map_goes_on(pause_ns: int) -> None:
    parts = groups()
    played = Played(joined([*parts[:8], *(stamped(part, pause_ns) for part in parts[8:])]))
    assert (played.ids, played.finished, dict(played.rejected)) == (all_ids(), [], {})
    assert not played.scene.log.warnings
    same = undisturbed().scene.keyframes
    assert played.scene.keyframes.position.tobytes() == same.position.tobytes(), "what is held does not change a replay"


def test_keyframes_that_are_always_far_apart_are_a_map() -> None:
    parts = groups()
    played = Played(joined(stamped(part, 60 * S * i) for i, part in enumerate(parts)))
    assert (played.ids, played.finished, dict(played.rejected)) == (all_ids(), [], {})


def test_two_clocks_by_turns_do_not_tear_the_map_to_pieces() -> None:
    parts = groups()
    played = Played(joined(part if i % 2 == 0 else stamped(part, -HOUR) for i, part in enumerate(parts)))
    assert played.finished == []
    assert played.ids == all_ids()[::2]
    assert played.rejected["bad_stamp"] == N // 2


@pytest.mark.parametrize("seed", range(6))
def test_two_clocks_mixed_at_random_give_few_sessions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = [stamped(part, -HOUR * int(rng.integers(2))) for part in groups()]
    played = Played(joined(parts))
    assert len(played.finished) <= 3, "each that is torn makes the next one harder"
    known = sum(len(estimate.trajectory) for _, estimate in played.finished) + len(played.ids)
    # A first keyframe that the others contradict was taken in before.
    assert known + len(played.refused) in (N - 1, N)


def test_a_keyframe_that_comes_late_by_less_than_the_bound_is_sorted_in() -> None:
    parts = groups()
    played = Played(joined([*parts[:4], *parts[5:9], parts[4], *parts[9:]]))
    assert (played.ids, played.finished, dict(played.rejected)) == (all_ids(), [], {})
    assert played.notices["reordered"] == 1


REPEATS: dict[str, Callable[[Keyframe], Keyframe]] = {
    "as it was": lambda k: k,
    "an hour later": lambda k: dataclasses.replace(k, stamp_ns=k.stamp_ns + HOUR),
    "an hour earlier": lambda k: dataclasses.replace(k, stamp_ns=k.stamp_ns - HOUR),
    "with stamp zero": lambda k: dataclasses.replace(k, stamp_ns=0),
}


@pytest.mark.parametrize("how", REPEATS)
@pytest.mark.parametrize("when", [4, 15])
@pytest.mark.parametrize("count", [1, 2])
def test_a_repeated_keyframe_changes_nothing(how: str, when: int, count: int) -> None:
    parts = [list(part) for part in groups()]
    for keyframe in data().keyframes[2 : 2 + count]:
        parts[when].append(REPEATS[how](keyframe))
    played = Played(joined(parts), settings={"scene.max_reorder_s": 1.0})
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.rejected == {"duplicate_keyframe": count}
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


def test_every_message_twice_changes_nothing() -> None:
    played = Played([m for m in messages() for _ in range(2)])
    assert (played.ids, played.finished) == (all_ids(), [])
    assert set(played.rejected) == {"duplicate_keyframe", "duplicate_observation"}
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.parametrize("times", [2, 3])
def test_a_recording_that_plays_again_begins_a_session_each_time(times: int) -> None:
    played = Played([m for _ in range(times) for m in messages()], settings={"scene.max_reorder_s": 1.0})
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [N] * (times - 1)
    assert played.ids == all_ids()
    assert not played.rejected
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()
    assert "plays again" in played.scene.log.warnings["clock_jump"]


def test_an_id_that_is_used_again_is_named_and_its_tracks_do_no_harm() -> None:
    parts = [list(part) for part in groups()]
    reused = all_ids()[3]
    others = [dataclasses.replace(t, keyframe_id=reused) for t in data().tracks[11]]
    parts[10] += [dataclasses.replace(data().keyframes[11], keyframe_id=reused), *others]
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.rejected["duplicate_keyframe"] == 1
    assert f"keyframe {reused} is known already, " in played.scene.log.warnings["reused_id"]
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.parametrize("shift_ns", [0, 20 * S])
def test_a_front_end_that_restarts_under_the_same_ids_is_not_refused_for_ever(shift_ns: int) -> None:
    """Its poses begin at another place, so these are other keyframes, whatever their stamps."""
    again = [
        dataclasses.replace(m, position=m.position + 5.0) if isinstance(m, Keyframe) else m
        for part in groups()
        for m in stamped(part, shift_ns)
    ]
    played = Played([*messages(), *again])
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [N]
    assert played.ids == all_ids()
    assert not played.rejected
    assert "has the id of another keyframe: a new session begins" in played.scene.log.warnings["reused_id"]


@pytest.mark.parametrize("back_ns", [3 * S, 4 * S + 1, 9 * S, 10 * S + 3 * S // 10])
def test_a_clock_that_is_set_back_by_less_than_the_bound_does_not_mix_two_maps(back_ns: int) -> None:
    """Keyframes are 0.25 s apart: the whole map spans less than the bound."""
    parts = groups()
    played = Played(joined([*parts[:12], *(stamped(part, -back_ns) for part in parts[12:])]))
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [12]
    assert played.ids == all_ids()[12:]
    assert not played.rejected


def test_a_block_of_keyframes_that_comes_late_is_sorted_in() -> None:
    parts = groups()
    played = Played(joined([*parts[:1], *parts[4:], *parts[1:4]]))
    assert (played.ids, played.finished, dict(played.rejected)) == (all_ids(), [], {})


def test_a_short_recording_that_plays_again_is_no_duplicate() -> None:
    """It spans less than scene.max_reorder_s."""
    played = Played([*messages(), *messages()])
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [N]
    assert played.ids == all_ids()
    assert not played.rejected


@pytest.mark.parametrize("count", [1, 4])
def test_keyframes_that_come_again_long_after_change_nothing(count: int) -> None:
    again = [m for part in groups()[:count] for m in part]
    played = Played([*messages(), *again])
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.rejected["duplicate_keyframe"] == count
    assert not played.scene.log.warnings


def test_several_that_are_turned_away_for_one_reason_are_counted_in_the_warning() -> None:
    parts = groups()
    parts[4], parts[9] = stamped(parts[4], at_ns=0), stamped(parts[9], at_ns=0)
    warning = Played(joined(parts)).scene.log.warnings["bad_stamp"]
    first, last = all_ids()[4], all_ids()[9]
    assert warning.startswith(f"keyframe {first} is")
    assert warning.endswith(f"turned away; likewise 1 more, the last of them keyframe {last}")


def test_stamps_that_are_all_the_same_are_said() -> None:
    played = Played(joined(stamped(part, at_ns=0) for part in groups()))
    assert played.ids == all_ids(), "in order of arrival"
    words = f"keyframe {all_ids()[1]} has the stamp of keyframe {all_ids()[0]}, 0.000 s"
    assert played.scene.log.warnings["equal_stamps"].startswith(words)


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


@pytest.mark.parametrize("session", [1, 2**32 - 1])
@pytest.mark.parametrize("what", USELESS)
def test_one_message_of_a_higher_session_does_not_end_the_map(what: str, session: int) -> None:
    parts = [list(part) for part in groups()]
    parts[6] += changed([USELESS[what]()], session_id=session)
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.rejected.total() == 1, played.rejected
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.parametrize("what", set(USELESS) - {"a keyframe without a pose", "a sound keyframe"})
def test_one_message_of_a_higher_session_does_not_open_the_first_one(what: str) -> None:
    stray = changed([USELESS[what]()], session_id=7)
    played = Played([data().rig, *stray, *messages()[1:]])
    assert (played.ids, played.scene.session_id) == (all_ids(), 0)
    assert played.rejected.total() == 1, played.rejected


def test_tracks_and_guesses_that_come_before_the_first_keyframe_of_their_session_are_used() -> None:
    first, *others = groups()
    backwards = joined([first[::-1], *others])
    for stream in (backwards, [*messages(), *changed(backwards[1:], session_id=4)]):
        played = Played(stream)
        assert played.ids == all_ids()
        assert not played.rejected
        assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


def test_what_waits_for_a_session_is_bounded() -> None:
    ahead = changed([t for both in data().tracks for t in both], session_id=9)
    played = Played([*messages(), *ahead], final=False, settings={"scene.max_pending": 10})
    assert played.rejected["unknown_keyframe"] == len(ahead) - 10
    played.flush(final=True)
    assert played.rejected["unknown_keyframe"] == len(ahead)
    assert "of session 9, which no keyframe began" in played.rejection_notes[-1]


@pytest.mark.parametrize("session", [3, 0])
def test_a_front_end_that_restarts_with_a_lower_session_is_not_refused_for_ever(session: int) -> None:
    last, again = changed(messages(), session_id=2**32 - 1), changed(messages()[1:], session_id=session)
    played = Played([*last, *again])
    assert [key for key, _ in played.finished] == [2**32 - 1]
    assert played.scene.session_id == session
    assert played.ids == all_ids()[2:], "two were turned away before it was clear"
    warning = played.scene.log.warnings["lower_session"]
    assert f"3 keyframes in a row are of session {session}, below the current 4294967295" in warning


def test_messages_of_a_session_before_are_refused_while_the_current_goes_on() -> None:
    old, new = groups(), [changed(part, session_id=5) for part in groups()]
    played = Played(joined([*new[:6], old[3], new[6], old[4], old[5], *new[7:]]))
    assert (played.ids, played.finished, played.scene.session_id) == (all_ids(), [], 5)
    assert set(played.rejected) == {"stale_session"}


@pytest.mark.parametrize("frame", ["map", "/map", "odom2"])
def test_a_keyframe_in_another_frame_is_turned_away(frame: str) -> None:
    parts = groups()
    parts[5] = changed(parts[5], frame_id=frame)
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids()[:5] + all_ids()[6:], [])
    assert played.rejected == {"frame_changed": 1, "unknown_keyframe": 2}
    assert f"is in frame '{frame.lstrip('/')}', those before in 'odom'" in played.scene.log.warnings["frame_changed"]


def test_a_frame_that_changes_for_good_begins_a_session() -> None:
    parts = groups()
    played = Played(joined([*parts[:8], *(changed(part, frame_id="map") for part in parts[8:])]))
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [8]
    assert (played.ids, played.scene.frame_id) == (all_ids()[8:], "map")
    assert not played.rejected


@pytest.mark.parametrize(
    ("frame", "words"), [("/odom", "taken as 'odom': leave out"), ("", "names no frame"), ("//", "no")]
)
def test_a_frame_without_a_name_for_tf2_is_said(frame: str, words: str) -> None:
    played = Played(changed(messages(), frame_id=frame))
    assert played.ids == all_ids()
    assert words in played.scene.log.warnings["frame_name"]
    assert played.notices["frame_name"] == N
    correction = played.estimate().correction
    assert correction is not None
    assert correction.odom_frame == "odom"


def test_frames_that_are_named_with_and_without_a_slash_are_one() -> None:
    parts = [changed(part, frame_id=("odom", "/odom", "")[i % 3]) for i, part in enumerate(groups())]
    played = Played(joined(parts))
    assert (played.ids, played.finished, dict(played.rejected)) == (all_ids(), [], {})


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


def test_silence_begins_a_session_where_the_first_keyframe_comes_again_with_its_tracks() -> None:
    near = {"scene.max_reorder_s": 1.0}
    for again, begins in ((groups()[0], True), (groups()[0][:1], False), (groups()[1], False)):
        played = Played([*messages(), *again], final=False, settings=near)
        played.flush()
        assert len(played.scene.keyframes) == (1 if begins else N)
        assert not played.rejected


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
