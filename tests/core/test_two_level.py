# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""PCG on two levels comes to the exact step, in few steps, alone and on ranks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from ba_node import native
from ba_node.config import ConfigError, SolverOptions
from ba_node.core import linear, native_kernels, scaling
from ba_node.core.kernels import System
from ba_node.core.two_level import cluster
from experiments.benchmarks.generators import loop
from experiments.benchmarks.problem_file import case_problem

KERNELS = ["numpy", pytest.param("native", marks=pytest.mark.skipif(native.kernels is None, reason="not built"))]
FloatArray = NDArray[np.float64]


def loop_system(kernels: str, mu: float = 1e-6) -> tuple[System, FloatArray]:
    """Return the damped system of a loop of 100 cameras at its start, and its scale."""
    made = native_kernels.make(case_problem(loop(100, 2000)), SolverOptions(kernels=kernels))
    made.linearise(case_problem(loop(100, 2000)).start)
    d_c, _ = scaling.scaled_space("diag", made.diagonals())
    return made.damp("diag", mu), 1.0 / d_c.ravel()


@pytest.mark.parametrize("kernels", KERNELS)
def test_two_levels_come_to_the_exact_step_in_few_steps(kernels: str) -> None:
    system, scale = loop_system(kernels)
    exact = linear.cholesky(system.dense().copy(), system.rhs).x
    assert exact is not None
    limits = linear.PcgLimits(1e-9, 5000)
    found = {kind: system.solve_pcg(kind, scale, limits, formed=False) for kind in ("two_level",)}["two_level"]
    steps, x = found.iterations, found.x
    assert x is not None
    s = system.sparse()
    assert np.sqrt((x - exact) @ (s @ (x - exact))) < 1e-7 * np.sqrt(exact @ (s @ exact))
    assert np.linalg.norm((x - exact) / scale) < 1e-4 * np.linalg.norm(exact / scale)
    jacobi = system.solve_pcg("schur_block", scale, limits, formed=False).iterations
    assert steps < 120 and jacobi > 4 * steps, (steps, jacobi)


@pytest.mark.parametrize("kernels", KERNELS)
def test_the_preconditioner_is_symmetric_and_positive(kernels: str) -> None:
    system, _scale = loop_system(kernels)
    two_level = system.two_level  # type: ignore[attr-defined]
    s = system.sparse()
    apply = two_level._preconditioner(s, two_level._clusters(s))
    rng = np.random.default_rng(1)
    unit = np.sqrt(s.diagonal())
    u, v = unit * rng.normal(size=(2, len(system.rhs)))
    assert u @ apply(v) == pytest.approx(v @ apply(u), rel=1e-6)
    assert u @ apply(u) > 0.0


def test_clusters_join_what_is_coupled_most() -> None:
    """Of a chain in which pairs are coupled most, and pairs of pairs next, clusters of four are two pairs."""
    row = np.arange(15)
    strength = np.where(row % 2 == 0, 3.0, np.where(row % 4 == 1, 2.0, 1.0))
    label = cluster(row, row + 1, strength, 16, 4)
    np.testing.assert_array_equal(label, np.arange(16) // 4)
    np.testing.assert_array_equal(cluster(row, row + 1, strength, 16, 1), np.arange(16))


def test_two_levels_are_of_keyframes() -> None:
    options = dataclasses.replace(SolverOptions(), preconditioner="two_level", schur="cameras")
    with pytest.raises(ConfigError, match="take schur = points"):
        options.check()
