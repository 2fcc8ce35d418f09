# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn the newest part of a scene into a problem.

Free are the newest ``window.max_keyframes`` keyframes. Older ones that were refined before and see the same points take
part with fixed poses. A point takes part when two images see it (a stereo pair counts), or one with a measured depth.

What holds the problem in place is chosen in ``gauge.py``. A keyframe with too few observations is held out of it, and
goes on following its predecessor (``Scene.settle_poses``).

``select`` does not change the scene (but for settling poses); ``merging.py`` does, and only after a usable solve. The
problem has its origin at its oldest keyframe: far from the map's origin (UTM) no digits are lost.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ba_node.core import geometry, objective
from ba_node.core.problem import Observations, Problem, State
from ba_node.window import gauge
from ba_node.window.initial_points import initial_points, widened

if TYPE_CHECKING:
    from ba_node.config import Config
    from ba_node.scene.scene import Scene
    from ba_node.scene.tables import BoolArray, FloatArray, IntArray

# A keyframe with fewer observations (two residuals each, six unknowns) is not refined: nothing would check them.
MIN_OBSERVATIONS = 4
# An observation that begins this many times beyond the outlier gate sits out the solve. A point that comes to stand in
# the plane of a camera has a residual of 1e6 px or more; even weighted it would outweigh all the others.
_ABSURD = 25.0


@dataclass(frozen=True)
class Selection:
    """A problem and where its parts stand in the scene.

    Attributes:
        problem: with the observations that are believed.
        sightings: all observations of its points by its keyframes, believed or not, sorted by point.
        rows: (n_all,) row in the scene of each of these.
        believed: (n_all,) True where it is in the problem.
        keyframes: (n_kf,) row of each keyframe in the scene, oldest first.
        landmarks: (n_pt,) row of each point, by track id.
        window: rows of all keyframes of the window, those held out included, oldest first.
        lost: rows of landmarks that have a position which their views contradict; they sit this solve out.
        origin: (3,) of the problem in the map, m.
        unscaled: see ``gauge.Gauge``.
    """

    problem: Problem
    sightings: Observations
    rows: IntArray
    believed: BoolArray
    keyframes: IntArray
    landmarks: IntArray
    window: IntArray
    lost: IntArray
    origin: FloatArray
    unscaled: IntArray


@dataclass(frozen=True)
class _Part:
    """Rows of observations, and the keyframes and landmarks that they refer to (rows in the scene)."""

    rows: IntArray
    keyframes: IntArray
    landmarks: IntArray


def rows_of(scene: Scene, config: Config, end: int | None = None) -> IntArray:
    """Return the keyframes of the newest window among the first ``end`` keyframes (all by default), oldest first."""
    return scene.order[:end][-config.window.max_keyframes :]


def select(scene: Scene, config: Config, end: int | None = None) -> Selection | str:
    """Return the problem of the newest window among the first ``end`` keyframes, or why there is none."""
    window = rows_of(scene, config, end)
    reason = _nothing(scene, window)
    if reason:
        return reason
    scene.settle_poses()
    cameras = scene.cameras
    assert cameras is not None
    part = _reach(scene, window, config.window.max_fixed_keyframes)
    origin = scene.keyframes.position[part.keyframes[0]] if len(part.keyframes) else np.zeros(3)
    positions = _positions(scene, part, origin, config)
    usable = _usable(scene, part, origin, positions, config)
    lost = _contradicted(scene, part, usable)
    part, positions = _restrict(scene, part, positions, usable, config.window.max_landmarks)
    if not np.isin(part.keyframes, window).any():
        return "no keyframe of the window sees enough points that a second image sees"
    problem = problem_of(scene, part.rows, part.keyframes, part.landmarks, origin, positions, config)
    believed = usable[part.rows]
    active = dataclasses.replace(problem, observations=_take(problem.observations, believed))
    is_old = ~np.isin(part.keyframes, window)
    held = gauge.choose(active, is_old)
    return Selection(
        dataclasses.replace(active, fixed=held.fixed),
        problem.observations,
        part.rows,
        believed,
        part.keyframes,
        part.landmarks,
        window,
        lost,
        origin,
        held.unscaled,
    )


