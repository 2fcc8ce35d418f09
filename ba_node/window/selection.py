# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn the newest part of a scene into a problem.

Free are the newest ``window.max_keyframes`` keyframes. Older ones that were refined before and see the same points take
part with fixed poses. A point takes part when two images see it (a stereo pair counts), or one with a measured depth.

What holds the problem in place is chosen in ``gauge.py``. A keyframe with too few observations is held out of it, and
goes on following its predecessor (``Scene.propagate_corrections``).

``select`` does not change the scene (but for settling poses); ``merging.py`` does, and only after a usable solve. The
problem has its origin at its oldest keyframe: far from the map's origin (UTM) no digits are lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray, changed
from ba_node.config import Config
from ba_node.core import geometry, native_kernels
from ba_node.core.problem import KeyframeFactors, Observations, Problem, State
from ba_node.kept import kept_property
from ba_node.scene.scene import Scene
from ba_node.window import arrival, constraints, gauge, moving, odometry, old_keyframes, trial, turns
from ba_node.window.initial_points import SPREAD, initial_points, poses_gate, widened
from ba_node.window.problems import Least, determined, part_of, problem_of, some_observations

# Views of a point are looked at, newest first, so many times as a solve may have: some keyframes are not refined.
_SPARE = 2
# An observation that begins this many times beyond the outlier gate sits out the solve. A point that comes to stand in
# the plane of a camera has a residual of 1e6 px or more; even weighted it would outweigh all the others.
_ABSURD = 25.0
# Rotations alone are looked for in windows, not in whole maps.
_MOST_TURNS = 200
# Places in the order of time by which sessions are told apart.
_APART = 10**9
# So many times as many points does a keyframe need where images have no scale of their own.
_WITHOUT_SCALE = 2
# Of the tracks that a keyframe shares with others so large a share has to have a place. If only few have, nothing shows
# parallax, and they are mismatches or worse. Where the front-end's steps tell no length either, as where a body turns
# on the spot, these are tracks whose noise feigns parallax, all to one side: then it is the second.
_PLACED, _PLACED_OF_STILL = 0.15, 0.6
# As many residuals of known points tell how good the poses are.
_BULK = 100


@dataclass(frozen=True)
class Selection:
    """A problem and where its parts stand in the scene."""

    problem: Problem  # with the inlier observations
    observations: Observations  # all observations of its points by its keyframes, inliers or not, sorted by point
    norms: FloatArray  # (n_all,) their residuals at the start, sigmas, inf behind the camera
    rows: IntArray  # (n_all,) row in the scene of each of these
    inlier: BoolArray  # (n_all,) True where it is in the problem
    keyframes: IntArray  # (n_kf,) row of each keyframe in the scene, oldest first
    landmarks: IntArray  # (n_pt,) row of each point, by track id
    window: IntArray  # rows of all keyframes of the window, those held out included, oldest first
    lost: IntArray  # rows of landmarks that have a position which their views contradict; they sit this solve out
    moving: BoolArray  # (n_pt,) points on objects that move, see ``moving.py``; not in the problem, but for their start
    much_moves: bool  # they are a large share of what is seen
    origin: FloatArray  # (3,) of the problem in the map, m
    unscaled: IntArray  # see ``gauge.Gauge``
    tried: IntArray  # points whose tracks a solution is tried on, see ``trial.py``
    held_out: BoolArray  # (n_pt,) those of them that are not in the problem, but for their start
    keyframe_id: IdArray  # (n_kf,) uint64
    place: IntArray  # (n_kf,) of each keyframe in the order of time; those of other sessions are far apart
    measured: tuple[FloatArray, FloatArray]  # the front-end's poses, body from world: (n_kf, 3, 3), (n_kf, 3) m
    strays: tuple[arrival.Stray, ...]  # keyframes that began in the wrong place
    beside: tuple[KeyframeFactors, ...] = ()  # factors of the problem that are no steps of the front-end

    @kept_property
    def used(self) -> IntArray:
        """Return which of all observations are in the problem, in its order."""
        return self.inlier.nonzero()[0]

    @kept_property
    def whole(self) -> Problem:
        """Return the problem with all observations, those that are left out too."""
        return changed(self.problem, observations=self.observations)

    def taking_part(self, scene: Scene) -> IntArray:
        """Return the keyframes of the window and of the problem, oldest first."""
        if (scene.numbers(self.window, self.keyframes) >= 0).all():  # as of most windows
            return self.keyframes
        return scene.by_time(scene.distinct(np.concatenate([self.window, self.keyframes])))

    def explained(self, state: State, kernels: str) -> trial.Explained:
        """Return how well the front-end's poses and those of a solution explain the tracks that they are tried on."""
        tracks = self.tried, int(np.count_nonzero(self.held_out))
        return trial.explained(self.whole, tracks, self.measured, (state.rotation, state.translation), kernels)


