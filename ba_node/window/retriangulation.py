# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Triangulate anew what windows have given up, and refine the keyframes that were left out for want of points.

Where one camera sees few tracks and the front-end's turns are off by degrees, rays meet nowhere: points stay without a
place, keyframes without points are not refined, and all that is known between what lies before and after them is the
front-end's step. So it is with several cameras where such turns have held the windows. Once a loop has bent the map,
such gaps are closed, at once where images tell no lengths, else after a solve of all the rest. It is done in rounds (as
COLMAP's retriangulation does: Schoenberger and Frahm, *Structure-from-Motion Revisited*, CVPR 2016). In each, every
track without a place begins where its rays come nearest to each other, however far off that is, or at a usual distance
along them; all is solved with a robust loss that narrows from wide to its usual width, the steps between keyframes
being squares, so that no keyframe of few tracks leaves them; and observations are classified anew.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.config import Config
from ba_node.core import native_kernels, solver, triangulation
from ba_node.core.factors import RelativePoses
from ba_node.core.problem import Problem, State
from ba_node.scene.scene import Scene
from ba_node.window import full
from ba_node.window.problems import MIN_OBSERVATIONS, problem_of

_ROUNDS = 12
# Widths of the loss, sigmas, and iterations with each; the last is as wide as for all else.
_WIDTHS, _ITERATIONS = (60.0, 20.0, 6.0, 2.0), (15, 15, 15, 50)
# The objective is to fall by this share within so many rounds.
_LEAST_GAIN, _PATIENCE = 0.001, 2
# Rays that meet farther or nearer than so many times the median distance of points do not tell a place.
_FAR, _NEAR = 10.0, 0.1


def has_scale(scene: Scene) -> bool:
    """Return whether images tell lengths: several cameras, or depths."""
    several = scene.cameras is not None and len(scene.cameras.model) > 1
    return several or bool(np.isfinite(scene.observations.depth_m).any())


def close_gaps(scene: Scene, config: Config) -> Config:
    """Triangulate and refine what was left out; return the parameters to go on with.

    With these keyframes of few points are refined: steps are factors, which hold them too.
    """
    if scene.cameras is None or scene.keyframes.refined.all():
        return config
    eager = dataclasses.replace(config, guard=dataclasses.replace(config.guard, min_points=MIN_OBSERVATIONS // 2))
    least, since = np.inf, 0
    for _ in range(_ROUNDS):
        _place_roughly(scene, config)
        taken = full.take_snapshot(scene, eager, bent=True)
        if isinstance(taken, str):
            break
        objective = _solve(taken, config)
        found = taken.outcome(taken.result.state, config)
        if found.state is None or not found.state.is_finite():
            break
        full.merge_snapshot(scene, config, taken, found.state)
        least, since = (objective, 0) if objective < (1.0 - _LEAST_GAIN) * least else (least, since + 1)
        if since == _PATIENCE:
            break
    return eager


def _solve(taken: full.Optimization, config: Config) -> float:
    """Solve with a loss that narrows and steps that are squares; return the objective at the end."""
    problem = taken.selection.problem
    squares = tuple(
        dataclasses.replace(one, loss="squared") if isinstance(one, RelativePoses) else one for one in problem.factors
    )
    problem = dataclasses.replace(problem, factors=squares)
    chosen = full.options(config.solver)
    for width, iterations in zip(_WIDTHS, _ITERATIONS, strict=True):
        now = dataclasses.replace(chosen, loss="cauchy", loss_scale_px=width, max_iterations=iterations)
        result = solver.solve(problem, now)
        problem = dataclasses.replace(problem, start=result.state)
    norms = native_kernels.residual_norms(taken.selection.whole, result.state, chosen.kernels)
    taken.solved = result, norms
    return result.objective_after


def _place_roughly(scene: Scene, config: Config) -> None:
    """Give every point that two views see and that has no place one, however rough; nothing of it is an outlier."""
    table, points = scene.observations, scene.landmarks
    nowhere = np.flatnonzero(~points.has_position)
    views = np.bincount(table.landmark[scene.views_of(nowhere)], minlength=len(points))
    landmarks = np.flatnonzero(~points.has_position & (views > 1))
    placed = points.has_position[table.landmark]
    if not len(landmarks) or not placed.any():
        return
    away = points.position[table.landmark[placed]] - scene.keyframes.position[table.keyframe[placed]]
    rows = scene.views_of(landmarks)
    table.outlier[rows] = False
    origin, none = scene.keyframes.position[scene.order[0]], np.zeros((len(landmarks), 3))
    problem, _ = problem_of(scene, rows, scene.order, landmarks, origin, none, config)
    usual = float(np.median(np.linalg.norm(away, axis=1)))
    points.position[landmarks] = _rough(problem, usual, config.solver.kernels) + origin
    points.has_position[landmarks] = True
    points.changed()


def _rough(problem: Problem, usual_m: float, kernels: str) -> FloatArray:
    """Return where rays come nearest to each other, (n_pt, 3), or so far along their mean where that tells no place."""
    rays, n = triangulation.rays_of(problem, kernels), problem.n_points
    points = triangulation.triangulate(rays, n, kernels).points
    start = problem.start
    state = State(start.rotation, start.translation, np.nan_to_num(points), start.intrinsics)
    behind = ~np.isfinite(native_kernels.residual_norms(problem, state, kernels))
    total, direction = (
        np.stack([np.bincount(rays.point, column, n) for column in values.T], axis=1)
        for values in (rays.centre, rays.direction)
    )
    centre = total / np.bincount(rays.point, minlength=n)[:, None]
    distance = np.linalg.norm(points - centre, axis=1)
    good = (distance > _NEAR * usual_m) & (distance < _FAR * usual_m)
    good[problem.observations.point[behind]] = False
    length = np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return np.where(good[:, None], points, centre + usual_m * direction / length)
