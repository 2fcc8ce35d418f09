# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What ``sessions.py`` holds and decides: why a keyframe is held, what is held, what becomes of a message."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from ba_node.core import geometry
from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses, Measurement, OfSession
from ba_node.scene.ingest import plain_name
from ba_node.scene.rejections import Refusal, RejectionLog
from ba_node.scene.scene import Scene

NS = 1e-9
# A gap is usual if it is this many times the median of the last few.
_USUAL = 10
_RECENT = 9


class Kind(enum.Enum):
    """Why a keyframe does not go on where the current session is."""

    BACK = "its stamp lies far before the newest"
    FORWARD = "its stamp lies far after the newest"
    REPEAT = "it is known, and lies far before the newest"
    REUSED = "its id is that of another keyframe"
    LATE = "its stamp lies before the newest, by less than what begins a session"
    FRAME = "its pose is in another frame"
    HIGHER = "its session is higher"


# Reason in REASONS where it is turned away. The others go to the scene, which knows what to do with one alone.
_REASON = {
    Kind.BACK: "bad_stamp",
    Kind.FORWARD: "bad_stamp",
    Kind.FRAME: "frame_changed",
    Kind.HIGHER: "stray_session",
}


@dataclass(frozen=True)
class Begin:
    """A session begins."""

    kind: str = ""  # of the warning, from ``WARNINGS``; empty where the front-end asked for it with a higher session id
    text: str = ""  # of the warning
    replaces: bool = False  # the session before was one keyframe with an absurd stamp, and counts for nothing


@dataclass(frozen=True)
class Admitted:
    """A measurement to be taken in now, perhaps as the first of a session."""

    measurement: Measurement
    begins: Begin | None = None

    def is_new(self, scene: Scene) -> bool:
        """Return True if a keyframe (or a session) begins with it."""
        one = self.measurement
        if not isinstance(one, Keyframe) or self.begins is not None:
            return self.begins is not None
        return scene.session_id in (None, one.session_id) and scene.find_keyframe(one.keyframe_id) is None


@dataclass(frozen=True)
class Candidate:
    """What is held."""

    kind: Kind  # what it is
    items: tuple[Measurement, ...]  # keyframes in order, and tracks and guesses that would be lost otherwise
    text: str  # what is odd about the first keyframe
    run: int = 1  # keyframes in a row that agree
    against: int = 0  # keyframes that went on as before

    @property
    def is_error(self) -> bool:
        """Return True if something is wrong with it, unless others confirm it."""
        return self.kind in _REASON

    @property
    def keyframes(self) -> list[Keyframe]:
        """Return the keyframes, oldest first."""
        return [item for item in self.items if isinstance(item, Keyframe)]

    @property
    def last(self) -> Keyframe:
        """Return the newest keyframe."""
        return self.keyframes[-1]

    def holds(self, item: Keyframe | FeatureTracks) -> bool:
        """Return True if a keyframe of the same id and session is held."""
        wanted = (item.session_id, item.keyframe_id)
        return any((keyframe.session_id, keyframe.keyframe_id) == wanted for keyframe in self.keyframes)


@dataclass(frozen=True)
class State:
    """What is remembered between messages."""

    candidate: Candidate | None = None  # what is held
    # tracks and guesses of sessions that no keyframe has begun
    waiting: tuple[OfSession, ...] = ()
    # session and number of the keyframes in a row that are of a session before the current one
    lower: tuple[int, int] = (-1, 0)
    distrust: int = 0  # added to what is needed
    calm: int = 0  # keyframes that went on as before, since distrust changed


@dataclass(frozen=True)
class Decision:
    """What becomes of a measurement: what is to be taken in now, what is turned away, what is remembered."""

    state: State
    admitted: tuple[Admitted, ...] = ()
    refused: tuple[Refusal, ...] = ()

    def also(self, *, admitted: tuple[Admitted, ...] = (), refused: tuple[Refusal, ...] = ()) -> Decision:
        """Return it with more before what there is."""
        return Decision(self.state, admitted + self.admitted, refused + self.refused)


def agree(scene: Scene, candidate: Candidate, keyframe: Keyframe) -> bool:
    """Return True if a keyframe goes on where the last that is held is."""
    last = candidate.last
    if candidate.kind is Kind.HIGHER:
        return keyframe.session_id == last.session_id
    if candidate.kind is Kind.FRAME:
        return plain_name(keyframe.frame_id) == plain_name(last.frame_id)
    if candidate.kind is Kind.REUSED:
        return keyframe.stamp_ns > last.stamp_ns
    if candidate.kind is Kind.LATE:
        return keyframe.stamp_ns > last.stamp_ns and not _fill_a_gap(scene, last, keyframe)
    if candidate.kind is Kind.REPEAT:
        rows = [scene.find_keyframe(one.keyframe_id) for one in (last, keyframe)]
        places = [int(scene.places()[row]) for row in rows if row is not None]
        return len(places) == 2 and places[1] == places[0] + 1
    step_s = (keyframe.stamp_ns - last.stamp_ns) * NS
    near_s = unusual_s(scene)
    if candidate.kind is Kind.FORWARD and len(scene.keyframes) == 1:
        # Nothing is known yet of how far keyframes are apart.
        near_s = max(near_s, (last.stamp_ns - newest_ns(scene)) * NS)
    return abs(step_s) <= near_s