@dataclass(frozen=True)
class _Part:
    """What may take part: a problem with all poses fixed, and where its parts stand in the scene, as in Selection.

    ``turned`` are the keyframes whose orientations images alone tell; None if there are none.
    """

    problem: Problem
    rows: IntArray
    keyframes: IntArray
    landmarks: IntArray
    origin: FloatArray
    heard: BoolArray  # (n_obs,) False for outliers
    turned: turns.Turns | None = None

    def only(self, rows: IntArray, keyframes: BoolArray, points: BoolArray) -> _Part:
        """Return some of it, see ``part_of``."""
        problem = part_of(self.problem, rows, points, keyframes)
        turned = None if self.turned is None else self.turned.take(keyframes)
        places = self.rows.take(rows), self.keyframes[keyframes], self.landmarks[points]
        return _Part(problem, *places, self.origin, self.heard.take(rows), turned)


def rows_of(scene: Scene, config: Config, end: int | None = None) -> IntArray:
    """Return the keyframes of the newest window among the first ``end`` keyframes (all by default), oldest first."""
    return scene.order[:end][-old_keyframes.window_size(scene, config) :]


def select(scene: Scene, config: Config, end: int | None = None, without: tuple[int, ...] = ()) -> Selection | str:
    """Return the problem of the newest window among the first ``end`` keyframes, or why there is none.

    Keyframes of the rows ``without`` sit it out.
    """
    window = rows_of(scene, config, end)
    reason = _nothing(scene, window)
    if reason:
        return reason
    scene.propagate_corrections()
    known = old_keyframes.memory(scene, config, window)
    part, norms, strays = _arrived(scene, window, config, without)
    usable = _usable(part, norms, config.tracks.outlier_px)
    lost = _contradicted(scene, part, usable)
    moves = _moving(scene, part, norms, config)
    much_moves = moving.much(part.problem, moves)
    told = np.zeros(len(part.keyframes), bool)
    if known is not None:
        told = np.isin(scene.keyframes.keyframe_id[part.keyframes], known.keyframe_id)
    least = _least(scene, part, config, told)
    kept, keyframes, points = determined(part.problem, usable, moves, config.window.max_landmarks, least)
    part, norms, usable = part.only(kept, keyframes, points), norms.take(kept), usable.take(kept)
    moves = moves[points]
    usable &= ~moves.take(part.problem.observations.point)
    is_old = scene.numbers(part.keyframes, window) < 0
    if is_old.all():
        return "no keyframe of the window sees enough points that others see from another place, by rays that meet"
    obs, table = part.problem.observations, scene.keyframes
    track_id = scene.landmarks.track_id[part.landmarks]
    tried, aside = trial.choose(track_id, obs.point[usable], config.guard.held_out_tracks)
    held_out = np.zeros(len(part.landmarks), bool)
    held_out[aside] = True
    inlier = usable & ~held_out.take(obs.point)
    active = some_observations(part.problem, inlier.nonzero()[0])
    tied = odometry.ties(scene, config.odometry, part.keyframes)
    held = gauge.choose(active, is_old, tied)
    prior = None if known is None else known.factor(table.keyframe_id[part.keyframes], part.origin)
    if prior is not None:
        held = gauge.Gauge(is_old, np.full(len(is_old), -1))
    active = changed(active, fixed=held.fixed)
    told = np.where(usable, norms, np.nan)
    doubt = odometry.Doubt(much_moves, odometry.noise_of(part.problem, table.refined[part.keyframes], told))
    steps = odometry.factors(scene, config.odometry, active, part.keyframes, part.turned, doubt, tied)
    beside = constraints.factors(scene, config, active, part.keyframes, part.origin)
    factors = constraints.in_place(steps, beside)
    factors += () if prior is None else (prior,)
    priors = constraints.point_priors(scene, config, part.landmarks, part.origin)
    return Selection(
        problem=changed(active, factors=factors, point_priors=priors),
        observations=obs,
        norms=norms,
        rows=part.rows,
        inlier=inlier,
        keyframes=part.keyframes,
        landmarks=part.landmarks,
        window=window,
        lost=lost,
        moving=moves,
        much_moves=much_moves,
        origin=part.origin,
        unscaled=held.unscaled,
        tried=tried,
        held_out=held_out,
        keyframe_id=table.keyframe_id[part.keyframes],
        place=scene.places()[part.keyframes] + _APART * scene.sessions_of(part.keyframes),
        measured=_measured(scene, part),
        strays=strays,
        beside=tuple(beside),
    )


