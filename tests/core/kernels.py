# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Problems of every shape, and what works on them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core import native_kernels
from ba_node.core.kernels import Kernels
from ba_node.core.problem import Problem, State

Make = Callable[..., tuple[Problem, State]]


SHAPES = {
    "pinhole": {"distorted": False},
    "distorted": {},
    "stereo": {"stereo": True},
    "depth": {"depth": True, "stereo": True},
    "own intrinsics": {"free_intrinsics": True},
    "nothing fixed": {"fixed": 0},
    "most fixed": {"fixed": 4},
    # Batches of eight points that are seen by the same keyframes, in runs of several, of one and of none.
    "tracks": {"distorted": False, "track": 3, "points": 125},
    "stereo tracks": {"stereo": True, "depth": True, "track": 4, "points": 83, "keyframes": 7},
}


COST_MODELS = [
    SolverOptions(),
    SolverOptions(loss="huber", loss_scale_px=1.5),
    SolverOptions(loss="huber", cheirality="constant"),
    SolverOptions(cheirality="drop"),
    SolverOptions(loss="cauchy", loss_scale_px=1.5, cheirality="constant"),
]


built = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")


def some_behind(problem: Problem) -> Problem:
    """Turn every seventh point to the other side of the cameras."""
    points = problem.start.points.copy()
    points[::7, 2] *= -1.0
    return dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points))


def made(problem: Problem, options: SolverOptions, kernels: str) -> Kernels:
    """Return numpy's kernels or those in C++."""
    return native_kernels.make(problem, dataclasses.replace(options, kernels=kernels))


def pair(problem: Problem, options: SolverOptions) -> tuple[Kernels, Kernels]:
    """Return the kernels of a problem in numpy and in C++, linearised at the start."""
    oracle, kernels = (made(problem, options, name) for name in ("numpy", "native"))
    assert oracle.linearise(problem.start) == pytest.approx(kernels.linearise(problem.start), rel=1e-12)
    return oracle, kernels


def near(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-11) -> None:
    """Assert that two arrays agree relative to their largest entry."""
    assert a.shape == b.shape
    scale = max(float(np.abs(a).max(initial=0.0)), 1e-300)
    assert float(np.abs(a - b).max(initial=0.0)) <= tolerance * scale