def problem_of(
    scene: Scene,
    rows: IntArray,
    keyframes: IntArray,
    landmarks: IntArray,
    origin: FloatArray,
    positions: FloatArray,
    config: Config,
) -> Problem:
    """Return the problem of some observations, sorted by point, keyframe, camera; all poses fixed.

    Args:
        scene: where they stand.
        rows: rows of the observations; reordered in place.
        keyframes: rows of the keyframes of the problem, in its order.
        landmarks: rows of the points of the problem, in its order.
        origin: (3,) of the problem in the map, m.
        positions: (n_pt, 3) of the points in the problem.
        config: for the precision of depths.
    """
    table, cameras = scene.sightings, scene.cameras
    assert cameras is not None
    keyframe = _number(keyframes, len(scene.keyframes))[table.keyframe[rows]]
    point = _number(landmarks, len(scene.landmarks))[table.landmark[rows]]
    camera = table.camera[rows].astype(np.intp)
    order = np.argsort((point * len(keyframes) + keyframe) * len(cameras.model) + camera, kind="stable")
    rows[:] = rows[order]
    depth = table.depth_m[rows].astype(float)
    depth = np.empty(0) if np.isnan(depth).all() else depth
    observations = Observations(
        keyframe[order],
        camera[order],
        point[order],
        table.uv[rows].astype(float),
        table.sigma_px[rows].astype(float),
        depth,
        config.tracks.depth_sigma_ratio * depth,
    )
    poses = geometry.inverse(scene.keyframes.rotation[keyframes], scene.keyframes.position[keyframes] - origin)
    return Problem(State(*poses, positions, np.empty((0, 3))), np.ones(len(keyframes), bool), cameras, observations)


def _nothing(scene: Scene, window: IntArray) -> str:
    if scene.cameras is None:
        return "no camera rig yet: nothing is known about the cameras"
    if len(window) == 0:
        return "no keyframe yet"
    if len(scene.keyframes) == 1:
        return "one keyframe only: nothing to refine against"
    return ""


def _reach(scene: Scene, window: IntArray, max_fixed: int) -> _Part:
    """Return all observations of the window's landmarks by the window and the older keyframes that share most."""
    ranges = [np.arange(b.begin, b.end) for row in window for b in scene.blocks[row]]
    own = np.concatenate(ranges) if ranges else np.empty(0, np.intp)
    seen = np.zeros(len(scene.landmarks), bool)
    seen[scene.sightings.landmark[own]] = True
    rows = scene.views_of(np.flatnonzero(seen))
    n = len(scene.keyframes)
    in_window = np.zeros(n, bool)
    in_window[window] = True
    believed = rows[~scene.sightings.outlier[rows]]
    shared = np.bincount(scene.sightings.keyframe[believed], minlength=n)
    # Newest first, so that of those that share equally many the newest are taken. A keyframe that was never refined
    # would only hold the others to the front-end's drift.
    older = scene.order[: int(np.argmax(in_window[scene.order]))][::-1]
    older = older[(shared[older] > 0) & scene.keyframes.refined[older]]
    chosen = older[np.argsort(-shared[older], kind="stable")[:max_fixed]]
    in_part = in_window.copy()
    in_part[chosen] = True
    return _part(scene, rows[in_part[scene.sightings.keyframe[rows]]], in_part)


def _part(scene: Scene, rows: IntArray, keyframes: BoolArray) -> _Part:
    landmarks = np.zeros(len(scene.landmarks), bool)
    landmarks[scene.sightings.landmark[rows]] = True
    by_id = scene.landmark_order
    return _Part(rows, scene.order[keyframes[scene.order]], by_id[landmarks[by_id]])


def _positions(scene: Scene, part: _Part, origin: FloatArray, config: Config) -> FloatArray:
    """Return the position of each landmark in the problem's frame, NaN where none can be had yet."""
    table = scene.landmarks
    positions = table.position[part.landmarks] - origin
    new = ~table.has_position[part.landmarks]
    positions[new] = np.nan
    is_new = np.zeros(len(table), bool)
    is_new[part.landmarks[new]] = True
    rows = part.rows[is_new[scene.sightings.landmark[part.rows]] & ~scene.sightings.outlier[part.rows]]
    if not len(rows):
        return positions
    landmarks = part.landmarks[new]
    guess = moved_guesses(scene, landmarks) - origin
    problem = problem_of(scene, rows, part.keyframes, landmarks, origin, guess, config)
    positions[new] = initial_points(problem, guess, config.tracks)
    return positions


def moved_guesses(scene: Scene, landmarks: IntArray) -> FloatArray:
    """Return the guesses of landmarks moved from the front-end's frame to the refined map, NaN where there is none.

    Each is moved by the correction of the earliest keyframe that sees it: a front-end's point hangs on the view that
    it was first seen in, and this choice does not depend on when the message came.
    """
    guess = np.where(scene.landmarks.has_guess[landmarks, None], scene.landmarks.guess[landmarks], np.nan)
    rows = scene.views_of(landmarks)
    place = np.empty(len(scene.keyframes), np.intp)
    place[scene.order] = np.arange(len(scene.order))
    first = np.full(len(scene.landmarks), len(scene.order) - 1)
    np.minimum.at(first, scene.sightings.landmark[rows], place[scene.sightings.keyframe[rows]])
    rotation, translation = scene.corrections(scene.order[first[landmarks]])
    return np.asarray((rotation @ guess[:, :, None])[..., 0] + translation)