def _arrived(
    scene: Scene, window: IntArray, config: Config, without: tuple[int, ...]
) -> tuple[_Part, FloatArray, tuple[arrival.Stray, ...]]:
    """Return what may take part, its residuals at the start (sigmas), and the keyframes that began in a wrong place."""
    part, norms = _begun(scene, window, config, np.array(without, np.intp))
    if not config.guard.enabled:
        return part, norms, ()
    astray = arrival.strays(scene, config, part.problem, part.keyframes, part.landmarks, norms)
    if not len(astray):
        return part, norms, ()
    strays = arrival.place(scene, config, astray)
    left_out = [*without, *(stray.row for stray in strays if not stray.found)]
    return *_begun(scene, window, config, np.array(left_out, np.intp)), strays


def _measured(scene: Scene, part: _Part) -> tuple[FloatArray, FloatArray]:
    table, rows = scene.keyframes, part.keyframes
    return geometry.inverse(table.input_rotation[rows], table.input_position[rows] - part.origin)


def _begun(scene: Scene, window: IntArray, config: Config, without: IntArray) -> tuple[_Part, FloatArray]:
    """Return what may take part, with a first position for points that have none, and its residuals there, sigmas.

    Positions are NaN where none can be had yet.
    """
    part = _turned(scene, _reach(scene, window, config, without), window, config)
    problem, kernels, new = part.problem, config.solver.kernels, ~scene.landmarks.has_position[part.landmarks]
    points = np.where(new[:, None], 0.0, problem.start.points)
    start = changed(problem.start, points=points)  # what is put into these is put into it
    norms = native_kernels.residual_norms(problem, start, kernels)
    of_new = new.take(problem.observations.point)
    points[new] = np.nan
    rows = (of_new & part.heard).nonzero()[0]
    if len(rows):
        points[new] = _first_positions(scene, part, rows, (new, norms[part.heard & ~of_new]), config)
        at = changed(start, points=np.where(np.isnan(points), 0.0, points))
        rows = of_new.nonzero()[0]
        norms[rows] = native_kernels.residual_norms(problem, at, kernels, rows)
    return changed(part, problem=changed(problem, start=start)), norms


