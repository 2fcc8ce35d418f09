# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Work out what somebody looks at beside the estimate: covariances, and what there is to see of a solved window."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import Config
from ba_node.core import cameras, geometry, methods, objective
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.estimate import Extras, WindowView
from ba_node.scene.scene import Scene
from ba_node.window.covariance import covariances
from ba_node.window.selection import Selection


def work_out(
    wanted: Extras, scene: Scene, config: Config, selection: Selection, state: State, refined: IntArray
) -> dict[str, Any]:
    """Return what is wanted of a solution in the scale of the map, by the names of its fields in Estimate.

    ``refined`` are rows of the keyframes of the estimate, oldest first, and so are the rows of the results.
    """
    places = scene.places()
    place = np.searchsorted(places[refined], places[selection.keyframes])
    found: dict[str, Any] = {}
    if wanted.covariance:
        measured = scene.keyframes.input_position[selection.keyframes]
        found["covariance"] = np.full((len(refined), 6, 6), np.nan)
        found["covariance"][place] = covariances(selection, state, measured, methods.from_config(config.solver)).poses
    if wanted.view:
        good = ~scene.observations.outlier[selection.rows[selection.inlier]]
        found["view"] = view(selection.problem, state, good, place, len(refined))
    return found


def view(problem: Problem, state: State, good: BoolArray, place: IntArray, n: int) -> WindowView:
    """Return what there is to see.

    ``good`` (n_obs,) observations are inliers after it: a wrong match says nothing about a pose. ``place`` (n_kf,) is
    the row of each keyframe of the problem among the n of the estimate; the others are neither free nor linked.
    """
    free, rms_px = np.zeros(n, bool), np.full(n, np.nan)
    free[place] = ~problem.fixed
    rms_px[place] = _rms_by_keyframe(problem, state, good)
    links, shared = _links(problem.observations, problem.n_keyframes, problem.n_points)
    return WindowView(free, rms_px, place[links], shared, _frusta(problem.cameras))


def _rms_by_keyframe(problem: Problem, state: State, good: BoolArray) -> FloatArray:
    error = objective.reprojection_errors(problem, state)
    seen = good & ~np.isnan(error[:, 0])
    keyframe = problem.observations.keyframe[seen]
    total = np.bincount(keyframe, np.sum(error[seen] ** 2, axis=1), problem.n_keyframes)
    count = np.bincount(keyframe, minlength=problem.n_keyframes)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(total / (2 * count)))


def _links(obs: Observations, n_kf: int, n_points: int) -> tuple[IntArray, IntArray]:
    """Return pairs of keyframes (m, 2), the earlier first, and the number of points that both see (m,)."""
    sees = scipy.sparse.csr_matrix((np.ones(len(obs)), (obs.keyframe, obs.point)), shape=(n_kf, n_points))
    # A point that several cameras of a keyframe see counts once.
    sees.data[:] = 1.0
    common = scipy.sparse.triu(sees @ sees.T, k=1).tocoo()
    return np.stack([common.row, common.col], axis=1).astype(np.intp), common.data.astype(np.intp)


def _frusta(rig: Cameras) -> FloatArray:
    """Return the centre and the corners of each camera's view in the body, (n_cam, 5, 3), at a depth of 1 m.

    The size of the images is not kept: they are taken to reach as far on the other side of the principal point.
    """
    fx, fy, cx, cy = (rig.params[:, i] for i in (cameras.FX, cameras.FY, 2, 3))
    half = np.abs(np.stack([cx / fx, cy / fy, np.ones(len(fx))], axis=1))
    signs = np.array([[0, 0, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    rotation, position = geometry.inverse(rig.rotation, rig.translation)
    return np.asarray((half[:, None, :] * signs) @ np.swapaxes(rotation, 1, 2) + position[:, None, :])