def _usable(scene: Scene, part: _Part, origin: FloatArray, positions: FloatArray, config: Config) -> BoolArray:
    """Return which observations may take part: no outliers, and none that begins with an absurd residual."""
    usable: BoolArray = ~scene.sightings.outlier[: len(scene.sightings)]
    if config.tracks.outlier_px <= 0 or not len(part.rows):
        return usable
    rows = part.rows.copy()
    known = np.nan_to_num(positions, nan=0.0)
    problem = problem_of(scene, rows, part.keyframes, part.landmarks, origin, known, config)
    norm = residual_norms(problem, problem.start)
    placed = ~np.isnan(positions[problem.observations.point, 0])
    gate = _ABSURD * config.tracks.outlier_px
    far = norm > gate
    # By keyframe: where most residuals of a keyframe are large, its pose is wrong, and the solve is to mend that.
    for k in np.unique(problem.observations.keyframe[far]):
        own = problem.observations.keyframe == k
        far[own] = norm[own] > widened(gate, norm[own & placed & usable[rows]], 1)
    usable[rows[far]] = False
    return usable


def _contradicted(scene: Scene, part: _Part, usable: BoolArray) -> IntArray:
    """Return the rows of placed landmarks that absurd residuals leave with too few views, by track id."""
    rows = part.rows[~scene.sightings.outlier[part.rows]]
    weight = np.where(np.isfinite(scene.sightings.depth_m[rows]), 2, 1)
    n = len(scene.landmarks)
    before = np.bincount(scene.sightings.landmark[rows], weight, n)
    after = np.bincount(scene.sightings.landmark[rows], weight * usable[rows], n)
    lost = scene.landmarks.has_position & (before >= 2) & (after < 2)
    return part.landmarks[lost[part.landmarks]]


def residual_norms(problem: Problem, state: State) -> FloatArray:
    """Return the size of each residual in sigmas, inf for points on or behind the camera plane."""
    error = objective.reprojection_errors(problem, state)
    return np.nan_to_num(np.hypot(error[:, 0], error[:, 1]) / problem.observations.sigma_px, nan=np.inf)


def _restrict(
    scene: Scene, part: _Part, positions: FloatArray, usable: BoolArray, max_landmarks: int
) -> tuple[_Part, FloatArray]:
    """Leave out what does not determine anything, until nothing more has to go."""
    rows, n_kf, n_pt = part.rows, len(part.keyframes), len(part.landmarks)
    keyframe = _number(part.keyframes, len(scene.keyframes))[scene.sightings.keyframe[rows]]
    point = _number(part.landmarks, len(scene.landmarks))[scene.sightings.landmark[rows]]
    active = usable[rows]
    measured = active & np.isfinite(scene.sightings.depth_m[rows])
    keep_pt = _most_seen(~np.isnan(positions[:, 0]), np.bincount(point[active], minlength=n_pt), max_landmarks)
    count = -1
    while True:
        used = active & keep_pt[point]
        keep_kf = np.bincount(keyframe[used], minlength=n_kf) >= MIN_OBSERVATIONS
        used &= keep_kf[keyframe]
        views = np.bincount(point[used], minlength=n_pt)
        depths = np.bincount(point[used & measured], minlength=n_pt)
        keep_pt = keep_pt & ((views >= 2) | (depths > 0))
        previous, count = count, int(np.count_nonzero(keep_pt)) + int(np.count_nonzero(keep_kf))
        if count == previous:
            break
    kept = keep_pt[point] & keep_kf[keyframe]
    return _Part(rows[kept], part.keyframes[keep_kf], part.landmarks[keep_pt]), positions[keep_pt]


def _most_seen(known: BoolArray, views: IntArray, limit: int) -> BoolArray:
    """Return which of the known points to keep: at most ``limit``, those with most views, ties by track id."""
    if np.count_nonzero(known) <= limit:
        return known
    keep = np.zeros(len(known), bool)
    keep[np.argsort(np.where(known, -views, 1), kind="stable")[:limit]] = True
    return keep


def _number(rows: IntArray, n: int) -> IntArray:
    """Return the place of each of n rows in a list of rows, -1 where it is not in it."""
    place = np.full(n, -1)
    place[rows] = np.arange(len(rows))
    return place


def _take(obs: Observations, rows: BoolArray) -> Observations:
    has_depth = len(obs.depth_m) > 0
    return Observations(
        obs.keyframe[rows],
        obs.camera[rows],
        obs.point[rows],
        obs.uv[rows],
        obs.sigma_px[rows],
        obs.depth_m[rows] if has_depth else obs.depth_m,
        obs.depth_sigma_m[rows] if has_depth else obs.depth_sigma_m,
    )
