# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check the set-up of each session as its first keyframes come, and say whether its solves are to be held.

What the tracks can tell depends on how the robot moves: two cameras can be compared at once, poses need parallax, a
focal length needs turns. So the check runs at numbers of keyframes that double, each time only with the tests that are
still open, until all have told or the last of these numbers is reached.

What was right at first may change on the way: cameras exchanged, images of another size. So some keyframes after solves
have first said that tracks contradict them, those since then are checked by themselves, with all tests. So are the
newest where their refined steps deviate from the front-end's or a camera fell silent, and once more at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ba_node.check import few, two_view
from ba_node.check.change import check_change
from ba_node.check.diagnosis import Diagnosis
from ba_node.check.examine import examine, run
from ba_node.check.tracks import tracks_of
from ba_node.scene.scene import Scene

# Keyframes at which a session is checked. A robot may stand for long before there is anything to tell.
_AT = (3, 6, 10, 15, 25, 40, 60, 90, 150, 250, 500, 1000)
# What fits on a straight way, or seems to over a few keyframes, is looked at once more here.
_AGAIN = (15, 40, 90)
# A session that ends with fewer is looked at once more with all of them.
_FEW = 10
_ONCE = frozenset({"pixels", "stamps"})
# Looked for where there is doubt; and where all is looked at again, and at each number after that.
_IN_DOUBT, _AT_FEW = frozenset({"onset"}), frozenset({"change"})
# What solves say of tracks and poses while the set-up is wrong.
_CONSEQUENCES = ("held", "moving", "stray", "ids_reused")
# The newest of them are looked at; and fewer by themselves, where what was right at first may have changed.
_NEWEST, NEWEST = 60, 20
# So many keyframes after solves have first said such a thing, those since then (0) or so many are checked.
_SINCE = ((5, 0), (8, _NEWEST), (12, 0), (24, 0))
# Steps deviate some keyframes after what has changed.
_BEFORE = 10
# A map that was sound for so many is kept up to there; the end of a shorter one would be worse than as it came, where
# it is carried along by what the first few were worth.
_SOUND = 40
# A camera is silent that delivered for each of the first and none of so many of the newest keyframes; said after more.
_SILENT, _SAID = 5, 10


@dataclass
class Check:
    """A check that may run on any thread."""

    scene: Scene  # that it is of; asked only whether it is still the current one
    work: Callable[[], Diagnosis]  # what it does; the scene is not touched
    found: Diagnosis | None = None  # what it found, None before :meth:`run`

    def run(self) -> Check:
        """Do the work."""
        self.found = self.work()
        return self


def of_all(scene: Scene) -> Diagnosis | None:
    """Return what all tracks tell, or the newest alone where these contradict the set-up; None if there are none."""
    tracks = tracks_of(scene)
    if tracks is None:
        return None
    _fell_silent(scene)
    found = examine(tracks)
    if found.harmful or len(scene.keyframes) <= NEWEST:
        return found
    newest = tracks_of(scene, NEWEST)
    changed = None if newest is None else examine(newest, _ONCE)
    return changed if changed is not None and changed.harmful else found


def of_few_keyframes(scene: Scene) -> Check | None:
    """Return the check of a session that ends with so few keyframes that it was hardly looked at; None for others."""
    tracks = tracks_of(scene) if 1 < len(scene.keyframes) < _FEW else None
    if tracks is None or not two_view.available():
        return None
    found = examine(tracks)
    if not found.harmful and scene.keyframes.refined.any():
        table, order = scene.keyframes, scene.order
        found = run(lambda: few.check_few(tracks, table.rotation[order], table.position[order]), "few keyframes")
    return _done(scene, found) if found.harmful else None


def of_the_newest(scene: Scene, deviates: bool) -> Check | None:
    """Return the check of the newest keyframes alone, at the end, if solves or their steps give a reason; or None."""
    if len(scene.keyframes) < _FEW or not (deviates or _doubtful(scene)) or not two_view.available():
        return None
    for some in (NEWEST, _NEWEST):
        tracks = tracks_of(scene, some)
        found = None if tracks is None else examine(tracks, _said(scene))
        if found is not None and found.harmful:
            return _done(scene, found)
    return None


def of_all_images(scene: Scene) -> Check | None:
    """Return the check whether images changed among the newest keyframes, at the end; None if none did."""
    tracks = tracks_of(scene, _NEWEST) if scene.keyframes.refined.any() else None
    found = None if tracks is None else run(lambda: check_change(tracks), "change")
    return _done(scene, found) if found is not None and found.harmful else None


def _done(scene: Scene, found: Diagnosis) -> Check:
    return Check(scene, lambda: found, found)


def _said(scene: Scene) -> frozenset[str]:
    """Return the tests that need not be made again; depths that contradict images are left out as it is."""
    return _ONCE | ({"depth"} if "depths" in scene.log.warnings else set())


