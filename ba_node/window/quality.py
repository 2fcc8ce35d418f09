# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say how well a map explains what was seen: root mean square reprojection errors per coordinate, px."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import Config
from ba_node.core import geometry, objective, triangulation
from ba_node.core.problem import KeyframeFactors, Problem, State
from ba_node.core.result import Result
from ba_node.scene.scene import Scene
from ba_node.window.problems import problem_of
from ba_node.window.selection import Selection

STATES = ("input", "refined")
# A residual that is longer counts as this: it tells no more than that it is wrong.
BOUND_PX = 1000.0
# A factor that is this many scales of a loss off that fades pulls at a twentieth of its weight, or less.
_OUTVOTED, _FADING = 5.0, ("cauchy", "geman_mcclure")
# And this by its sigma_px, where two states are compared: outliers are as far off in the one as in the other.
_COMPARED_SIGMAS = 10.0
# No noise is so many sigmas off.
_WILD = 10.0


def rms_of_norms_px(selection: Selection, norms: FloatArray) -> float:
    """Return the rms over the observations of a solve whose point is in front of the camera; 0 without any.

    One that is farther off than ``BOUND_PX`` counts as that: a point in the plane of a camera is anywhere.
    """
    error = norms.take(selection.used) * selection.problem.observations.sigma_px
    if not np.isfinite(error).all():
        error = error[np.isfinite(error)]
    error = np.minimum(error, BOUND_PX)
    return float(np.sqrt(np.mean(error * error) / 2.0)) if len(error) else 0.0


def statistics(selection: Selection, result: Result, norms: FloatArray) -> dict[str, Any]:
    """Return how a solve went, by the names of a report; ``norms`` (n_all,) are the residuals after it."""
    problem = selection.problem
    return {
        "status": result.status,
        "reason": result.reason,
        "method": result.method,
        "iterations": max(len(result.trace) - 1, 0),
        "accepted_iterations": result.accepted_iterations,
        "linear_iterations": result.linear_iterations,
        "objective_before": result.objective_before,
        "objective_after": result.objective_after,
        "gradient_norm": result.gradient_norm,
        "rms_px_before": rms_of_norms_px(selection, selection.norms),
        "rms_px_after": rms_of_norms_px(selection, norms),
        "weakest_m": result.weakest[0],
        "weakest_rad": result.weakest[1],
        "keyframes": int(np.count_nonzero(~problem.fixed)),
        "fixed_keyframes": int(np.count_nonzero(problem.fixed)),
        "landmarks": problem.n_points,
        "observations": len(problem.observations),
        "held_keyframes": len(set(selection.window.tolist()) - set(selection.keyframes.tolist())),
        "factors": problem.n_factors + (0 if problem.point_priors is None else len(problem.point_priors.point)),
        "outvoted_factors": sum(_outvoted(kind, result.state) for kind in selection.beside),
        "outliers": int(np.count_nonzero(~selection.inlier & ~selection.held_out[selection.observations.point])),
    }


def note_unbounded(scene: Scene, config: Config, norms: FloatArray) -> None:
    """Say so where mismatches draw a solution and nothing bounds by how much, as somebody asked for that."""
    if config.solver.loss != "squared" or config.tracks.outlier_px > 0.0:
        return
    wild = int(np.count_nonzero(norms > _WILD))
    if wild:
        scene.log.warn(
            "unbounded",
            f"{wild} of {len(norms)} observations are over {_WILD:g} sigmas off, and nothing bounds how far each draws"
            " the map: set solver.loss to auto, or tracks.outlier_px to 6",
        )


def _outvoted(kind: KeyframeFactors, state: State) -> int:
    """Return how many factors of a kind are so far off that their loss lets them pull at next to nothing."""
    if kind.loss not in _FADING:
        return 0
    return int(np.count_nonzero(np.linalg.norm(kind.residuals(state), axis=1) > _OUTVOTED * kind.loss_scale))


def rms_px(scene: Scene, config: Config, state: str) -> float:
    """Return the rms over all observations of a scene, outliers too, of tracks with two views; 0 without any.

    Args: as of :func:`errors_px`.
    """
    return _rms(errors_px(scene, config, state))


def summary(scene: Scene, config: Config, state: str) -> dict[str, float | int | None]:
    """Return how well a state explains the observations: one wild outlier rules the rms of all, so that is not all.

    Args: as of :func:`errors_px`.

    Returns:
        ``rms_px`` of all observations, ``rms_px_without_outliers`` of those that solves use now, ``median_px`` of the
        lengths of all residuals, ``median_sigmas`` the same by their ``sigma_px``, ``bounded_px`` the rms of all with
        none above 10 of these, ``observations_behind``, which count in none of these. None where no point is placed.
    """
    problem, _, error = _evaluated(scene, config, state, outliers=True)
    behind = int(np.count_nonzero(np.isnan(error[:, 0])))
    sigma_px = np.ones(len(error)) if problem is None else problem.observations.sigma_px
    sigmas = np.hypot(*error.T) / sigma_px
    bounded = (np.minimum(sigmas, _COMPARED_SIGMAS) * sigma_px)[~np.isnan(sigmas)]
    error, inliers = _in_front(error), errors_px(scene, config, state, outliers=False)
    length = np.hypot(error[:, 0], error[:, 1])
    return {
        "rms_px": _rms(error) if len(error) else None,
        "rms_px_without_outliers": _rms(inliers) if len(inliers) else None,
        "median_px": float(np.median(length)) if len(error) else None,
        "median_sigmas": float(np.nanmedian(sigmas)) if len(error) else None,
        "bounded_px": float(np.sqrt(np.mean(bounded**2) / 2.0)) if len(error) else None,
        "observations_behind": behind,
    }


