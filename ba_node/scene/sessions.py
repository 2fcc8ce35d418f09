# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Decide which session a message belongs to: the current one, a new one, or none.

A keyframe that does not go on where the current session is (``Kind``) is held until others tell what it was. As many as
``_NEEDED`` in a row confirm each other, and what was held is taken in. ``_AGAINST`` keyframes that go on as before
outvote it, and it is turned away by name. So one absurd stamp costs its keyframe alone, and a clock that was set
back costs nothing. Each time that this ended badly the next one needs one more, so that two front-ends with clocks of
their own do not tear the map to pieces.

Tracks and guesses never begin a session; before the first keyframe of theirs they wait.

Nothing here changes the scene: :meth:`Sessions.decide` is a function of what came before, :meth:`Sessions.commit`
remembers a decision.
"""

from __future__ import annotations

import dataclasses

from ba_node.arrays import changed
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement, OfSession, OfTime
from ba_node.scene import ingest
from ba_node.scene.candidates import (
    NS,
    Admitted,
    Begin,
    Candidate,
    Decision,
    Kind,
    State,
    agree,
    begin_of,
    dropped,
    is_lone,
    late_s,
    never_began,
    newest_ns,
    same_pose,
    unusual_s,
)
from ba_node.scene.rejections import Refusal
from ba_node.scene.scene import Scene

# Keyframes in a row that confirm each other. Messages come twice, late, or under a wrong id now and then, which is no
# jump: these take more.
_NEEDED = {Kind.REPEAT: 5, Kind.REUSED: 3, Kind.LATE: 3}
_NEEDED_ELSE = 2
# Keyframes of the current session that outvote what is held.
_AGAINST = 3
# Keyframes of a lower session, none of the current among them, that begin it.
_LOWER_NEEDED = 3
# The most that distrust adds to what is needed, and the keyframes that take one off it.
_MAX_DISTRUST = 3
_CALM = 20
# A last keyframe this far ahead is a pause, beyond it a wrong stamp.
_PAUSE_S = 1800.0
# A first keyframe this far off the others has a wrong stamp.
_ABSURD_S = 86_400.0


class Sessions:
    """The decisions of one back-end."""

    def __init__(self) -> None:
        self.state = State()
        self._loaded: set[int] = set()

    @property
    def held(self) -> list[Keyframe]:
        """Return the keyframes that are held."""
        return self.state.candidate.keyframes if self.state.candidate else []

    def reset(self, loaded: set[int] | None = None) -> None:
        """Forget what is held; keyframes ``loaded`` from a file may come again without a recording beginning anew."""
        self.state = State()
        self._loaded = loaded or set()

    def commit(self, measurement: Measurement | None, decision: Decision) -> None:
        """Remember a decision."""
        self.state = decision.state
        if isinstance(measurement, Keyframe):
            self._loaded.discard(measurement.keyframe_id)

    def decide(self, scene: Scene, measurement: Measurement) -> Decision:
        """Return what becomes of a measurement."""
        if isinstance(measurement, CameraRig | OfTime):
            return Decision(self.state, (Admitted(measurement),))
        if isinstance(measurement, Keyframe):
            return self._keyframe(scene, measurement)
        if not len(scene.keyframes) or measurement.session_id > (scene.session_id or 0):
            return self._wait(scene, measurement)
        return self._of_current(scene, measurement)

    def end(self, scene: Scene) -> Decision:
        """Return what becomes of all that is held when nothing more comes: a pause at the end is taken for one."""
        state, candidate = self.state, self.state.candidate
        refused = tuple(never_began(item) for item in state.waiting)
        rest = Decision(dataclasses.replace(state, candidate=None, waiting=()), (), refused)
        if candidate is None:
            return rest
        gap_s = (candidate.keyframes[0].stamp_ns - newest_ns(scene)) * NS
        if candidate.kind is Kind.FORWARD and not candidate.against and gap_s <= _PAUSE_S:
            return rest.also(admitted=tuple(Admitted(item) for item in candidate.items))
        return dropped(candidate, rest)

    def settle(self, scene: Scene) -> Decision:
        """Return what becomes of what is held in a silence.

        A higher session id is taken at its word, and so is a first keyframe that comes again with all its tracks: who
        sends it may wait for an answer.
        """
        candidate = self.state.candidate
        if candidate is not None and (candidate.kind is Kind.HIGHER or _plays_again(scene, candidate)):
            return self._opened(scene, candidate)
        return Decision(self.state)

    def _keyframe(self, scene: Scene, keyframe: Keyframe) -> Decision:
        if not scene.usable(keyframe):
            return Decision(self.state, (Admitted(keyframe),))
        current = scene.session_id
        if not len(scene.keyframes):
            first = current is None or keyframe.session_id == current
            return self._begun(keyframe.session_id, (Admitted(keyframe, None if first else Begin()),))
        assert current is not None
        if keyframe.session_id > current:
            text = f"keyframe {keyframe.keyframe_id} is of session {keyframe.session_id}, the current is {current}"
            return self._support(scene, Kind.HIGHER, keyframe, text)
        if keyframe.session_id < current:
            return self._lower(scene, keyframe)
        odd = self._odd(scene, keyframe)
        if odd is not None:
            return self._support(scene, *odd)
        if scene.find_keyframe(keyframe.keyframe_id) is not None:
            return Decision(self.state, (Admitted(keyframe),))
        return self._against(keyframe)

    def _odd(self, scene: Scene, keyframe: Keyframe) -> tuple[Kind, Keyframe, str] | None:
        """Return how a keyframe of the current session does not go on where it is, None if it does."""
        name, frame = f"keyframe {keyframe.keyframe_id}", ingest.plain_name(keyframe.frame_id)
        limit_s, ahead_s = scene.config.max_reorder_s, (keyframe.stamp_ns - newest_ns(scene)) * NS
        is_back = 0.0 < limit_s < -ahead_s
        back = f"{name} is {-ahead_s:.1f} s older than the newest (scene.max_reorder_s = {limit_s:g})"
        row = scene.find_keyframe(keyframe.keyframe_id)
        if row is not None and same_pose(scene, row, keyframe):
            is_new = keyframe.keyframe_id not in self._loaded
            return (Kind.REPEAT, keyframe, back) if is_new and (is_back or -ahead_s > late_s(scene)) else None
        if frame and scene.frame_id and frame != scene.frame_id:
            text = f"{name} is in frame {frame!r}, those before in {scene.frame_id!r}"
            return Kind.FRAME, keyframe, text
        if row is None and ahead_s < 0.0 and self._goes_on(scene, keyframe):
            assert self.state.candidate is not None
            return self.state.candidate.kind, keyframe, back
        if is_back:
            return Kind.BACK, keyframe, back
        if row is not None:
            return Kind.REUSED, keyframe, f"{name} has the id of another keyframe"
        if ahead_s < 0.0 and -ahead_s > late_s(scene):
            return Kind.LATE, keyframe, back
        if limit_s < ahead_s and 0.0 < unusual_s(scene) < ahead_s:
            text = f"{name} is {ahead_s:.1f} s newer than the newest (scene.max_reorder_s = {limit_s:g})"
            return Kind.FORWARD, keyframe, text
        return None

    def _goes_on(self, scene: Scene, keyframe: Keyframe) -> bool:
        """Return True if a keyframe comes right after one that is held because it lies before the newest."""
        candidate = self.state.candidate
        if candidate is None or candidate.kind not in (Kind.BACK, Kind.LATE) or not candidate.run:
            return False
        return 0.0 < (keyframe.stamp_ns - candidate.last.stamp_ns) * NS <= unusual_s(scene)

    def _support(self, scene: Scene, kind: Kind, keyframe: Keyframe, text: str) -> Decision:
        """Hold a keyframe, and let it confirm what is held already if it agrees with that."""
        state, candidate = self.state, self.state.candidate
        if candidate is not None and candidate.kind is kind and candidate.holds(keyframe):
            refusal = Refusal(keyframe, "duplicate_keyframe", f"keyframe {keyframe.keyframe_id} is held already")
            return Decision(state, (), (refusal,))
        if candidate is None or kind is not candidate.kind or not agree(scene, candidate, keyframe):
            new = Candidate(kind, (keyframe,), text)
            held = Decision(dataclasses.replace(state, candidate=new, lower=(-1, 0)))
            return held if candidate is None else dropped(candidate, held)
        more = dataclasses.replace(candidate, items=(*candidate.items, keyframe), run=candidate.run + 1)
        if more.run < _NEEDED.get(kind, _NEEDED_ELSE) + state.distrust:
            return Decision(dataclasses.replace(state, candidate=more))
        if kind is Kind.FORWARD and not is_lone(scene, more, _ABSURD_S):
            calm = dataclasses.replace(state, candidate=None)
            return Decision(calm, tuple(Admitted(item) for item in more.items))
        return self._opened(scene, more)

    def _opened(self, scene: Scene, candidate: Candidate) -> Decision:
        """Begin the session of what is held."""
        first, *others = candidate.items
        assert isinstance(first, Keyframe)
        asked = candidate.kind is Kind.HIGHER
        begin = Begin() if asked else begin_of(scene, candidate)
        admitted = (Admitted(first, begin), *(Admitted(item) for item in others))
        return self._begun(first.session_id, admitted, distrust=0 if asked else 1)

    def _begun(self, session_id: int, admitted: tuple[Admitted, ...], distrust: int = 0) -> Decision:
        """Return the decision that begins a session, with the tracks and guesses that came before its keyframe."""
        state = self.state
        mine = tuple(Admitted(item) for item in state.waiting if item.session_id <= session_id)
        after = dataclasses.replace(
            state,
            candidate=None,
            waiting=tuple(item for item in state.waiting if item.session_id > session_id),
            lower=(-1, 0),
            distrust=_more(state.distrust, distrust),
            calm=0,
        )
        begun = Decision(after, (admitted[0], *mine, *admitted[1:]))
        candidate = state.candidate
        is_other = candidate is not None and candidate.items[0] is not admitted[0].measurement
        return dropped(candidate, begun) if candidate is not None and is_other else begun

    def _lower(self, scene: Scene, keyframe: Keyframe) -> Decision:
        """Refuse a keyframe of a session before the current one, unless nothing else comes any more."""
        session, count = self.state.lower
        count = count + 1 if session == keyframe.session_id else 1
        if count < _LOWER_NEEDED + self.state.distrust:
            state = dataclasses.replace(self.state, lower=(keyframe.session_id, count))
            return Decision(state, (Admitted(keyframe),))
        text = (
            f"{count} keyframes in a row are of session {keyframe.session_id}, below the current {scene.session_id}:"
            f" a new session begins with keyframe {keyframe.keyframe_id}; raise session_id when the front-end restarts"
        )
        begin = Begin("lower_session", text, replaces=len(scene.keyframes) == 1)
        return self._begun(keyframe.session_id, (Admitted(keyframe, begin),), distrust=1)

    def _against(self, keyframe: Keyframe) -> Decision:
        """Take in a keyframe that goes on as before: it speaks against what is held."""
        state = changed(self.state, lower=(-1, 0), calm=self.state.calm + 1)
        if state.calm >= _CALM:
            state = dataclasses.replace(state, distrust=max(0, state.distrust - 1), calm=0)
        candidate = state.candidate
        if candidate is None:
            return Decision(state, (Admitted(keyframe),))
        doubted = dataclasses.replace(candidate, run=0, against=candidate.against + 1)
        if doubted.against < _AGAINST:
            return Decision(dataclasses.replace(state, candidate=doubted), (Admitted(keyframe),))
        worse = _more(state.distrust) if doubted.is_error and len(doubted.keyframes) > 1 else state.distrust
        given_up = Decision(dataclasses.replace(state, candidate=None, distrust=worse), (Admitted(keyframe),))
        return dropped(doubted, given_up)

    def _wait(self, scene: Scene, item: OfSession) -> Decision:
        """Let tracks and guesses wait for the first keyframe of their session."""
        waiting, n = (*self.state.waiting, item), scene.config.max_pending
        refused = tuple(never_began(one) for one in waiting[:-n])
        return Decision(dataclasses.replace(self.state, waiting=waiting[-n:]), (), refused)

    def _of_current(self, scene: Scene, item: OfSession) -> Decision:
        """Take in tracks and guesses, but hold those that belong to a keyframe that is held under a known id."""
        candidate = self.state.candidate
        taken = Decision(self.state, (Admitted(item),))
        if candidate is None or candidate.kind is Kind.HIGHER or item.session_id != scene.session_id:
            return taken
        is_guess = not isinstance(item, FeatureTracks)
        theirs = _is_theirs(scene, candidate, item) if isinstance(item, FeatureTracks) else bool(candidate.run)
        if not theirs or len(candidate.items) >= scene.config.max_pending:
            return taken
        held = dataclasses.replace(candidate, items=(*candidate.items, item))
        # A guess serves whichever session its points are seen in.
        return Decision(dataclasses.replace(self.state, candidate=held), (Admitted(item),) if is_guess else ())


def _more(distrust: int, by: int = 1) -> int:
    return min(_MAX_DISTRUST, distrust + by)


def _is_theirs(scene: Scene, candidate: Candidate, tracks: FeatureTracks) -> bool:
    """Return True for tracks that name a keyframe of the scene, but belong to one that is held under its id."""
    if scene.find_keyframe(tracks.keyframe_id) is None:
        return False
    return candidate.holds(tracks) or (candidate.kind in (Kind.REPEAT, Kind.REUSED) and candidate.run > 0)


def _plays_again(scene: Scene, candidate: Candidate) -> bool:
    """Return True if the oldest keyframe of the scene is held, with tracks of every camera that saw something in it."""
    row = scene.find_keyframe(candidate.keyframes[0].keyframe_id)
    if candidate.kind is not Kind.REPEAT or row is None or row != scene.order[0]:
        return False
    again = {item.camera_index for item in candidate.items if isinstance(item, FeatureTracks)}
    return bool(again) and again >= scene.cameras_of(row)
