# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What works component by component gives what numpy gives block by block, whichever way the arrays are stored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ba_node.core import columns


@pytest.mark.parametrize("stored", [np.ascontiguousarray, np.asfortranarray])
@pytest.mark.parametrize("n", [0, 1, 9])
def test_products_and_rows(n: int, stored: Callable[[np.ndarray], np.ndarray]) -> None:
    rng = np.random.default_rng(n)
    a, b = (stored(rng.normal(size=shape)) for shape in ((n, 2, 3), (n, 3, 4)))
    np.testing.assert_allclose(columns.product(a, b), a @ b, atol=1e-14)
    np.testing.assert_allclose(columns.times(a, b[:, :, 0]), (a @ b)[:, :, 0], atol=1e-14)
    np.testing.assert_array_equal(columns.transposed(a), np.swapaxes(a, 1, 2))
    rows = rng.permutation(n)[: n // 2]
    np.testing.assert_array_equal(columns.take(a, rows), a[rows])
    np.testing.assert_array_equal(columns.take(a, slice(1, 3)), a[1:3])
    expected, written = a.copy(), columns.take(a, np.arange(n))
    expected[rows] = 7.0
    columns.put(written, rows, np.full((len(rows), 2, 3), 7.0))
    np.testing.assert_array_equal(written, expected)


def test_a_diagonal_is_added_to_a_copy() -> None:
    a = np.ones((5, 3, 3))
    diagonal = np.arange(15.0).reshape(5, 3)
    np.testing.assert_array_equal(columns.plus_diagonal(a, diagonal), a + diagonal[:, :, None] * np.eye(3))
    assert (a == 1.0).all()


def test_sums_over_runs_and_by_index() -> None:
    rng = np.random.default_rng(0)
    run = np.array([2, 2, 2, 5, 6, 6])
    begins = columns.starts(run)
    np.testing.assert_array_equal(begins, [0, 3, 4])
    j, r = rng.normal(size=(6, 2, 3)), rng.normal(size=(6, 2))
    blocks, gradient = columns.normal_equations(j, r, begins)
    for i, value in enumerate((2, 5, 6)):
        part = j[run == value].reshape(-1, 3)
        np.testing.assert_allclose(blocks[i], part.T @ part, atol=1e-14)
        np.testing.assert_allclose(gradient[i], part.T @ r[run == value].ravel(), atol=1e-14)
        np.testing.assert_allclose(columns.sums(r, run, 9)[value], r[run == value].sum(axis=0), atol=1e-14)
        np.testing.assert_allclose(columns.sum_runs(j, begins)[i], j[run == value].sum(axis=0), atol=1e-14)
    assert not columns.sums(r, run, 9)[[0, 1, 3, 4, 7, 8]].any()


def test_without_rows_there_are_no_runs() -> None:
    none = np.zeros(0, dtype=np.intp)
    assert columns.starts(none).shape == (0,)
    assert columns.sum_runs(np.zeros((0, 3)), none).shape == (0, 3)
    assert columns.normal_equations(np.zeros((0, 2, 3)), np.zeros((0, 2)), none)[0].shape == (0, 3, 3)


@pytest.mark.parametrize("n", [5, 2**16, 2**16 + 1])
def test_small_integers_are_ordered_as_they_come(n: int) -> None:
    """The largest is the last that 16 bits hold, or the first that they do not."""
    values = np.random.default_rng(n).integers(0, n, 3000)
    values[:2] = n - 1, 0
    np.testing.assert_array_equal(columns.order(values, n), np.argsort(values, kind="stable"))


def test_counts_of_runs() -> None:
    np.testing.assert_array_equal(columns.counts(np.array([0, 3, 4]), 6), [3, 1, 2])
    assert columns.counts(np.zeros(0, np.intp), 0).shape == (0,)
