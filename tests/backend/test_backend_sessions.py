# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What begins a session and what does not: stamps, repeated keyframes and ids."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ba_node.measurements import Keyframe, Measurement
from tests.backend.session_streams import (
    HOUR,
    YEAR,
    N,
    Played,
    S,
    all_ids,
    data,
    groups,
    joined,
    messages,
    stamped,
    undisturbed,
)


@pytest.mark.parametrize("first", ["keyframe first", "tracks first"])
def test_a_clock_that_is_set_back_begins_a_session_with_nothing_lost(first: str) -> None:
    parts = groups()
    if first == "tracks first":
        parts = [part[::-1] for part in parts]
    played = Played(joined([*parts[:8], *(stamped(part, -HOUR) for part in parts[8:])]))
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [8]
    assert played.ids == all_ids()[8:]
    assert not played.map.rejected
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


@pytest.mark.slow
@pytest.mark.parametrize("at", [1, 7, N - 1])
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
    assert played.map.rejected == {"bad_stamp": 1, "unknown_keyframe": 2}
    assert f"keyframe {all_ids()[at]} is" in played.scene.log.warnings["bad_stamp"]
    before, after = played.errors_m
    assert after < 0.6 * before, f"{before:.4f} -> {after:.4f} m"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(ABSURD) - {"12 s ahead", "zero", "negative", "the least"}))
def test_a_first_keyframe_with_an_absurd_stamp_costs_itself_alone(name: str) -> None:
    parts = groups()
    parts[0] = ABSURD[name](parts[0])
    played = Played(joined(parts))
    if "behind" in name:
        assert played.ids == all_ids(), "it may have waited for the others"
        return
    assert played.ids == all_ids()[1:]
    assert played.finished == []
    assert played.map.rejected == {"bad_stamp": 1}


@pytest.mark.slow
@pytest.mark.parametrize("at_ns", [0, -5 * S, -(2**63)])
def test_a_first_keyframe_from_before_the_clock_was_set_costs_itself_alone(at_ns: int) -> None:
    parts = groups()
    parts[0] = stamped(parts[0], at_ns=at_ns)
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids()[1:], [])
    assert played.map.rejected == {"bad_stamp": 1}


@pytest.mark.slow
@pytest.mark.parametrize("pause_ns", [9 * S, 15 * S, HOUR, YEAR])
def test_after_a_pause_the_map_goes_on(pause_ns: int) -> None:
    parts = groups()
    played = Played(joined([*parts[:8], *(stamped(part, pause_ns) for part in parts[8:])]))
    assert (played.ids, played.finished, dict(played.map.rejected)) == (all_ids(), [], {})
    assert not played.scene.log.warnings
    same = undisturbed().scene.keyframes
    assert played.scene.keyframes.position.tobytes() == same.position.tobytes(), "what is held does not change a replay"


@pytest.mark.slow
def test_keyframes_that_are_always_far_apart_are_a_map() -> None:
    parts = groups()
    played = Played(joined(stamped(part, 60 * S * i) for i, part in enumerate(parts)))
    assert (played.ids, played.finished, dict(played.map.rejected)) == (all_ids(), [], {})


def test_two_clocks_by_turns_do_not_tear_the_map_to_pieces() -> None:
    parts = groups()
    played = Played(joined(part if i % 2 == 0 else stamped(part, -HOUR) for i, part in enumerate(parts)))
    assert played.finished == []
    assert played.ids == all_ids()[::2]
    assert played.map.rejected["bad_stamp"] == N // 2


@pytest.mark.parametrize("seed", range(6))
def test_two_clocks_mixed_at_random_give_few_sessions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = [stamped(part, -HOUR * int(rng.integers(2))) for part in groups()]
    played = Played(joined(parts))
    assert len(played.finished) <= 3, "each that is torn makes the next one harder"
    known = sum(len(estimate.trajectory) for _, estimate in played.finished) + len(played.ids)
    # A first keyframe that the others contradict was taken in before.
    assert known + len(played.refused) in (N - 1, N)


@pytest.mark.slow
def test_a_keyframe_that_comes_late_by_less_than_the_bound_is_sorted_in() -> None:
    parts = groups()
    played = Played(joined([*parts[:4], *parts[5:9], parts[4], *parts[9:]]))
    assert (played.ids, played.finished, dict(played.map.rejected)) == (all_ids(), [], {})
    assert played.scene.log.notices["reordered"] == 1