def _sound_until(scene: Scene, found: Diagnosis) -> int:
    """Return how many keyframes were refined before what was found could reach them."""
    if found.since_ns is None:
        return 0
    sound = int(np.count_nonzero(scene.keyframes.stamp_ns[scene.order] < found.since_ns)) - _BEFORE
    return sound if sound >= _SOUND else 0


def _doubtful(scene: Scene) -> bool:
    return _fell_silent(scene) or not scene.log.warnings.keys().isdisjoint(_CONSEQUENCES)


def _fell_silent(scene: Scene) -> bool:
    """Return True if a camera that delivered at first does no more; warn of it where others go on."""
    order = scene.order
    first, newest, said = (
        [scene.cameras_of(row) for row in rows.tolist()] for rows in (order[:_SILENT], order[-_SILENT:], order[-_SAID:])
    )
    regular, now = set.intersection(*first), set.union(*newest)
    silent, known = sorted(regular.difference(*said)) if now else [], scene.log.warnings.get("silent_camera", "")
    if not all(f"camera {camera} after" in known for camera in silent):
        found: list[str] = []
        for camera in silent:
            last = next(row for row in order[::-1].tolist() if camera in scene.cameras_of(row))
            stamp_s = scene.keyframes.stamp_ns[last] * 1e-9
            found.append(f"camera {camera} after keyframe {scene.keyframes.keyframe_id[last]} ({stamp_s:.3f} s)")
        where = " and ".join(found)
        scene.log.warn(
            "silent_camera",
            f"no tracks came of {where}, while others go on: look whether it delivers, and under which camera_index",
        )
    return not regular <= now


class SetUpWatch:
    """The check of one session after the other."""

    def __init__(self) -> None:
        # runs a check on another thread and sees to it that :meth:`take` gets it; None to do it at once
        self.elsewhere: Callable[[Check], None] | None = None
        self._reason = ""
        self._scene: Scene | None = None
        self._told: frozenset[str] = frozenset()
        self._next = 0
        self._busy = False
        self._doubted = 0  # keyframes that came before solves, or their steps, gave a reason to look again
        self._looked = 0  # how many of _SINCE are done

    def look(self, scene: Scene, deviates: bool = False) -> str:
        """Check a scene if it has come to a number of keyframes at which that is due; return why to hold its solves.

        ``deviates``: the newest refined steps are off the front-end's.
        """
        if scene is not self._scene:
            self._scene, self._told, self._next, self._busy, self._reason = scene, frozenset(), 0, False, ""
            self._doubted = self._looked = 0
        count = len(scene.keyframes)
        doubtful = _doubtful(scene)
        if not self._doubted and doubtful:
            self._doubted = count
        elif deviates and count >= 2 * self._doubted and (not self._doubted or self._looked == len(_SINCE)):
            self._doubted, self._looked = max(1, count - _BEFORE), 0
        if self._reason or self._busy:
            return self._reason
        if self._next < len(_AT) and count >= _AT[self._next]:
            again = any(_AT[self._next] <= at <= count for at in _AGAIN)
            self._next = next((i for i, at in enumerate(_AT) if at > count), len(_AT))
            told = self._told & _ONCE if again else self._told | _AT_FEW
            self._check(scene, (told - _AT_FEW if count > _AGAIN[-1] else told) | _IN_DOUBT, _NEWEST)
        elif self._doubted and self._looked < len(_SINCE) and count >= self._doubted + _SINCE[self._looked][0]:
            newest = _SINCE[self._looked][1] or count - self._doubted
            self._looked += 1
            self._check(scene, _said(scene), newest)
        return self._reason

    def reason(self, scene: Scene) -> str:
        """Return why the solves of a scene are held, empty if they are not."""
        return self._reason if scene is self._scene else ""

    def _check(self, scene: Scene, told: frozenset[str], newest: int) -> None:
        if not two_view.available():
            scene.log.notice("setup_unchecked")
            self._next = len(_AT)
            return
        tracks = tracks_of(scene, newest)
        if tracks is None:
            return
        more = tracks_of(scene, _NEWEST) if newest < min(_NEWEST, len(scene.keyframes)) else None
        check = Check(scene, lambda: examine(tracks, told, more))
        if self.elsewhere is None:
            self.take(check.run())
        else:
            self._busy = True
            self.elsewhere(check)

    def take(self, check: Check) -> bool:
        """Take in a result; return True if it is of the current session and says that solves do harm.

        Then the scene is as the front-end gave it.
        """
        scene, found = check.scene, check.found
        if scene is not self._scene or found is None:
            return False
        self._busy = False
        self._told |= found.told
        for kind in found.notices:
            scene.log.notice(kind, kind not in scene.log.notices)
        if found.findings:
            scene.log.warn(kind="setup", text=found.summary())
        if found.failed:
            scene.log.warn("check_failed", f"the set-up is not wholly checked: {'; '.join(found.failed)}; report it")
        if not found.harmful:
            return False
        self._reason = f"the set-up contradicts the tracks: {found.causes()}"
        scene.forget_solutions(_sound_until(scene, found))
        for kind in _CONSEQUENCES:
            scene.log.warnings.pop(kind, None)
        return True
