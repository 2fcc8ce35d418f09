# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put the solution of a window back into the scene, and classify its observations and points anew."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray, changed
from ba_node.config import TracksConfig
from ba_node.core import geometry, native_kernels
from ba_node.core.problem import Observations, Problem, State
from ba_node.core.result import Result
from ba_node.scene.scene import Scene
from ba_node.window import depths, gauge
from ba_node.window.initial_points import agreed_points, widened
from ba_node.window.problems import part_of
from ba_node.window.reuse import note_reuse, part_reused
from ba_node.window.selection import Selection
from ba_node.window.trial import Explained

# A point so many times as far away as the whole window's parallax can tell is anywhere.
_NOTICED = 10.0
# A point that moves by this share of its distance leaps.
_LEAP = 0.5
# From as many keyframes on it is said that tracks move, if more than this share do.
_KNOWN_KEYFRAMES = 15
_MANY_MOVING = 0.2


class Merged(NamedTuple):
    """What came of a result."""

    # (n_all,) the sizes of the residuals after it, as ``Selection.norms``; without a usable result these
    norms: FloatArray
    state: State | None  # the solution in the scale that it has in the map; None without a usable result
    explained: Explained | None = None  # how well its poses explain the tracks that they are tried on; None likewise


def merge(scene: Scene, selection: Selection, result: Result, tracks: TracksConfig, kernels: str = "auto") -> Merged:
    """Put the refined poses and points of a usable, finite result into the scene and classify its observations anew."""
    found = returned(selection, outcome(scene, selection, result, kernels), tracks, kernels)
    if found.state is None:
        return found
    put_poses(scene, selection, found.state)
    return found._replace(norms=apply(scene, selection, found.state, found.norms, tracks, kernels))


def outcome(scene: Scene, selection: Selection, result: Result, kernels: str = "auto") -> Merged:
    """Return what came of a result, in the scale of the map; the scene stays as it is.

    It is to be judged by that; before points are published those that ran away are to be :func:`returned`.
    """
    if not result.status.usable or not result.state.is_finite():
        return Merged(selection.norms, None)
    state = scaled(selection, scene.keyframes.input_position[selection.keyframes], result.state)
    return _placed(selection, state, kernels)


def settled(selection: Selection, state: State, tracks: TracksConfig, kernels: str = "auto") -> Merged:
    """Return a solution with its points where they may be published, see ``Merged``."""
    return returned(selection, _placed(selection, state, kernels), tracks, kernels)


def _placed(selection: Selection, state: State, kernels: str) -> Merged:
    """Return a solution in which points that took no part are placed by their rays."""
    explained = selection.explained(state, kernels)
    found = explained.points
    if len(found):
        points, aside = state.points.copy(), selection.tried[: len(found)]
        points[aside] = np.where(np.isnan(found), points[aside], found)
        state = changed(state, points=points)
    return Merged(native_kernels.residual_norms(selection.whole, state, kernels), state, explained)


def returned(selection: Selection, found: Merged, tracks: TracksConfig, kernels: str = "auto") -> Merged:
    """Return what was found with points that ran away back where they began; its norms are written over.

    They are those that have left to where fewer of their views agree, or so far away that no view would notice. If one
    was there already, no view is left to it.
    """
    if found.state is None:
        return found
    state, norms, gate = found.state, found.norms, tracks.outlier_px or np.inf
    whole, point = selection.whole, selection.observations.point
    doubted, agreeing, away, began, leapt = _doubted(selection, state, norms, gate, kernels)
    rows = doubted.take(point).nonzero()[0]
    if not len(rows):
        return found
    point = point.take(rows)
    before = native_kernels.residual_norms(whole, changed(state, points=whole.start.points), kernels, rows)
    support = np.bincount(point[before <= gate], minlength=whole.n_points)
    # A leap has to be borne out by more views than there were.
    better = support + leapt > agreeing
    back, lost = doubted & ~began & (better | away), doubted & began & away
    went = back.take(point)
    norms[rows[went]] = before[went]
    norms[rows[lost.take(point)]] = np.inf
    points = state.points.copy()
    points[back] = whole.start.points[back]
    return found._replace(state=changed(state, points=points))


