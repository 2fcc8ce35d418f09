# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Many small blocks at a time: arrays (n, ...) that are stored component by component (Fortran's order).

numpy's loops then run over n, long and contiguous, in place of over 2 or 3 entries of a block: products of 2 x 3
blocks take a tenth of the time of ``@`` on them. What is here takes arrays in any order and returns them in this one.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from ba_node.arrays import FloatArray, IntArray


def empty(*shape: int) -> FloatArray:
    """Return an array (n, ...) to be filled."""
    return np.empty(shape, order="F")


def take(array: FloatArray, rows: IntArray | slice) -> FloatArray:
    """Return some rows of (n, ...); a view where they are a slice."""
    return array[rows] if isinstance(rows, slice) else array.T.take(rows, axis=-1).T


def put(array: FloatArray, rows: IntArray, values: FloatArray) -> None:
    """Write over some rows of (n, ...), which must be stored by components."""
    n = array[:1].size
    for column, new in zip(array.T.reshape(n, len(array)), values.T.reshape(n, len(rows)), strict=True):
        column[rows] = new


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the product of each pair of blocks: (n, i, j) and (n, j, k) -> (n, i, k)."""
    out, term = empty(len(a), a.shape[1], b.shape[2]), empty(len(a), b.shape[2])
    for i in range(a.shape[1]):
        np.multiply(a[:, i, :1], b[:, 0], out=out[:, i])
        for j in range(1, a.shape[2]):
            out[:, i] += np.multiply(a[:, i, j : j + 1], b[:, j], out=term)
    return out


def times(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return the product of each block with its vector: (n, i, j) and (n, j) -> (n, i)."""
    return product(a, x[:, :, None])[..., 0]


def transposed(a: FloatArray) -> FloatArray:
    """Return the transpose of each block, a view: (n, i, j) -> (n, j, i)."""
    return np.swapaxes(a, 1, 2)


def plus_diagonal(a: FloatArray, diagonal: FloatArray) -> FloatArray:
    """Return blocks (n, d, d) with (n, d) added to their diagonals."""
    out = a.copy(order="K")
    for i in range(a.shape[1]):
        out[:, i, i] += diagonal[:, i]
    return out


def order(values: IntArray, n: int) -> IntArray:
    """Return the order of values 0, 1, ..., n - 1, those that are equal as they come."""
    # numpy sorts integers of 16 bits by their digits, in a seventh of the time.
    return np.argsort(values.astype(np.uint16) if n <= 2**16 else values, kind="stable")


def starts(values: IntArray) -> IntArray:
    """Return where each run of equal values begins."""
    return np.flatnonzero(np.diff(values, prepend=values[:1] - 1))


def counts(begins: IntArray, n: int) -> IntArray:
    """Return how many rows of n each run has, from where it begins: np.diff without its overhead."""
    out = np.empty_like(begins)
    np.subtract(begins[1:], begins[:-1], out=out[:-1])
    out[-1:] = n - begins[-1:]
    return out


def sum_runs(array: FloatArray, begins: IntArray) -> FloatArray:
    """Return the sums of runs of rows (n, ...), each from one start to the next: (n_runs, ...)."""
    return np.add.reduceat(array.T, begins, axis=-1).T if len(begins) else array[:0]


def sums(array: FloatArray, index: IntArray, n: int) -> FloatArray:
    """Return the sums of rows (m, k) by index 0, 1, ..., n - 1: (n, k)."""
    out = empty(n, array.shape[1])
    for column, values in zip(out.T, array.T, strict=True):
        column[:] = np.bincount(index, values, n)
    return out


def squares(jacobian: FloatArray) -> list[FloatArray]:
    """Return ``J'J`` of each block (n, i, d), the entries (n,) on and below its diagonal, row by row."""
    return [_inner(jacobian[:, :, k], jacobian[:, :, j]) for k in range(jacobian.shape[2]) for j in range(k + 1)]


def normal_equations(
    jacobian: FloatArray, residual: FloatArray, begins: IntArray, known: list[FloatArray] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the sums of ``J'J`` and ``J'r`` over runs of rows (n, i, d) and (n, i): (n_runs, d, d), (n_runs, d).

    ``known``: :func:`squares` of the rows, if they are.
    """
    d = jacobian.shape[2]
    blocks, gradient = empty(len(begins), d, d), empty(len(begins), d)
    entries = iter(squares(jacobian) if known is None else known)
    for k in range(d):
        gradient[:, k] = sum_runs(_inner(jacobian[:, :, k], residual), begins)
        for j in range(k + 1):
            blocks[:, k, j] = blocks[:, j, k] = sum_runs(next(entries), begins)
    return blocks, gradient


@cache
def keep_memory() -> None:
    """Let the allocator of the C library keep what is freed.

    glibc gives large arrays back to the system, and takes them again page by page, until a larger one has been freed.
    Without this an eighth of the time of a window went into that.
    """
    np.empty(31 * 2**17)


def _inner(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the inner product of each pair of rows: (n, i) and (n, i) -> (n,)."""
    out = a[:, 0] * b[:, 0]
    for i in range(1, a.shape[1]):
        out += a[:, i] * b[:, i]
    return out