def _first_positions(
    scene: Scene, part: _Part, rows: IntArray, among: tuple[BoolArray, FloatArray], config: Config
) -> FloatArray:
    """Return first positions (n_new, 3) of the points that have none, of which ``rows`` are the inlier observations.

    ``among`` tells which they are, (n_pt,), and how far off the views of the others are, sigmas.
    """
    new, norms = among
    of_new = part_of(part.problem, rows, new)
    guess = moved_guesses(scene, part.landmarks[new]) - part.origin
    if len(norms) < _BULK:
        gate = poses_gate(of_new, config.tracks, config.solver.kernels)
    else:
        gate = widened(config.tracks.max_triangulation_px, norms)
    return initial_points(of_new, guess, config.tracks, gate, config.solver.kernels)


def _nothing(scene: Scene, window: IntArray) -> str:
    if scene.cameras is None and scene.refused_rig:
        return f"no camera rig that can be used: {scene.refused_rig}"
    if scene.cameras is None:
        return "no camera rig yet: nothing is known about the cameras"
    if len(window) == 0:
        return "no keyframe yet"
    if len(scene.keyframes) == 1:
        return "one keyframe only: nothing to refine against"
    return ""


def _reach(scene: Scene, window: IntArray, config: Config, without: IntArray) -> _Part:
    """Return all observations of the window's landmarks by the window and the older keyframes that share most.

    Keyframes of ``without`` take no part, nor do landmarks that they alone see.
    """
    taking_part = window[~np.isin(window, without)] if len(without) else window
    landmarks = scene.seen_by(taking_part)
    views = scene.views_of(landmarks, _views_needed(scene, window, config.window.max_fixed_keyframes))
    known = old_keyframes.memory(scene, config, window)
    if known is not None:
        views = views[known.takes_part(scene, views, window)]
    older = _older(scene, window, views)
    older = older[: 0 if config.window.old_keyframes == "drop" else config.window.max_fixed_keyframes]
    keyframes = scene.by_time(np.concatenate([taking_part, older]))
    origin = scene.keyframes.position[keyframes[0]] if len(keyframes) else np.zeros(3)
    positions = scene.landmarks.position[landmarks] - origin
    problem, rows = problem_of(scene, views, keyframes, landmarks, origin, positions, config)
    return _Part(problem, rows, keyframes, landmarks, origin, ~scene.observations.outlier.take(rows))


def _views_needed(scene: Scene, window: IntArray, n_fixed: int) -> int | None:
    """Return how many of the newest views of a point may matter, None for all of them.

    Who stands still sees the same points in thousands of keyframes, and to gather all of these takes longer and longer.
    Those before the newest few share no more points with the window than these do.
    """
    if not len(window) or window[-1] != scene.order[-1]:
        return None  # newer keyframes wait behind the window
    images = max(len(scene.blocks[row]) for row in window.tolist())
    return _SPARE * images * (len(window) + n_fixed)


def _older(scene: Scene, window: IntArray, views: IntArray) -> IntArray:
    """Return the refined keyframes before a window that see its points, those first that share most with it.

    ``views`` are the observations of its points. A keyframe that was never refined would only hold the others to the
    front-end's drift.
    """
    seeing, shared = scene.inliers_by_keyframe(views)
    place = scene.places()[seeing]
    older = (place < (int(scene.places()[window[0]]) if len(window) else 0)) & scene.keyframes.refined[seeing]
    # Of those that share equally many the newest are taken.
    return seeing[older][np.lexsort((-place[older], -shared[older]))]


def _turned(scene: Scene, part: _Part, window: IntArray, config: Config) -> _Part:
    """Return a part that begins with the orientations that images alone tell."""
    if not config.odometry.enabled or len(part.keyframes) > _MOST_TURNS:
        return part
    of_window = (scene.numbers(part.keyframes, window) >= 0).take(part.problem.observations.keyframe)
    placed = scene.landmarks.has_position[part.landmarks]
    found = turns.find(part.problem, part.keyframes, of_window & part.heard, placed)
    if found is None:
        return part
    free = ~scene.keyframes.refined[part.keyframes]
    return changed(part, problem=found.applied(part.problem, part.keyframes, free), turned=found)


