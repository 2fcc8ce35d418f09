# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The normal equations ``H = J'J``, ``g = J'F`` in the four forms that Table 3.1 compares.

- explicit dense (ES): J as one dense matrix, H by a matrix product (3.42, 3.43);
- explicit sparse (ES-sparse): J as a sparse matrix, H by a sparse product;
- implicit sparse (IS-sparse): Jc and Jp as sparse matrices, H put together from B, E and C (3.44-3.48);
- implicit cells (IS-cell): only the 2 x 12 derivatives of each observation, and sums of their products: what the
  solver itself does (schur.py).

The first three are here to measure and to check the fourth; nothing else uses them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ba_node.core.objective import Linearisation
from ba_node.core.problem import Problem
from ba_node.core.schur import Structure, block_diagonal, normal_equations

FloatArray = NDArray[np.float64]
Equations = tuple[FloatArray | scipy.sparse.spmatrix, FloatArray]


def explicit_dense(problem: Problem, lin: Linearisation) -> Equations:
    """Return H, dense, and g."""
    jacobian = np.hstack([part.toarray() for part in _sparse_parts(problem, lin)])
    return jacobian.T @ jacobian, jacobian.T @ lin.residual.ravel()


def explicit_sparse(problem: Problem, lin: Linearisation) -> Equations:
    """Return H, sparse, and g."""
    jacobian = scipy.sparse.hstack(_sparse_parts(problem, lin), format="csr")
    return jacobian.T @ jacobian, jacobian.T @ lin.residual.ravel()


def implicit_sparse(problem: Problem, lin: Linearisation) -> Equations:
    """Return H, sparse, put together from ``B = Jc'Jc``, ``E = Jc'Jp``, ``C = Jp'Jp``, and g."""
    j_c, j_p = _sparse_parts(problem, lin)
    e = j_c.T @ j_p
    residual = lin.residual.ravel()
    h = scipy.sparse.bmat([[j_c.T @ j_c, e], [e.T, j_p.T @ j_p]], format="csr")
    return h, np.concatenate([j_c.T @ residual, j_p.T @ residual])


def implicit_cells(problem: Problem, lin: Linearisation) -> Equations:
    """Return H, sparse, from the blocks that the solver keeps, and g."""
    structure = Structure(problem)
    parts = normal_equations(structure, lin)
    e, e_t = structure.edge_matrix(parts.e), structure.edge_matrix_transposed(parts.e)
    h = scipy.sparse.bmat([[block_diagonal(parts.b), e], [e_t, block_diagonal(parts.c)]], format="csr")
    return h, np.concatenate([parts.gradient_c.ravel(), parts.gradient_p.ravel()])


FORMS: dict[str, Callable[[Problem, Linearisation], Equations]] = {
    "explicit dense": explicit_dense,
    "explicit sparse": explicit_sparse,
    "implicit sparse": implicit_sparse,
    "implicit cells": implicit_cells,
}


def _sparse_parts(problem: Problem, lin: Linearisation) -> tuple[scipy.sparse.csr_matrix, scipy.sparse.csr_matrix]:
    """Return Jc over the free keyframes and Jp."""
    obs, free = problem.observations, ~problem.fixed
    column = np.cumsum(free) - 1
    seen = free[obs.keyframe]
    j_c = _block_rows(np.flatnonzero(seen), column[obs.keyframe[seen]], lin.d_keyframe, int(free.sum()))
    j_p = _block_rows(np.arange(len(obs)), obs.point, lin.d_point, problem.n_points)
    return j_c, j_p


def _block_rows(
    rows: NDArray[np.intp], columns: NDArray[np.intp], blocks: FloatArray, n: int
) -> scipy.sparse.csr_matrix:
    """Return a matrix with block ``blocks[row]`` at each (row, column); n columns of blocks."""
    n_obs, height, width = blocks.shape
    row = (rows[:, None, None] * height + np.arange(height)[:, None]) + np.zeros((1, 1, width), np.intp)
    column = (columns[:, None, None] * width + np.arange(width)) + np.zeros((1, height, 1), np.intp)
    entries = (blocks[rows].ravel(), (row.ravel(), column.ravel()))
    return scipy.sparse.coo_matrix(entries, shape=(n_obs * height, n * width)).tocsr()
