# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tell which keyframes are complete and not solved, and how far the next solve goes."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ba_node.scene.scene import Scene
    from ba_node.scene.tables import BoolArray, IntArray

# Keyframes from which it is learned how many cameras deliver.
_LEARN_FROM = 5


class Completion:
    """What is known of the newest keyframe and of the cameras that delivered for those before it.

    Attributes:
        newest: id of the newest keyframe that came, None before the first.
        closed: True if it counts as complete with what has come.
        delivered: cameras that delivered for each of the last keyframes before it.
    """

    def __init__(self, newest: int | None = None, closed: bool = False, delivered: Iterable[int] = ()) -> None:
        """Take up what is known."""
        self.newest, self.closed = newest, closed
        self.delivered = deque(delivered, maxlen=_LEARN_FROM)

    def begin(self, scene: Scene, keyframe_id: int) -> None:
        """Take a keyframe that the scene has now for the newest."""
        if self.newest is not None:
            row = scene.find_keyframe(self.newest)
            self.delivered.append(0 if row is None else len(scene.cameras_of(row)))
        self.newest, self.closed = keyframe_id, False

    def row(self, scene: Scene) -> int | None:
        """Return the row of the newest keyframe, None if there is none."""
        return None if self.newest is None else scene.find_keyframe(self.newest)

    def due(self, scene: Scene) -> IntArray:
        """Return the rows of complete keyframes that were not solved."""
        due = ~scene.keyframes.solved
        newest = self.row(scene)
        if newest is not None and not self._complete(scene, newest):
            due[newest] = False
        return np.flatnonzero(due)

    def _complete(self, scene: Scene, row: int) -> bool:
        if self.closed:
            return True
        expected = max(self.delivered, default=0) or (len(scene.cameras.model) if scene.cameras is not None else 1)
        return len(scene.cameras_of(row)) >= expected


def end_of_solve(scene: Scene, due: IntArray, window_size: int) -> int:
    """Return how many keyframes, oldest first, there are up to the newest that the next solve is to refine."""
    n = len(scene.order)
    waiting = np.flatnonzero(_marked(scene, due)[scene.order])
    # With one solved keyframe at least in the window the newest can be reached at once.
    if not len(waiting) or n - waiting[0] < window_size or n <= window_size:
        return n
    return int(waiting[0]) + window_size // 2


def reached(scene: Scene, due: IntArray, end: int) -> IntArray:
    """Return which keyframes of those that are due stand among the first ``end``, oldest first."""
    first = scene.order[:end]
    rows: IntArray = first[_marked(scene, due)[first]]
    return rows


def _marked(scene: Scene, due: IntArray) -> BoolArray:
    marked = np.zeros(len(scene.keyframes), bool)
    marked[due] = True
    return marked