def _doubted(
    selection: Selection, state: State, norms: FloatArray, gate: float, kernels: str
) -> tuple[BoolArray, IntArray, BoolArray, BoolArray, BoolArray]:
    """Return which points may have run away, (n_pt,), and how many views agree with each.

    And which are too far away, which began there, and which have leapt.
    """
    point, n = selection.observations.point, selection.problem.n_points
    points, start = state.points, selection.problem.start.points
    position = -(np.swapaxes(state.rotation, 1, 2) @ state.translation[:, :, None])[..., 0]
    centre, limit = position.mean(axis=0), _noticed_m(selection, position)
    measured = _has_depth(selection.observations, n)
    if kernels != "numpy" and native.kernels is not None:
        limits = gate, limit, _LEAP
        found: tuple[BoolArray, IntArray, BoolArray, BoolArray, BoolArray] = native.kernels.may_have_run_away(
            point, norms, (points, start), (centre, measured), limits
        )
        return found
    away, began = ((_largest(where - centre) > limit) & ~measured for where in (points, start))
    agreeing = np.bincount(point[norms <= gate], minlength=n)
    leapt = _largest(points - start) > _LEAP * _largest(start - centre)
    return away | leapt | (2 * agreeing < np.bincount(point, minlength=n)), agreeing, away, began, leapt


def _largest(vectors: FloatArray) -> FloatArray:
    """Return the largest coordinate of each of (n, 3) vectors, without its sign."""
    # numpy takes ten times as long for the largest of rows that are so short.
    x, y, z = np.abs(vectors.T)
    return np.asarray(np.maximum(np.maximum(x, y), z))


def _has_depth(observations: Observations, n: int) -> BoolArray:
    """Return of which of ``n`` points a distance was measured, which tells it however little keyframes are apart."""
    found = np.zeros(n, bool)
    if len(observations.depth_m):
        found[observations.point[np.isfinite(observations.depth_m)]] = True
    return found


def _noticed_m(selection: Selection, position: FloatArray) -> float:
    """Return how far away a point may be: farther, the steps of the whole window move it by less than its noise.

    ``position`` (n_kf, 3) is that of the keyframes, m.
    """
    cams, obs = selection.problem.cameras, selection.observations
    spread = max(float((where.max(axis=0) - where.min(axis=0)).max()) for where in (position, cams.translation))
    return _NOTICED * spread * float(cams.params[0, 0]) / float(obs.sigma_px[0])


def put_poses(scene: Scene, selection: Selection, state: State, without: tuple[int, ...] = ()) -> None:
    """Put the poses of a solution, in the scale of the map, into the scene; keyframes of ``without`` had none."""
    free = ~selection.problem.fixed
    rotation, position = geometry.inverse(state.rotation[free], state.translation[free])
    rows, table = selection.keyframes[free], scene.keyframes
    table.rotation[rows] = geometry.nearest_rotation(rotation)
    table.position[rows] = position + selection.origin
    left_out = np.array(without, np.intp)
    scene.moved(np.concatenate([selection.keyframes[free | ~table.refined[selection.keyframes]], left_out]))
    table.refined[selection.keyframes] = True
    table.refined[left_out] = False


def apply(
    scene: Scene, selection: Selection, state: State, norms: FloatArray, tracks: TracksConfig, kernels: str = "auto"
) -> FloatArray:
    """Put the points of a solution into the scene, whose poses are there, and classify its observations anew.

    ``norms`` (n_all,) are the sizes of its residuals, as ``Selection.norms``; they are written over, and returned.

    Returns:
        (n_all,) sizes of the residuals, as ``Selection.norms``.
    """
    scene.landmarks.position[selection.landmarks] = state.points + selection.origin
    scene.landmarks.has_position[selection.landmarks] = True
    classify(scene, selection, state, norms, tracks, kernels)
    _displace(scene, selection.lost)
    _note_moving(scene, selection)
    depths.note_wrong(scene, selection, state)
    return norms


def _note_moving(scene: Scene, selection: Selection) -> None:
    """Say that many tracks move, once the map is known well enough to tell."""
    count, of = int(np.count_nonzero(selection.moving)), len(selection.moving)
    if selection.problem.n_keyframes >= _KNOWN_KEYFRAMES and count > _MANY_MOVING * of:
        scene.log.warn(
            "moving",
            f"{count} of {of} tracks of the window move against the rest, as those on objects that move do, or those"
            " that slip off their points: they were left out of the solve; the motion that the others and the front-end"
            " agree on was taken",
        )


