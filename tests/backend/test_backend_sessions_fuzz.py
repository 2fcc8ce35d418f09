# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions in random disorder: nothing raises, what is known stays known, one map for each real session.

A recording has up to three real sessions (a raised id, a clock set back, a restart with a lower id). Of its messages
some are repeated, moved by a few places, lost, or spoiled one by one; between two that are spoiled stand enough that
are sound.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from tests.backend.session_streams import Remembering

LENGTH = 12
S = 10**9
# Sound keyframes between two that are spoiled: as many as outvote one.
APART = 4
SETTINGS = {"solver.max_iterations": 1, "window.max_keyframes": 2, "scene.max_pending": 60}
Group = list[Any]


@functools.cache
def data() -> SyntheticData:
    options = SyntheticOptions(
        keyframes=LENGTH, landmarks=200, tracks=12, length_m=12.0, path="line", ids="random64", seed=5, guesses=True
    )
    return generate(options)


def session(session_id: int, begin_ns: int, first_id: int) -> list[Group]:
    """Return the messages of each keyframe of a real session, the keyframe first."""
    groups = []
    rows = zip(data().keyframes, data().tracks, data().guesses, strict=True)
    for k, (keyframe, tracks, guess) in enumerate(rows):
        key = first_id + k
        moved = dataclasses.replace(keyframe, session_id=session_id, keyframe_id=key, stamp_ns=begin_ns + k * S // 4)
        images = [dataclasses.replace(image, session_id=session_id, keyframe_id=key) for image in tracks]
        guesses = [dataclasses.replace(guess, session_id=session_id)] if guess else []
        groups.append([moved, *guesses, *images])
    return groups


BEGINNINGS = ("raised", "back", "lower")


@st.composite
def recordings(draw: st.DrawFn) -> tuple[list[Measurement], list[int], int]:
    """Draw a stream, the keyframes of each real session, and how many messages were spoiled."""
    session_id, begin_ns = draw(st.sampled_from([0, 7, 2**32 - 2])), draw(st.sampled_from([0, 10**18]))
    kinds = [BEGINNINGS[0], *draw(st.lists(st.sampled_from(BEGINNINGS), max_size=2))]
    out: list[Measurement] = [data().rig]
    spoiled = 0
    for number, kind in enumerate(kinds):
        if number and kind == "raised" and session_id < 2**32 - 1:
            session_id, begin_ns = min(session_id + draw(st.integers(1, 3)), 2**32 - 1), begin_ns + 20 * S
        elif number and kind == "lower" and session_id > 0:
            session_id, begin_ns = draw(st.integers(0, session_id - 1)), begin_ns + 20 * S
        elif number:
            begin_ns -= draw(st.sampled_from([15 * S, 3600 * S, 10**17]))
        groups = session(session_id, begin_ns, 1000 * number)
        spoiled += disturb(draw, groups)
        out += [m for group in groups for m in group]
    return out, [LENGTH] * len(kinds), spoiled


def disturb(draw: st.DrawFn, groups: list[Group]) -> int:
    """Spoil some keyframes, repeat and reorder messages within a keyframe; return how many keyframes were spoiled."""
    count = 0
    for k in range(APART, LENGTH - APART, APART):
        what = draw(st.sampled_from(["nothing", "stamp", "session", "frame", "pose"]))
        groups[k][0] = spoil(draw, what, groups[k][0])
        count += what != "nothing"
    for k, group in enumerate(groups):
        if draw(st.integers(0, 3)) == 0:
            head = group[:1] if k == 0 else []
            group[:] = head + draw(st.permutations(group[len(head) :]))
        if draw(st.integers(0, 5)) == 0:
            group.append(draw(st.sampled_from(group)))
        if draw(st.integers(0, 7)) == 0 and k > APART:
            group.append(useless(draw, group[-1].session_id))
    return count


def spoil(draw: st.DrawFn, what: str, keyframe: Keyframe) -> Keyframe:
    if what == "stamp":
        absurd = st.sampled_from([-(2**63), -S, -3600 * S, 3600 * S, 10**17, 2**62])
        return dataclasses.replace(keyframe, stamp_ns=min(max(keyframe.stamp_ns + draw(absurd), -(2**63)), 2**63 - 1))
    if what == "session":
        return dataclasses.replace(keyframe, session_id=draw(st.sampled_from([0, 1, 2**31, 2**32 - 1])))
    if what == "frame":
        return dataclasses.replace(keyframe, frame_id="elsewhere")
    if what == "pose":
        return dataclasses.replace(keyframe, orientation=np.full(4, np.nan))
    return keyframe


def useless(draw: st.DrawFn, session_id: int) -> Measurement:
    """Return a message that says nothing, of the session or one after it."""
    at = draw(st.sampled_from([session_id, 2**32 - 1]))
    none = np.empty(0, np.uint64)
    if draw(st.booleans()):
        return LandmarkGuesses(at, none, np.empty((0, 3)))
    return FeatureTracks(at, 77, 0, none, np.empty((0, 2)))


@pytest.mark.slow
@settings(max_examples=60, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(recordings())
def test_there_is_one_map_for_each_real_session(drawn: tuple[list[Measurement], list[int], int]) -> None:
    stream, lengths, spoiled = drawn
    backend = Remembering(SETTINGS)
    for measurement in stream:
        known, scene = len(backend.scene.keyframes), backend.scene
        backend.add(measurement)
        assert backend.scene is not scene or len(scene.keyframes) >= known
        assert len(backend.scene.pending) + len(backend._sessions.state.waiting) <= 2 * 60
    backend.flush(final=True)
    assert backend.held == []
    found = [len(estimate.trajectory) for _, estimate in backend.finished] + [len(backend.scene.keyframes)]
    assert len(found) == len(lengths), f"{found}, of {lengths}"
    # Two of a session with a lower id are turned away before it is clear.
    lost = sum(lengths) - sum(found)
    assert 0 <= lost <= spoiled + 2 * len(lengths), f"{found}, of {lengths}, {spoiled} spoiled"


@pytest.mark.slow
@settings(max_examples=60, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.data())
def test_no_order_raises_and_every_keyframe_is_accounted_for(source: st.DataObject) -> None:
    stream, _, _ = source.draw(recordings())
    rng = np.random.default_rng(source.draw(st.integers(0, 2**32 - 1)))
    mixed = [stream[i] for i in rng.permutation(len(stream))]
    backend = Backend(Config().with_values({**SETTINGS, "window.max_keyframes": 3}))
    taken = refused = 0
    for measurement in [*mixed, None]:
        admitted = backend.admit_rest() if measurement is None else backend.admit(measurement)
        for one in admitted:
            if backend.completes(one):
                assert backend.solve() is not None
            before = len(backend.refused)
            backend.take(one)
            taken += isinstance(one.measurement, Keyframe) and len(backend.refused) == before
        refused += len(backend.refused)
        backend.refused.clear()
        assert np.isfinite(backend.scene.keyframes.position).all()
    n = sum(isinstance(m, Keyframe) for m in mixed)
    assert taken + refused == n, f"{taken} taken, {refused} refused of {n}"
