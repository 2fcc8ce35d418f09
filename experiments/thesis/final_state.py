# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is kept of the state in which a solve ends: gradient by kind of parameter, distributions, errors to truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.config import SolverOptions
from ba_node.core.objective import Objective, reprojection_errors
from ba_node.core.problem import Problem, State
from ba_node.core.schur import Structure, normal_equations
from ba_node.evaluation.alignment import align

FloatArray = NDArray[np.float64]

_BINS = 80
_KINDS = {"rotation": slice(0, 3), "translation": slice(3, 6), "f": slice(6, 7), "k1": slice(7, 8), "k2": slice(8, 9)}


def truth_errors(state: State, truth: State) -> dict[str, float]:
    """Return RMSE and median of the errors of camera centres and of points.

    Each set is aligned by itself for the RMSE, as the thesis does it (Sim(3), Umeyama). A few points that two near
    images see may lie anywhere, and rule the RMSE and its alignment; medians are those after the cameras' alignment.
    """
    centres, true_centres = _centres(state), _centres(truth)
    try:
        by_cameras = align(centres, true_centres, "sim3")
        by_points = align(state.points, truth.points, "sim3")
    except (ValueError, np.linalg.LinAlgError):
        # One that ran away beyond what numbers hold leaves nothing to align by.
        return dict.fromkeys(("rmse_cameras", "rmse_points", "median_points"), math.inf)
    errors = {
        "rmse_cameras": by_cameras.apply(centres) - true_centres,
        "rmse_points": by_points.apply(state.points) - truth.points,
    }
    out = {name: float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) for name, error in errors.items()}
    away = by_cameras.apply(state.points) - truth.points
    return {**out, "median_points": float(np.median(np.linalg.norm(away, axis=1)))}


def gradients(problem: Problem, options: SolverOptions, state: State) -> dict[str, Any]:
    """Return the norm of the gradient for each kind of parameter, its largest entry, and its distribution."""
    structure = Structure(problem)
    equations = normal_equations(structure, Objective(problem, options).linearise(state))
    size = equations.gradient_c.shape[1]
    norms = {
        kind: float(np.linalg.norm(equations.gradient_c[:, columns]))
        for kind, columns in _KINDS.items()
        if columns.stop <= size
    }
    entries = np.concatenate([equations.gradient_c.ravel(), equations.gradient_p.ravel()])
    return {
        "norms": {**norms, "point": float(np.linalg.norm(equations.gradient_p))},
        "largest": float(np.max(np.abs(entries), initial=0.0)),
        "histogram": histogram(entries, 0.01),
    }


def histogram(values: FloatArray, beyond: float) -> dict[str, Any]:
    """Return the distribution of values, and the share beyond a limit, found and expected of a Gaussian like it."""
    sigma, mean = float(np.std(values)), float(np.mean(values))
    limit = 5.0 * sigma if sigma > 0.0 else 1.0
    counts, edges = np.histogram(np.clip(values, mean - limit, mean + limit), bins=_BINS)
    above = np.mean(np.abs(values - mean) > 2.0 * sigma) if sigma > 0.0 else 0.0
    kurtosis = float(np.mean((values - mean) ** 4)) / sigma**4 if sigma > 0.0 else 0.0
    return {
        "counts": counts.tolist(),
        "low": float(edges[0]),
        "high": float(edges[-1]),
        "mean": mean,
        "sigma": sigma,
        "kurtosis": kurtosis,
        "share_beyond_two_sigma": float(above),
        "beyond": beyond,
        "share_beyond": float(np.mean(np.abs(values) > beyond)),
    }


def residuals(problem: Problem, state: State) -> dict[str, Any]:
    """Return the distribution of the reprojection errors, each of u and v, px; of points before their cameras."""
    errors = reprojection_errors(problem, state).ravel()
    return histogram(errors[np.isfinite(errors)], 2.0)


def pictures(problem: Problem, state: State, images: Sequence[int]) -> list[dict[str, Any]]:
    """Return what was measured and what is predicted in some images, px, at the start and at a state."""
    obs = problem.observations
    before, after = (reprojection_errors(problem, at) for at in (problem.start, state))
    out = []
    for image in images:
        rows = obs.keyframe == image
        out.append(
            {
                "image": image,
                "measured": _rounded(obs.uv[rows]),
                "before": _rounded(obs.uv[rows] + before[rows]),
                "after": _rounded(obs.uv[rows] + after[rows]),
            }
        )
    return out


def _rounded(values: FloatArray) -> list[list[float]]:
    return [[round(float(u), 2), round(float(v), 2)] for u, v in values if np.isfinite(u) and np.isfinite(v)]


def _centres(state: State) -> FloatArray:
    return np.asarray(-(np.swapaxes(state.rotation, 1, 2) @ state.translation[:, :, None])[..., 0])
