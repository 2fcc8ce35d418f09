# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Fix, marginalise or drop keyframes that leave the window (``window.old_keyframes``).

- fix: those that see the window's points take part with fixed poses, as if they were exact.
- drop: they take no part. What they told is forgotten, and the oldest keyframe of the window is held.
- marginalise: when a keyframe leaves, what it and tracks that it saw tell of the keyframes that stay becomes a prior
  on these (``core/marginalisation.py``). These observations take no part any more. Keyframes that left more than a
  window ago, and whose tracks are still seen or seen again, are fixed as above.

  A track that goes on becomes a new point where one keyframe alone places it (several cameras, depths). If it stayed as
  it is, without the views of the keyframe that has left, nothing would tie the window to the way behind it where all
  tracks are long: on a straight road the error was three times as large. With one camera a new point would have no
  parallax, which costs more; there the view is given up, but by keyframes two windows old: few tracks last so long.

The prior is given up, and the next windows begin as with `fix`, where anything but windows has moved its keyframes: a
solve of everything, a loop that was closed, solutions that were taken back.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.config import Config, SolverOptions
from ba_node.core import methods
from ba_node.core.marginal import MarginalPrior
from ba_node.core.marginalisation import marginalise
from ba_node.core.problem import Problem, State
from ba_node.core.rows import DEPTHS, MARGINAL, Rows, rows_of
from ba_node.scene.scene import Scene

# So many of the newest observations tell whether depths are measured.
_LOOKED_AT = 100


@dataclass(frozen=True)
class Solved:
    """The last window that was taken."""

    problem: Problem  # that was solved
    state: State  # its solution, in the problem
    origin: FloatArray  # (3,) of the problem in the map, m
    keyframe_id: IdArray  # (n_kf,) uint64
    track_id: IdArray  # (n_pt,) uint64
    poses: tuple[FloatArray, FloatArray]  # (n_kf, 3, 3), (n_kf, 3) as they stand in the map since


@dataclass(frozen=True)
class Memory:
    """What windows know of keyframes that have left."""

    solved: Solved
    prior: MarginalPrior | None = None  # in a world of its own; None before a keyframe has left
    origin: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(3))  # (3,) of that world in the map, m
    keyframe_id: IdArray = dataclasses.field(default_factory=lambda: np.empty(0, np.uint64))  # (k,) of the prior
    left: IdArray = dataclasses.field(default_factory=lambda: np.empty(0, np.uint64))  # keyframes that were taken out
    tracks: IdArray = dataclasses.field(default_factory=lambda: np.empty(0, np.uint64))  # (m,) in the prior, ascending
    # (m,) ns: views of these up to there are in the prior
    until_ns: IntArray = dataclasses.field(default_factory=lambda: np.empty(0, np.int64))

    def used(self, scene: Scene, rows: IntArray) -> BoolArray:
        """Return which observations, by their rows in the scene, are in the prior."""
        if not len(self.tracks):
            return np.zeros(len(rows), bool)
        table = scene.observations
        track = scene.landmarks.track_id[table.landmark[rows]]
        place = np.minimum(np.searchsorted(self.tracks, track), len(self.tracks) - 1)
        stamp = scene.keyframes.stamp_ns[table.keyframe[rows]]
        return np.asarray((self.tracks[place] == track) & (stamp <= self.until_ns[place]))

    def takes_part(self, scene: Scene, rows: IntArray, window: IntArray) -> BoolArray:
        """Return which observations of a window's tracks may take part, by their rows in the scene.

        Not those in the prior, nor those by keyframes that have left not long ago.
        """
        table = scene.observations
        keyframe = table.keyframe[rows]
        left = np.isin(scene.keyframes.keyframe_id[keyframe], self.left) & (scene.numbers(keyframe, window) < 0)
        return np.asarray(~self.used(scene, rows) & ~left)

    def recent(self, scene: Scene, oldest_ns: int, n: int) -> Memory:
        """Return the same without tracks that no window sees which begins at a stamp, and the last n that left."""
        rows = scene.find_keyframes(self.left)
        order = np.argsort(np.where(rows >= 0, scene.keyframes.stamp_ns[rows], 0), kind="stable")
        kept = self.until_ns >= oldest_ns
        return dataclasses.replace(
            self, left=np.sort(self.left[order[-n:]]), tracks=self.tracks[kept], until_ns=self.until_ns[kept]
        )

    def factor(self, keyframe_id: IdArray, origin: FloatArray) -> MarginalPrior | None:
        """Return the prior for a problem of some keyframes, with its origin (3,) in the map, m; None without one."""
        if self.prior is None:
            return None
        order = np.argsort(keyframe_id)
        place = np.minimum(np.searchsorted(keyframe_id, self.keyframe_id, sorter=order), len(order) - 1)
        numbers = order[place]
        here = keyframe_id[numbers] == self.keyframe_id
        found = self.prior.kept(here, numbers[here])
        return None if found is None else found.moved(origin - self.origin)


