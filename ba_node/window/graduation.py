# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Begin the first solves of a map with a wider loss, if their start is bad.

A loss whose pull fades with the residual hardly sees a keyframe that begins far from where its tracks want it: a
front-end that turned a degree too far puts all its residuals at tens of sigmas, among the wrong ones. While a map is
young there is little that holds against it. So its first iterations take the loss with the scale of the residuals of
the worst keyframe (graduated non-convexity, by one step), and the solve goes on from there. Later, when the map is
known, a wide loss would let clusters of outliers pull, as of moving objects.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import solver
from ba_node.core.problem import Problem

# Residuals of this rank tell how far off a keyframe begins: most may be wrong.
_RANK = 0.3
# How many scales of the loss that must be.
_FAR = 4.0
_ITERATIONS = 3
# A map of more keyframes is known well enough.
_YOUNG = 10
_FADING = ("cauchy", "geman_mcclure")


def begun(problem: Problem, norms: FloatArray, options: SolverOptions) -> Problem:
    """Return a problem with a better start, if its own is bad; ``norms`` (n_obs,) are the residuals there, sigmas."""
    scale = options.loss_scale_px
    if options.loss not in _FADING or problem.n_keyframes > _YOUNG:
        return problem
    far = norms > _FAR * scale
    keyframe = problem.observations.keyframe
    n = np.bincount(keyframe, minlength=problem.n_keyframes)
    suspect = ~problem.fixed & (np.bincount(keyframe[far], minlength=problem.n_keyframes) > (1.0 - _RANK) * n)
    if not suspect.any():
        return problem
    wide = max(float(np.quantile(norms[keyframe == k], _RANK, method="lower")) for k in np.flatnonzero(suspect))
    if not np.isfinite(wide):
        return problem
    first = solver.solve(problem, dataclasses.replace(options, loss_scale_px=wide, max_iterations=_ITERATIONS))
    if not first.status.usable or not first.state.is_finite():
        return problem
    return dataclasses.replace(problem, start=first.state)
