# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make one map of several sessions where tracks connect them (``scene.join_sessions``).

A session that ends is kept as it is. Tracks of the current one that it knows, by their ids or by merges, are points
with a place in both maps: those of the older map are to the current one what surveyed points are to a map, and the two
are aligned as map and world are (``constraints.aligned``). If most of these points then lie where the keyframes of the
current session see them, that session moves to where it is in the older map, and the tables become one. What remains
between the two is left to a solve of everything.

Poses by the front-end are in another frame in each session. Those of the older one are moved as a whole, so that the
correction from them to the map is one at the seam; no step counts across it (``Constraints.seams``).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import Config
from ba_node.core import geometry, native_kernels
from ba_node.scene.scene import Scene
from ba_node.window import constraints
from ba_node.window.loops import LEAST, WIDE, Due
from ba_node.window.problems import problem_of

# Standard deviation of where a map has a point, m, beside a share of how far away it is.
_SIGMA_M = 0.05


class Earlier:
    """The sessions before, oldest first, until they are joined with the current one."""

    def __init__(self) -> None:
        self.scenes: list[Scene] = []

    def keep(self, scene: Scene, config: Config) -> None:
        """Keep a session that has ended, together no more keyframes than a map has."""
        if config.scene.join_sessions and scene.cameras is not None:
            scene.propagate_corrections()
            self.scenes.append(scene)
            while len(self.scenes) > 1 and sum(len(one.keyframes) for one in self.scenes) > config.scene.max_keyframes:
                del self.scenes[0]

    def join(self, scene: Scene, config: Config, *, final: bool = False) -> Due | None:
        """Join the current session with one that its newest keyframe sees again.

        ``final``: nothing more will come, and sessions that stay apart are counted.

        Returns:
            What is to be solved then; None if it was joined with none.
        """
        for before in reversed(self.scenes if len(scene.keyframes) and scene.cameras is not None else []):
            rows, known = _shared(scene, before)
            if len(rows) < LEAST:
                continue
            why = _apart(scene, before)
            if why:
                scene.log.warn("not_joined", f"session {before.session_id} is not joined with this one: {why}")
                self.scenes.remove(before)
                continue
            found = _alignment(scene, config, rows, before.landmarks.position[known])
            if found is not None:
                _put_before(scene, before, found)
                self.scenes.remove(before)
                return Due(f"{len(rows)} tracks connect it with session {before.session_id}")
        scene.log.notice("apart", len(self.scenes) if final else 0)
        return None


def _shared(scene: Scene, before: Scene) -> tuple[IntArray, IntArray]:
    """Return the landmarks that are the same in both maps and have a place in each, rows in one and in the other.

    None where the newest keyframe sees none of them: nothing has changed then.
    """
    ids = scene.landmarks.track_id
    of_newest = scene.observations.landmark[scene.rows_of(int(scene.order[-1]))]
    if not scene.constraints.merges and not (before.find_landmarks(ids[of_newest]) >= 0).any():
        return np.empty(0, np.intp), np.empty(0, np.intp)
    there = before.find_landmarks(ids)
    pairs = np.array(scene.constraints.merges, np.uint64).reshape(-1, 2)
    for here, other in (pairs.T, pairs.T[::-1]):
        rows, known = scene.find_landmarks(here), before.find_landmarks(other)
        good = (rows >= 0) & (known >= 0)
        there[rows[good]] = known[good]
    rows = np.flatnonzero((there >= 0) & scene.landmarks.has_position & (scene.landmarks.last >= 0))
    rows = rows[before.landmarks.has_position[there[rows]]]
    return rows, there[rows]


def _apart(scene: Scene, before: Scene) -> str:
    """Return in words why two sessions can be no one map, empty if they can."""
    twice = np.intersect1d(scene.keyframes.keyframe_id, before.keyframes.keyframe_id)
    if len(twice):
        return f"keyframe {twice[0]} is in both; with scene.join_sessions ids have to be unique over all sessions"
    if int(scene.keyframes.stamp_ns.min()) <= before.newest_ns:
        return "it does not end before this one begins, by the stamps of the keyframes"
    assert scene.cameras is not None and before.cameras is not None
    if len(scene.cameras.model) != len(before.cameras.model):
        return f"it has {len(before.cameras.model)} cameras, this one {len(scene.cameras.model)}"
    return ""


def _alignment(
    scene: Scene, config: Config, rows: IntArray, position: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return the rotation and translation from an older map, in which points have these places (n, 3), to this one."""
    seen = scene.observations.keyframe[scene.landmarks.last[rows]].astype(np.intp)
    covariance = np.tile(np.diag([constraints.UNKNOWN**2] * 3 + [_SIGMA_M**2] * 3), (len(rows), 1, 1))
    pairs = constraints.as_seen(scene, rows, seen, position, covariance)
    found = constraints.aligned(scene, pairs, dataclasses.replace(config.factors, align_m=0.0))
    if found is None:
        return None
    views = scene.views_of(rows)
    keyframes = scene.by_time(scene.distinct(scene.observations.keyframe[views]))
    origin = scene.keyframes.position[keyframes[0]]
    there = position @ found[0].T + found[1] - origin
    problem, _ = problem_of(scene, views, keyframes, rows, origin, there, config)
    norms = native_kernels.residual_norms(problem, problem.start, config.solver.kernels)
    near = norms <= WIDE * (config.tracks.outlier_px or np.inf)
    agreeing = np.count_nonzero(np.bincount(problem.observations.point, near, len(rows)) > 0)
    return found if agreeing >= max(LEAST, (len(rows) + 1) // 2) else None


def _put_before(scene: Scene, before: Scene, here_from_there: tuple[FloatArray, FloatArray]) -> None:
    """Move a session to where it is in an older map, and make one map of both."""
    there_from_here = geometry.inverse(*here_from_there)
    table, points, known = scene.keyframes, scene.landmarks, scene.constraints
    table.rotation[:], table.position[:] = geometry.compose(*there_from_here, table.rotation, table.position)
    points.position[:] = points.position @ there_from_here[0].T + there_from_here[1]
    if known.map_from_world is not None:
        known.map_from_world = geometry.compose(*there_from_here, *known.map_from_world)
    # The older front-end's frame moves so that both corrections from it to the map are one at the seam.
    first = scene.order[0]
    own = geometry.inverse(*scene.corrections(first))
    moved = geometry.compose(*own, *before.corrections(before.order[-1]))
    older = before.keyframes
    older.input_rotation[:], older.input_position[:] = geometry.compose(
        *moved, older.input_rotation, older.input_position
    )
    before.landmarks.guess[:] = before.landmarks.guess @ moved[0].T + moved[1]
    seam = int(table.keyframe_id[first])
    scene.put_before(before)
    known.put_before(before.constraints, seam, scene.log)