def moved_guesses(scene: Scene, landmarks: IntArray) -> FloatArray:
    """Return the guesses of landmarks moved from the front-end's frame to the refined map, NaN where there is none.

    Each is moved by the correction of the earliest keyframe that sees it: a front-end's point is anchored to the
    view that it was first seen in, and this choice does not depend on when the message came.
    """
    has_guess = scene.landmarks.has_guess[landmarks, None]
    guess = np.where(has_guess, scene.landmarks.guess[landmarks], np.nan)
    if not has_guess.any():
        return guess
    rows = scene.views_of(landmarks[has_guess[:, 0]])
    first = np.full(len(landmarks), len(scene.order) - 1)
    number = scene.numbers(scene.observations.landmark[rows], landmarks)
    np.minimum.at(first, number, scene.places()[scene.observations.keyframe[rows]])
    rotation, translation = scene.corrections(scene.order[first])
    return np.asarray((rotation @ guess[:, :, None])[..., 0] + translation)


def _usable(part: _Part, norms: FloatArray, outlier_px: float) -> BoolArray:
    """Return which observations may take part: no outliers, and none that begins with an absurd residual."""
    usable = part.heard
    if outlier_px <= 0:
        return usable
    obs = part.problem.observations
    gate = _ABSURD * outlier_px
    placed = ~np.isnan(part.problem.start.points[:, 0])
    far = (norms > gate) & placed.take(obs.point)
    if not far.any():
        return usable
    # By keyframe: where most residuals of a keyframe are large, its pose is wrong, and the solve is to mend that.
    classified = usable & placed.take(obs.point)
    n_kf = len(part.keyframes)
    large = np.bincount(obs.keyframe[classified & (SPREAD * norms > gate)], minlength=n_kf)
    has_far = np.bincount(obs.keyframe[far], minlength=n_kf) > 0
    suspect = (2 * large >= np.bincount(obs.keyframe, classified, n_kf)) & has_far
    for k in np.flatnonzero(suspect):
        own = np.flatnonzero(obs.keyframe == k)
        far[own] = norms[own] > widened(gate, norms[own[classified[own]]], 1)
    return usable & ~far


def _least(scene: Scene, part: _Part, config: Config, told: BoolArray) -> Least:
    """Return what each keyframe has to see: more where images have no scale of their own.

    Not more points where a prior has ``told`` of one (n_kf,): window by window, what it still sees would be lost.
    """
    points = config.guard.min_points if config.guard.enabled else 2
    more = _WITHOUT_SCALE if config.guard.enabled and not part.problem.has_scale else 1
    still = np.zeros(len(told), bool)
    if not part.problem.has_scale:
        still = odometry.tell_nothing(scene, config.odometry, part.keyframes)
    return Least(np.where(told, points, more * points), np.where(still, _PLACED_OF_STILL, _PLACED))


def _moving(scene: Scene, part: _Part, norms: FloatArray, config: Config) -> BoolArray:
    """Return which points move; none where outliers are kept."""
    if config.tracks.outlier_px <= 0 or not config.guard.enabled:
        return np.zeros(len(part.landmarks), bool)
    unrefined = ~scene.keyframes.refined[part.keyframes]
    return moving.moving(part.problem, norms, unrefined, config.solver.kernels)


def _contradicted(scene: Scene, part: _Part, usable: BoolArray) -> IntArray:
    """Return the rows of placed landmarks that absurd residuals leave with too few views, by track id."""
    obs, n = part.problem.observations, len(part.landmarks)
    doubted = np.zeros(n, bool)
    doubted[obs.point[part.heard & ~usable]] = True
    rows = doubted.take(obs.point).nonzero()[0]
    if not len(rows):
        return part.landmarks[:0]
    point = obs.point[rows]
    weight = np.where(np.isfinite(obs.depth_m[rows]), 2, 1) if len(obs.depth_m) else np.ones(len(rows))
    before = np.bincount(point, weight * part.heard[rows], n)
    after = np.bincount(point, weight * usable[rows], n)
    return part.landmarks[scene.landmarks.has_position[part.landmarks] & (before >= 2) & (after < 2)]