def window_size(scene: Scene, config: Config) -> int:
    """Return how many of the newest keyframes are refined: twice as many where one camera's are marginalised."""
    size = config.window.max_keyframes
    if config.window.old_keyframes != "marginalise" or scene.cameras is None or len(scene.cameras.model) > 1:
        return size
    return size if np.isfinite(scene.observations.depth_m[-_LOOKED_AT:]).any() else 2 * size


def note(
    scene: Scene, config: Config, problem: Problem, state: State, rows: tuple[IntArray, IntArray, FloatArray]
) -> None:
    """Keep a window that was taken, and is in the scene; ``rows`` are its keyframes, its landmarks and its origin."""
    if config.window.old_keyframes != "marginalise":
        scene.memory = None
        return
    keyframes, landmarks, origin = rows
    table = scene.keyframes
    solved = Solved(
        problem,
        state,
        origin,
        table.keyframe_id[keyframes],
        scene.landmarks.track_id[landmarks],
        (table.rotation[keyframes].copy(), table.position[keyframes].copy()),
    )
    before = scene.memory
    scene.memory = dataclasses.replace(before, solved=solved) if isinstance(before, Memory) else Memory(solved)


def memory(scene: Scene, config: Config, window: IntArray) -> Memory | None:
    """Return what is known of keyframes that have left, with those that are not in a window (rows) taken out now."""
    known = scene.memory
    if config.window.old_keyframes != "marginalise" or not isinstance(known, Memory):
        return None
    rows = scene.find_keyframes(known.solved.keyframe_id)
    table = scene.keyframes
    free = ~known.solved.problem.fixed
    same = (rows[free] >= 0).all() and all(
        np.array_equal(now[rows[free]], then[free])
        for now, then in zip((table.rotation, table.position), known.solved.poses, strict=True)
    )
    if not same:
        scene.memory = None
        return None
    inside = np.isin(rows, window)
    # All that have left since that window was solved: where solves were held, they are taken out once more, together.
    gone = ~inside & free
    if (gone & ~np.isin(known.solved.keyframe_id, known.left)).any():
        known = _without(scene, known, gone, methods.from_config(config.solver))
        known = known.recent(scene, int(table.stamp_ns[window[0]]), config.window.max_keyframes)
        scene.memory = known
    return known


def _without(scene: Scene, known: Memory, gone: BoolArray, options: SolverOptions) -> Memory:
    """Return a memory with keyframes (n_kf,) of the last window taken out."""
    solved = known.solved
    problem, obs = solved.problem, solved.problem.observations
    free = np.flatnonzero(~problem.fixed)
    n = problem.n_points
    points = np.bincount(obs.point[gone[obs.keyframe]], minlength=n) > 0
    if len(problem.cameras.model) == 1 and not len(obs.depth_m):
        points &= np.bincount(obs.point[obs.keyframe == problem.n_keyframes - 1], minlength=n) == 0
    with np.errstate(all="ignore"):
        rows = rows_of(problem, solved.state, options)
    absorbed = rows.take(_absorbed(problem, rows, gone, points))
    stays = ~gone[free]
    prior = marginalise(absorbed, solved.state, free, stays)
    of = solved.keyframe_id[free][stays]
    newest = int(scene.keyframes.stamp_ns[scene.find_keyframes(solved.keyframe_id[-1:])[0]])
    tracks = np.concatenate([known.tracks, solved.track_id[points]])
    until = np.concatenate([known.until_ns, np.full(np.count_nonzero(points), newest)])
    tracks, last = np.unique(tracks[::-1], return_index=True)
    return Memory(
        solved,
        prior,
        solved.origin,
        of[:0] if prior is None else of[prior.keyframes[0]],
        np.union1d(known.left, solved.keyframe_id[gone]),
        tracks,
        until[::-1][last],
    )


def _absorbed(problem: Problem, rows: Rows, gone: BoolArray, points: BoolArray) -> BoolArray:
    """Return which rows become part of the prior: those of points, and factors on keyframes that have left."""
    out = (rows.group >= 0) & (rows.group <= DEPTHS)
    out[out] = points[problem.observations.point[rows.source[out]]]
    for number, kind in enumerate(problem.factors):
        of = np.flatnonzero(rows.group == DEPTHS + 1 + number)
        out[of] = gone[kind.keyframes[rows.source[of]]].any(axis=1)
    return np.asarray(out | (rows.group == MARGINAL))