def errors_px(scene: Scene, config: Config, state: str, *, outliers: bool = True) -> FloatArray:
    """Return predicted minus measured, (n, 2) px, of the observations of tracks with two views that are in front.

    Args:
        scene: the map.
        config: for the precision of depths, which triangulation uses.
        state: ``refined``: poses and points as they are now; ``input``: the front-end's poses and guesses, points
            without a guess triangulated.
        outliers: count also the observations that are left out of solves as outliers.
    """
    return _in_front(_all_errors(scene, config, state, outliers=outliers))


@dataclass(frozen=True)
class Residuals:
    """How well a map explains each of its observations of tracks with two views, and what its tracks are like."""

    error: FloatArray  # (n, 2) predicted minus measured, px; NaN where the point is not in front
    uv: FloatArray  # (n, 2) measured, px
    sigma_px: FloatArray  # (n,) standard deviation of u and of v, px
    camera: IntArray  # (n,) index into the rig
    keyframe: IntArray  # (n,) place of the keyframe, oldest first
    outlier: BoolArray  # (n,) True where it sits out the next solve
    views: IntArray  # (n_pt,) observations of each track
    parallax_deg: FloatArray  # (n_pt,) largest angle between two of its rays, deg; NaN where that is not known

    @classmethod
    def none(cls) -> Residuals:
        """Return those of a map without observations."""
        few, whole = np.empty(0), np.empty(0, np.intp)
        return cls(np.empty((0, 2)), np.empty((0, 2)), few, whole, whole, np.empty(0, bool), whole, few)


def residuals(scene: Scene, config: Config, state: str) -> Residuals:
    """Return the residuals of all observations, outliers too.

    Args: as of :func:`errors_px`.
    """
    problem, rows, error = _evaluated(scene, config, state, outliers=True)
    if problem is None:
        return Residuals.none()
    obs = problem.observations
    found = triangulation.triangulate(triangulation.rays_of(problem), problem.n_points)
    return Residuals(
        error,
        obs.uv,
        obs.sigma_px,
        obs.camera,
        obs.keyframe,
        np.asarray(scene.observations.outlier[rows]),
        np.bincount(obs.point, minlength=problem.n_points),
        np.degrees(found.parallax_rad),
    )


def _all_errors(scene: Scene, config: Config, state: str, *, outliers: bool) -> FloatArray:
    """Return the same with NaN for those whose point is not in front."""
    return _evaluated(scene, config, state, outliers=outliers)[2]


def _evaluated(
    scene: Scene, config: Config, state: str, *, outliers: bool
) -> tuple[Problem | None, IntArray, FloatArray]:
    """Return the problem of the observations, their rows in the scene, and the errors; no problem without any."""
    if state not in STATES:
        raise ValueError(f"state {state!r}: expected one of {', '.join(STATES)}")
    none = None, np.empty(0, np.intp), np.empty((0, 2))
    if scene.cameras is None or len(scene.keyframes) == 0:
        return none
    table = scene.landmarks
    seen_twice = table.views >= 2
    if not scene.keyframes.refined.any() and not table.has_position.any():
        # Nothing was taken: what came in stands.
        state = "input"
    if state == "refined":
        seen_twice &= table.has_position
    landmarks = np.flatnonzero(seen_twice)
    rows = scene.views_of(landmarks)
    if not outliers:
        rows = rows[~scene.observations.outlier[rows]]
    if not len(rows):
        return none
    origin = scene.keyframes.position[scene.order[0]]
    positions = table.position[landmarks] - origin
    problem, rows = problem_of(scene, rows, scene.order, landmarks, origin, positions, config)
    if state == "refined":
        return problem, rows, objective.reprojection_errors(problem, problem.start)
    return problem, rows, _input_errors(scene, problem, table.guess[landmarks] - origin, origin)


def _input_errors(scene: Scene, problem: Problem, guess: FloatArray, origin: FloatArray) -> FloatArray:
    order = scene.order
    poses = geometry.inverse(scene.keyframes.input_rotation[order], scene.keyframes.input_position[order] - origin)
    # Start points are not looked at by the triangulation.
    problem = dataclasses.replace(problem, start=State(*poses, np.zeros_like(guess), problem.start.intrinsics))
    missing = np.asarray(np.isnan(guess).any(axis=1))
    found = triangulation.triangulate(triangulation.rays_of(problem), problem.n_points)
    points = np.where(missing[:, None], found.points, guess)
    return objective.reprojection_errors(problem, dataclasses.replace(problem.start, points=points))


def _in_front(error: FloatArray) -> FloatArray:
    return error[~np.isnan(error[:, 0])]


def _rms(error: FloatArray) -> float:
    """Return the rms of residuals (n, 2), px, none of which counts for more than BOUND_PX."""
    squared = np.minimum(np.sum(error * error, axis=1), BOUND_PX**2)
    return float(np.sqrt(np.mean(squared) / 2.0)) if len(error) else 0.0
