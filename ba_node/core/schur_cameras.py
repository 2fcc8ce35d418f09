# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The Schur complement of the keyframes ("SC of B", 3.70-3.73), and the equations as a whole.

Eliminating the keyframes, with ``B = K^-1 K^-T`` and ``Z = K E``::

    S pp = -gp + E' B^-1 gc,    S = C - E' B^-1 E = C - Z' Z
    pc   = B^-1 (-gc - E pp)

Directions of a keyframe that nothing determines have a row of zeros in K, the pseudo-inverse's answer (Section 5.2).
That takes B to be block diagonal: problems with factors are eliminated by points, or not at all.
S has 3 rows a point and couples all points that one keyframe sees: a product with it without forming it costs as much
as one on the other side, 2 block products an observation, but forming it takes sum n_k^2 of them, n_k points seen by k.
"""

from __future__ import annotations

import numpy as np
import scipy

from ba_node.arrays import FloatArray
from ba_node.core import blocks, columns
from ba_node.core.schur import NormalEquations, Structure, block_diagonal


class CameraReduction:
    """The damped system after elimination of the keyframes."""

    side = "cameras"

    def __init__(
        self, structure: Structure, equations: NormalEquations, damping_c: FloatArray, damping_p: FloatArray
    ) -> None:
        """Factor B and couple it to the points; arguments as of schur.ReducedSystem."""
        self._structure = structure
        self.c = columns.plus_diagonal(equations.c, damping_p)
        self._root = blocks.inverse_roots(columns.plus_diagonal(equations.b, damping_c))
        self._scaled_gradient_c = (self._root @ equations.gradient_c[:, :, None])[..., 0].ravel()
        self._blocks = columns.product(columns.take(self._root, structure.edge_keyframe), equations.e)
        self.z = structure.edge_matrix(self._blocks)
        self.z_t = structure.edge_matrix_transposed(self._blocks)
        self.rhs: FloatArray = -equations.gradient_p.ravel() + self.z_t @ self._scaled_gradient_c

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x without forming S."""
        own = (self.c @ x.reshape(-1, 3, 1)).ravel()
        return np.asarray(own - self.z_t @ (self.z @ x))

    def dense(self) -> FloatArray:
        """Return S as a dense matrix."""
        s: FloatArray = -(self.z_t @ self.z).toarray()
        n = self._structure.n_points
        index = np.arange(n)
        s.reshape(n, 3, n, 3)[index, :, index, :] += self.c
        return s

    def sparse(self) -> scipy.sparse.bsr_matrix:
        """Return S as a block-sparse matrix."""
        return block_diagonal(self.c) - self.z_t @ self.z

    def diagonal_blocks(self) -> tuple[FloatArray, ...]:
        """Return the diagonal blocks of S, (n_points, 3, 3), without forming S."""
        own = self.c.copy()
        squares = columns.product(columns.transposed(self._blocks), self._blocks)
        np.subtract.at(own, self._structure.edge_point, squares)
        return (own,)

    def own_blocks(self) -> tuple[FloatArray, ...]:
        """Return the blocks of C, damped."""
        return (self.c,)

    def gather(self, _of_keyframes: FloatArray, of_points: FloatArray) -> FloatArray:
        """Return what belongs to the unknowns of S out of values for all unknowns."""
        return of_points.ravel()

    def expand(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps of keyframes (n_free, d) and points (n_points, 3) that belong to a solution."""
        rhs = (-self._scaled_gradient_c - self.z @ x).reshape(-1, self._structure.size, 1)
        return (np.swapaxes(self._root, 1, 2) @ rhs)[..., 0], x.reshape(-1, 3)


class FullSystem:
    """The damped equations ``H p = -g`` as they are (3.61)."""

    side = "none"

    def __init__(
        self, structure: Structure, equations: NormalEquations, damping_c: FloatArray, damping_p: FloatArray
    ) -> None:
        """Add the damping; arguments as of schur.ReducedSystem."""
        self._structure = structure
        self.b = columns.plus_diagonal(equations.b, damping_c)
        self.c = columns.plus_diagonal(equations.c, damping_p)
        self._pairs = equations.pairs
        self.e = structure.edge_matrix(equations.e)
        self.e_t = structure.edge_matrix_transposed(equations.e)
        self.rhs = -np.concatenate([equations.gradient_c.ravel(), equations.gradient_p.ravel()])
        self._split = structure.size * structure.n_free

    def product(self, x: FloatArray) -> FloatArray:
        """Return H x."""
        x_c, x_p = x[: self._split], x[self._split :]
        own_c = (self.b @ x_c.reshape(-1, self._structure.size, 1)).ravel()
        own_p = (self.c @ x_p.reshape(-1, 3, 1)).ravel()
        if self._pairs is not None:
            own_c += self._pairs.product(x_c.reshape(-1, self._structure.size)).ravel()
        return np.concatenate([own_c + self.e @ x_p, own_p + self.e_t @ x_c])

    def dense(self) -> FloatArray:
        """Return H as a dense matrix."""
        return np.asarray(self.sparse().toarray())

    def sparse(self) -> scipy.sparse.csr_matrix:
        """Return H as a sparse matrix."""
        own_c = block_diagonal(self.b)
        if self._pairs is not None:
            own_c = own_c + self._pairs.matrix(self._structure.n_free, self._structure.size)
        rows = [[own_c, self.e], [self.e_t, block_diagonal(self.c)]]
        return scipy.sparse.bmat(rows, format="csr")

    def diagonal_blocks(self) -> tuple[FloatArray, ...]:
        """Return the blocks of B and of C, damped."""
        return self.b, self.c

    own_blocks = diagonal_blocks

    def gather(self, of_keyframes: FloatArray, of_points: FloatArray) -> FloatArray:
        """Return values for all unknowns in one vector."""
        return np.concatenate([of_keyframes.ravel(), of_points.ravel()])

    def expand(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps of keyframes (n_free, d) and points (n_points, 3)."""
        return x[: self._split].reshape(-1, self._structure.size), x[self._split :].reshape(-1, 3)
