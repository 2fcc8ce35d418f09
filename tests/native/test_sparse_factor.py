# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The sparse factor of a matrix that is given by its blocks."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from ba_node import native
from ba_node.core.ranks import SumFactor

pytestmark = pytest.mark.skipif(native.kernels is None, reason="no C++ kernels built")


def positive(seed: int, n: int, d: int) -> scipy.sparse.bsr_matrix:
    """Return a random symmetric, positive definite matrix by blocks, a ring with some blocks across it."""
    rng = np.random.default_rng(seed)
    dense = np.zeros((n, d, n, d))
    pairs = (
        [(i, i + 1) for i in range(n - 1)]
        + [(0, n - 1)] * (n > 2)
        + [tuple(rng.choice(n, 2, replace=False)) for _ in range(n // 2)]
    )
    for i, j in pairs:
        dense[i, :, j, :] = rng.normal(size=(d, d))
        dense[j, :, i, :] = dense[i, :, j, :].T
    matrix = dense.reshape(n * d, n * d)
    matrix += np.diag(1.0 + np.abs(matrix).sum(axis=1))
    return scipy.sparse.bsr_matrix(matrix, blocksize=(d, d))


@pytest.mark.parametrize("d", [6, 9])
def test_solutions_are_those_of_lapack_and_the_structure_may_change(d: int) -> None:
    factor, rng = SumFactor(), np.random.default_rng(7)
    for seed, n in ((1, 12), (1, 12), (2, 12), (3, 30), (4, 1)):
        s, rhs = positive(seed, n, d), rng.normal(size=n * d)
        kept = rhs.copy()
        x = factor.solve(s, rhs)
        assert x is not None
        np.testing.assert_allclose(x, np.linalg.solve(s.toarray(), rhs), rtol=1e-10, atol=1e-13)
        np.testing.assert_array_equal(rhs, kept)


@pytest.mark.parametrize("d", [6, 9])
def test_what_is_not_positive_definite_has_no_solution(d: int) -> None:
    s = positive(5, 10, d)
    s.data[:] *= -1.0
    assert SumFactor().solve(s, np.ones(10 * d)) is None