REPEATS: dict[str, Callable[[Keyframe], Keyframe]] = {
    "as it was": lambda k: k,
    "an hour later": lambda k: dataclasses.replace(k, stamp_ns=k.stamp_ns + HOUR),
    "an hour earlier": lambda k: dataclasses.replace(k, stamp_ns=k.stamp_ns - HOUR),
    "with stamp zero": lambda k: dataclasses.replace(k, stamp_ns=0),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", REPEATS)
@pytest.mark.parametrize("when", [4, 15])
@pytest.mark.parametrize("count", [1, 2])
def test_a_repeated_keyframe_changes_nothing(how: str, when: int, count: int) -> None:
    parts = [list(part) for part in groups()]
    for keyframe in data().keyframes[2 : 2 + count]:
        parts[when].append(REPEATS[how](keyframe))
    played = Played(joined(parts), settings={"scene.max_reorder_s": 1.0})
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.map.rejected == {"duplicate_keyframe": count}
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.slow
def test_every_message_twice_changes_nothing() -> None:
    played = Played([m for m in messages() for _ in range(2)])
    assert (played.ids, played.finished) == (all_ids(), [])
    assert set(played.map.rejected) == {"duplicate_keyframe", "duplicate_observation"}
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("times", [2, 3])
def test_a_recording_that_plays_again_begins_a_session_each_time(times: int) -> None:
    played = Played([m for _ in range(times) for m in messages()], settings={"scene.max_reorder_s": 1.0})
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [N] * (times - 1)
    assert played.ids == all_ids()
    assert not played.map.rejected
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()
    assert "plays again" in played.scene.log.warnings["clock_jump"]


@pytest.mark.slow
def test_an_id_that_is_used_again_is_named_and_its_tracks_do_no_harm() -> None:
    parts = [list(part) for part in groups()]
    reused = all_ids()[3]
    others = [dataclasses.replace(t, keyframe_id=reused) for t in data().tracks[11]]
    parts[10] += [dataclasses.replace(data().keyframes[11], keyframe_id=reused), *others]
    played = Played(joined(parts))
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.map.rejected["duplicate_keyframe"] == 1
    assert f"keyframe {reused} is known already, " in played.scene.log.warnings["reused_id"]
    assert played.scene.keyframes.position.tobytes() == undisturbed().scene.keyframes.position.tobytes()


@pytest.mark.slow
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
    assert not played.map.rejected
    assert "has the id of another keyframe: a new session begins" in played.scene.log.warnings["reused_id"]


@pytest.mark.parametrize("back_ns", [3 * S, 4 * S + 1, 9 * S, 10 * S + 3 * S // 10])
def test_a_clock_that_is_set_back_by_less_than_the_bound_does_not_mix_two_maps(back_ns: int) -> None:
    """Keyframes are 0.25 s apart: the whole map spans less than the bound."""
    parts = groups()
    played = Played(joined([*parts[:12], *(stamped(part, -back_ns) for part in parts[12:])]))
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [12]
    assert played.ids == all_ids()[12:]
    assert not played.map.rejected


@pytest.mark.slow
def test_a_block_of_keyframes_that_comes_late_is_sorted_in() -> None:
    parts = groups()
    played = Played(joined([*parts[:1], *parts[4:], *parts[1:4]]))
    assert (played.ids, played.finished, dict(played.map.rejected)) == (all_ids(), [], {})


@pytest.mark.slow
def test_a_short_recording_that_plays_again_is_no_duplicate() -> None:
    """It spans less than scene.max_reorder_s."""
    played = Played([*messages(), *messages()])
    assert [len(estimate.trajectory) for _, estimate in played.finished] == [N]
    assert played.ids == all_ids()
    assert not played.map.rejected


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4])
def test_keyframes_that_come_again_long_after_change_nothing(count: int) -> None:
    again = [m for part in groups()[:count] for m in part]
    played = Played([*messages(), *again])
    assert (played.ids, played.finished) == (all_ids(), [])
    assert played.map.rejected["duplicate_keyframe"] == count
    assert not played.scene.log.warnings


def test_several_that_are_turned_away_for_one_reason_are_counted_in_the_warning() -> None:
    parts = groups()
    parts[4], parts[9] = stamped(parts[4], at_ns=0), stamped(parts[9], at_ns=0)
    warning = Played(joined(parts)).scene.log.warnings["bad_stamp"]
    first, last = all_ids()[4], all_ids()[9]
    assert warning.startswith(f"keyframe {first} is")
    assert warning.endswith(f"turned away; likewise 1 more, the last of them keyframe {last}")


@pytest.mark.slow
def test_stamps_that_are_all_the_same_are_said() -> None:
    played = Played(joined(stamped(part, at_ns=0) for part in groups()))
    assert played.ids == all_ids(), "in order of arrival"
    words = f"keyframe {all_ids()[1]} has the stamp of keyframe {all_ids()[0]}, 0.000 s"
    assert played.scene.log.warnings["equal_stamps"].startswith(words)
