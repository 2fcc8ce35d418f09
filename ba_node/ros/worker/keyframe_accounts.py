# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Account for every keyframe that the worker took: solved, solved with a newer one, turned away, forgotten, waiting.

Those that the back-end holds until others tell what they are wait too.
"""

from __future__ import annotations

from collections.abc import Collection

from ba_node.backend import CurrentMap

Key = tuple[int, int]
# So many keyframes that have left the map may stand in the accounts before these are gone through.
_SPARE = 1000


class KeyframeAccounts:
    """What became of the keyframes. Each is in one of the first four counts, or still waits.

    Attributes:
        solved: were the newest that a solve was made for.
        coalesced: were solved together with a newer one.
        rejected: were turned away.
        forgotten: left the map before they were solved (a new session, a full map, a reset).
        refined: took part in a usable solve; a matter apart from the other counts.
    """

    def __init__(self) -> None:
        self.solved = self.coalesced = self.rejected = self.forgotten = self.refined = 0
        # Arrival of each keyframe by session and id, s.
        self._unsolved: dict[Key, float] = {}
        self._unrefined: set[Key] = set()

    @property
    def waiting(self) -> int:
        """Return how many were taken and have no solve yet."""
        return len(self._unsolved)

    def take(self, session_id: int, keyframe_id: int, time_s: float) -> None:
        """Enter a keyframe that the map has now."""
        self._unsolved[session_id, keyframe_id] = time_s
        self._unrefined.add((session_id, keyframe_id))

    def arrival_s(self, session_id: int, keyframe_id: int) -> float | None:
        """Return when a keyframe came in, None if it was solved before."""
        return self._unsolved.get((session_id, keyframe_id))

    def refuse(self, session_id: int, keyframe_id: int) -> None:
        """Enter that a keyframe was turned away, perhaps after it was held."""
        self._unsolved.pop((session_id, keyframe_id), None)
        self._unrefined.discard((session_id, keyframe_id))
        self.rejected += 1

    def close(self, current: CurrentMap, refined: Collection[int], held: Collection[Key] = ()) -> None:
        """Close the accounts of a solve, after which the map is ``current``.

        ``refined`` are ids of those that took part, if it is usable, ``held`` session and id of those that the map does
        not have yet.
        """
        n_solved = 0
        for key in [key for key in self._unsolved if key not in held]:
            solved = current.is_solved(*key)
            if solved is None:
                self.forgotten += 1
            elif solved:
                n_solved += 1
            else:
                continue
            del self._unsolved[key]
        self.solved += min(n_solved, 1)
        self.coalesced += max(n_solved - 1, 0)
        took_part = {(current.session_id, key) for key in refined if (current.session_id, key) not in held}
        took_part &= self._unrefined
        self.refined += len(took_part)
        self._unrefined -= took_part
        if len(self._unrefined) > _SPARE + 2 * current.keyframe_count:
            self._unrefined = {key for key in self._unrefined if key in held or current.is_solved(*key) is not None}