def scaled(selection: Selection, measured: FloatArray, state: State) -> State:
    """Give the parts whose scale floats the scale of some steps: the front-end's, unless the map has one already.

    ``measured`` (n_kf, 3) are the positions of the keyframes in that scale, m.
    """
    if (selection.unscaled < 0).all():
        return state
    obs = selection.problem.observations
    rotation, position = geometry.inverse(state.rotation, state.translation)
    points = state.points.copy()
    for anchor in np.unique(selection.unscaled[selection.unscaled >= 0]):
        members = selection.unscaled == anchor
        centre = position[anchor].copy()
        scale = gauge.step_ratio(measured[members], position[members])
        position[members] = centre + scale * (position[members] - centre)
        hanging = np.zeros(len(points), bool)
        hanging[obs.point[members.take(obs.keyframe)]] = True
        points[hanging] = centre + scale * (points[hanging] - centre)
    _, translation = geometry.inverse(rotation, position)
    return changed(state, translation=translation, points=points)


def classify(
    scene: Scene, selection: Selection, state: State, norm: FloatArray, tracks: TracksConfig, kernels: str = "auto"
) -> None:
    """Mark the observations to leave out next time, and note the error of each point.

    The gate widens with the bulk of the residuals, so that an early, bad window does not lose its points. A point that
    fewer than half of its views agree with is placed anew where more of them do. One with fewer than two good views
    (or one with a measured depth) is in the wrong place, or its track is: it loses its position, and all its views are
    heard again when it is next placed. ``norm`` are the sizes of the residuals; those of what is placed anew are
    written over.
    """
    obs, n_points, outlier_px = selection.observations, selection.problem.n_points, tracks.outlier_px
    whole = changed(selection.problem, observations=obs, start=state)
    # What was left out of the solve tells nothing about how good it is.
    gate = widened(outlier_px, norm.take(selection.used)) if outlier_px > 0 else np.inf
    outlier = norm > gate
    if outlier_px > 0:
        _place_anew(scene, selection, whole, (norm, outlier), tracks, kernels)
    scene.observations.outlier[selection.rows] = outlier
    if outlier_px > 0:
        worth = ~outlier * np.where(np.isfinite(obs.depth_m), 2, 1) if len(obs.depth_m) else ~outlier
        good = np.bincount(obs.point, worth, n_points)
        _displace(scene, selection.landmarks[good < 2])
    error = norm * obs.sigma_px
    scene.landmarks.rms_px[selection.landmarks] = _rms_by_point(error * error, obs.point, ~outlier, n_points)
    scene.landmarks.changed(selection.landmarks)
    if outlier_px > 0:
        note_reuse(scene, part_reused(scene, selection, whole, norm, gate, kernels))


def _place_anew(
    scene: Scene,
    selection: Selection,
    whole: Problem,
    classified: tuple[FloatArray, BoolArray],
    tracks: TracksConfig,
    kernels: str,
) -> None:
    """Move the points that most views contradict to where more of them agree; write their norms and outliers over."""
    norm, outlier = classified
    point, n_points = whole.observations.point, whole.n_points
    good = np.bincount(point, ~outlier, n_points)
    doubted = 2 * good < np.bincount(point, minlength=n_points)
    rows = doubted.take(point).nonzero()[0]
    if not len(rows):
        return
    views = part_of(whole, rows, doubted)
    found = agreed_points(views, tracks, tracks.outlier_px, kernels)
    start = changed(views.start, points=found.points)
    at = native_kernels.residual_norms(views, start, kernels)
    supports = at <= tracks.outlier_px
    better = found.good & (np.bincount(views.observations.point, supports, views.n_points) > good[doubted])
    moved = better.take(views.observations.point)
    norm[rows[moved]], outlier[rows[moved]] = at[moved], ~supports[moved]
    landmarks = selection.landmarks[doubted][better]
    scene.landmarks.position[landmarks] = found.points[better] + selection.origin


def _displace(scene: Scene, landmarks: IntArray) -> None:
    """Take the position of landmarks away; all their views are heard again when they are next placed."""
    scene.landmarks.has_position[landmarks] = False
    scene.landmarks.changed(landmarks)
    scene.observations.outlier[scene.views_of(landmarks)] = False


def _rms_by_point(squared: FloatArray, point: IntArray, inlier: BoolArray, n_points: int) -> FloatArray:
    """Return the root mean square error per coordinate of each point's inlier observations, px."""
    good = np.asarray(inlier & np.isfinite(squared))
    total = np.bincount(point, np.where(good, squared, 0.0), n_points)
    count = np.bincount(point, good, n_points)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(total / (2 * count)))
