# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find loops that the map does not meet yet: measured relative poses, and tracks that are the same points.

Where tracks are the same points as older ones, the keyframe that sees most of them is placed by where these lie, as
one that the front-end has put in a wrong place (``arrival.py``): that is the loop. Pairs that do not agree with the
others stay apart.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.config import Config
from ba_node.core import geometry, native_kernels
from ba_node.core.factors import RelativePoses
from ba_node.core.problem import State
from ba_node.scene.scene import Scene
from ba_node.window import arrival
from ba_node.window.problems import problem_of

# So many tracks place a keyframe; a view agrees within so many outlier gates, as the map has drifted apart.
LEAST, WIDE = 6, 3.0


@dataclass(frozen=True)
class Due:
    """What begins a solve of everything."""

    cause: str  # in words
    loops: tuple[RelativePoses, ...] = ()  # by rows of the scene
    joined: tuple[tuple[int, int], ...] = ()  # tracks that go on under the id of another
    key: tuple[int, int] | None = None  # keyframes of the relative pose that the map does not meet
    grown: bool = False  # nothing but that the map has grown
    quiet: bool = False  # nothing is said if nothing comes of it


def measured(scene: Scene, config: Config) -> Due | None:
    """Return a loop by pose that the map does not meet."""
    known, table = scene.constraints, scene.keyframes
    for key in list(known.unchecked):
        ends = [scene.find_keyframe(end) for end in key]
        if None in ends or not table.refined[np.array(ends, np.intp)].all():
            continue
        known.unchecked.remove(key)
        first, second = np.array(ends, np.intp)
        back = geometry.inverse(table.rotation[first], table.position[first])
        _, there = geometry.compose(*back, table.rotation[second], table.position[second])
        off = float(np.linalg.norm(there - known.relative[key].position))
        if 0.0 < config.factors.adjust_m < off and known.relative[key].is_loop:
            return Due(f"the relative pose of keyframe {key[1]} in {key[0]} is {off:.2f} m off the map", key=key)
    return None


def merged(scene: Scene, config: Config, final: bool) -> Due | None:
    """Return the loop that pairs of tracks tell; join those whose places agree, turn away those that are none."""
    known, points, table = scene.constraints, scene.landmarks, scene.keyframes
    pairs = np.array(known.merges, np.uint64)
    rows = scene.find_landmarks(pairs.ravel()).reshape(-1, 2)
    there = np.flatnonzero((rows >= 0).all(axis=1))
    pairs, rows = pairs[there], rows[there]
    both = np.array([bool(_images(scene, a) & _images(scene, b)) for a, b in rows], bool)
    if both.any():
        _give_up(scene, pairs[both], "one image sees both, they are no one point")
        pairs, rows = pairs[~both], rows[~both]
    if np.count_nonzero(points.has_position[rows[:, 1]]) < LEAST:
        # Windows of then gave them no place: those of now tell where the earlier keyframe is.
        rows = rows[:, ::-1]
    seen = points.has_position[rows[:, 1]]
    new, seen[seen] = _most_seen(scene, rows[seen])
    if np.count_nonzero(seen) < LEAST:
        if final and known.merges:
            _give_up(scene, np.array(known.merges, np.uint64), f"no keyframe sees {LEAST} that have a place")
        return None
    old = min((int(k) for k, _ in _images(scene, rows[seen][0, 1])), key=lambda k: int(scene.places()[k]))
    found = _resected(scene, config, new, rows[seen], old)
    if found is None:
        _give_up(
            scene, pairs, f"keyframe {table.keyframe_id[new]} sees them nowhere near where these are, from any place"
        )
        return None
    pose, agrees, sigma_rad, far_m = found
    if not agrees.all():
        _give_up(scene, pairs[seen][~agrees], "the others do not see it there")
    joined = tuple((int(a), int(b)) for a, b in np.concatenate([pairs[seen][agrees], pairs[~seen]]))
    moved = float(np.linalg.norm(pose[1] - table.position[new]))
    if not 0.0 < config.factors.adjust_m < moved:
        join(scene, joined)
        return None
    measured = geometry.compose(*geometry.inverse(table.rotation[old], table.position[old]), *pose)
    root = np.diag(np.repeat([1.0 / sigma_rad, 1.0 / (sigma_rad * far_m)], 3))
    loop = RelativePoses(np.array([[old, new]]), measured[0][None], measured[1][None], root[None])
    off = f"{moved:.2f} m beside where the map has it"
    return Due(f"{len(joined)} merged tracks see keyframe {table.keyframe_id[new]} {off}", (loop,), joined)