def _fill_a_gap(scene: Scene, first: Keyframe, second: Keyframe) -> bool:
    """Return True if two keyframes belong between the same two that are known: what came late, not a second start."""
    stamps = scene.keyframes.stamp_ns[scene.order]
    place = np.searchsorted(stamps, [first.stamp_ns, second.stamp_ns])
    return bool(place[0] == place[1] > 0)


def begin_of(scene: Scene, candidate: Candidate) -> Begin:
    """Return how a confirmed candidate begins a session."""
    if candidate.kind in (Kind.BACK, Kind.FORWARD) and is_lone(scene, candidate, scene.config.max_reorder_s):
        return Begin(replaces=True)
    kind = {Kind.FRAME: "frame_changed", Kind.REUSED: "reused_id"}.get(candidate.kind, "clock_jump")
    why = {
        Kind.FRAME: "header.frame_id must not change within a session",
        Kind.REPEAT: "the recording plays again under the same session_id",
    }.get(candidate.kind, "the clock was set back, or the front-end restarted without raising session_id")
    return Begin(kind, f"{candidate.text}: a new session begins, as those after it agree; {why}")


def is_lone(scene: Scene, candidate: Candidate, limit_s: float) -> bool:
    """Return True if the session is one keyframe, further than a limit off those that are held: its stamp is wrong."""
    gap_s = abs(candidate.keyframes[0].stamp_ns - newest_ns(scene)) * NS
    return len(scene.keyframes) == 1 and gap_s > limit_s


def refuse_lone(before: Scene, log: RejectionLog) -> None:
    """Turn away the only keyframe of a session, whose stamp fits none of those that came after it."""
    table = before.keyframes
    name = f"keyframe {int(table.keyframe_id[0])} of session {before.session_id}"
    text = f"{name}, stamp {table.stamp_ns[0] * NS:.3f} s: those after it do not go on from there"
    log.reject("bad_stamp", text)
    log.warn("bad_stamp", f"{text}: turned away")


def dropped(candidate: Candidate, then: Decision) -> Decision:
    """Return a decision with what is held turned away before, or given to the scene as if it had never been held."""
    if candidate.kind not in _REASON:
        return then.also(admitted=tuple(Admitted(item) for item in candidate.items))
    refused = tuple(Refusal(one, _REASON[candidate.kind], _refusal_text(candidate, one)) for one in candidate.keyframes)
    tracks = tuple(
        Refusal(item, "unknown_keyframe", f"tracks of keyframe {item.keyframe_id}, which was turned away")
        for item in candidate.items
        if isinstance(item, FeatureTracks)
    )
    return then.also(refused=refused + tracks)


def _refusal_text(candidate: Candidate, keyframe: Keyframe) -> str:
    is_first = keyframe is candidate.keyframes[0]
    text = candidate.text if is_first else f"keyframe {keyframe.keyframe_id} likewise"
    return f"{text}, stamp {keyframe.stamp_ns * NS:.3f} s, and those after it do not agree"


def never_began(item: OfSession) -> Refusal:
    """Turn away what waited for the first keyframe of its session in vain."""
    session = f"session {item.session_id}, which no keyframe began"
    if isinstance(item, FeatureTracks):
        text = f"tracks of camera {item.camera_index} wait for keyframe {item.keyframe_id} of {session}"
        return Refusal(item, "unknown_keyframe", text)
    what = f"{len(item.track_id)} guesses wait" if isinstance(item, LandmarkGuesses) else f"{type(item).__name__} waits"
    return Refusal(item, "pending_overflow", f"{what} for {session}")


def newest_ns(scene: Scene) -> int:
    """Return the stamp of the newest keyframe, ns."""
    return scene.newest_ns


def unusual_s(scene: Scene) -> float:
    """Return how far ahead a keyframe may be without a second look, s; 0 for any distance."""
    limit_s = scene.config.max_reorder_s
    stamps = scene.keyframes.stamp_ns[scene.order[-_RECENT:]]
    if limit_s <= 0.0 or len(stamps) < 2:
        return limit_s
    return max(limit_s, _USUAL * NS * float(np.median(np.diff(stamps))))


def late_s(scene: Scene) -> float:
    """Return how far back a keyframe may be without a second look, s; infinite where nothing is known yet."""
    stamps = scene.keyframes.stamp_ns[scene.order[-_RECENT:]]
    if scene.config.max_reorder_s <= 0.0 or len(stamps) < 2:
        return float("inf")
    return _USUAL * NS * float(np.median(np.diff(stamps)))


def same_pose(scene: Scene, row: int, keyframe: Keyframe) -> bool:
    """Return True if a usable keyframe has the pose that the front-end gave to one that is known."""
    rotation = geometry.matrix_from_quaternion(np.asarray(keyframe.orientation, float))
    table = scene.keyframes
    return np.array_equal(table.input_position[row], keyframe.position) and np.array_equal(
        table.input_rotation[row], rotation
    )