def join(scene: Scene, pairs: tuple[tuple[int, int], ...]) -> None:
    """Let tracks go on under the ids of others."""
    for track, other in pairs:
        scene.join_tracks(track, other)
    scene.constraints.merges = [pair for pair in scene.constraints.merges if pair not in pairs]


def _give_up(scene: Scene, pairs: IdArray, why: str) -> None:
    """Turn pairs away."""
    given = [(int(a), int(b)) for a, b in pairs]
    scene.log.reject("bad_merge", f"merge of track {given[0][0]} with {given[0][1]}: {why}", len(given))
    scene.constraints.merges = [pair for pair in scene.constraints.merges if pair not in given]


def _images(scene: Scene, landmark: int) -> set[tuple[int, int]]:
    """Return keyframe and camera of all views of a landmark."""
    views, seen = scene.views_of(np.array([landmark])), scene.observations
    return set(zip(seen.keyframe[views].tolist(), seen.camera[views].tolist(), strict=True))


def _most_seen(scene: Scene, rows: IntArray) -> tuple[int, BoolArray]:
    """Return the keyframe that sees the first of most pairs (n, 2) of landmarks, the newest of several, and which."""
    seen = [{keyframe for keyframe, _ in _images(scene, row)} for row in rows[:, 0]]
    count = Counter(keyframe for one in seen for keyframe in one)
    place = scene.places()
    new = max(count, key=lambda keyframe: (count[keyframe], place[keyframe]), default=-1)
    return new, np.array([new in one for one in seen], bool)


def _resected(
    scene: Scene, config: Config, new: int, rows: IntArray, old: int
) -> tuple[tuple[FloatArray, FloatArray], BoolArray, float, float] | None:
    """Return where a keyframe is that sees the places of other landmarks; None if most of its views agree with none.

    ``rows`` (n, 2) are the landmarks that it sees and those that are the same points; it may be near ``old``.

    Returns:
        Rotation and position in the map; which pairs agree (n,); standard deviation of its rotation, rad; distance of
        the points, m.
    """
    table, points = scene.keyframes, scene.landmarks
    views = scene.views_of(rows[:, 0])
    origin = table.position[old]
    order = np.argsort(rows[:, 0])
    problem, _ = problem_of(
        scene, views, np.array([new]), rows[order, 0], origin, points.position[rows[order, 1]] - origin, config
    )
    best, least = problem.start, np.inf
    for row in (new, old):
        pose = geometry.inverse(table.rotation[row], table.position[row] - origin)
        begin = State(pose[0][None], pose[1][None], problem.start.points, problem.start.intrinsics)
        state = arrival.lowered(problem, begin)
        off = native_kernels.residual_norms(problem, state, config.solver.kernels)
        cost = float(np.sum(np.minimum(off, WIDE * config.tracks.outlier_px)))
        if cost < least:
            best, least = state, cost
    norms = native_kernels.residual_norms(problem, best, config.solver.kernels)
    right = np.bincount(problem.observations.point, norms <= WIDE * config.tracks.outlier_px, len(rows)) > 0
    if np.count_nonzero(right) < max(LEAST, (len(rows) + 1) // 2):
        return None
    agrees = np.empty(len(rows), bool)
    agrees[order] = right
    rotation, position = geometry.inverse(best.rotation[0], best.translation[0])
    far = float(np.median(np.linalg.norm(best.points[right] - position, axis=1)))
    obs = problem.observations
    noise = float(np.median(obs.sigma_px)) * max(1.0, float(np.median(norms)))
    sigma_rad = 2.0 * noise / float(problem.cameras.params[0, 0]) / np.sqrt(np.count_nonzero(right))
    return (geometry.nearest_rotation(rotation), position + origin), agrees, sigma_rad, far
