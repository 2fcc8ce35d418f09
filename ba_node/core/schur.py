# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations and the Schur complement of the points.

With ``J = [Jc Jp]`` (rows already weighted), ``g = J'r``, and ``H = J'J = [[B, E], [E', C]]`` (3.43-3.54), B is block
diagonal by keyframe (d x d, d = 6 or 9; but for what factors add, see factors.py) and C by point (3 x 3). The damped
step ``(H + mu D) p = -g`` is found by eliminating the points (3.64-3.67)::

    S pc = -gc + E C^-1 gp,    S = B - E C^-1 E'
    pp   = C^-1 (-gp - E' pc)

C is factored, ``C = L L'``, and everything uses ``Z = E L^-T``, so that ``S = B - Z Z'`` stays symmetric and the
reduction loses no more digits than C's own condition asks for. A pivot of C that is zero to rounding belongs to a
direction that no observation determines: its row of L^-1 is set to zero, which is the pseudo-inverse's answer (the
point does not move in it).

Cost for K free keyframes, P points, N observations, and k_p keyframes that see point p: linearising O(N); Z is
N blocks of d x 3; S takes sum k_p^2 block products (d x 3)(3 x d), or dense ones where these cost less
(dense_products.py). Without S, a product with it takes 2N of them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy

from ba_node.arrays import FloatArray, IntArray
from ba_node.core import columns, dense_products
from ba_node.core.factors import Pairs
from ba_node.core.objective import Linearisation
from ba_node.core.problem import Problem
from ba_node.kept import kept_property

# S is formed while it takes at most this many block products an observation.
_PRODUCTS_PER_OBSERVATION = 60.0
# Seconds of a product of two blocks in scipy, over d^2: as the rates of dense_products.py, of one core.
_PRODUCT_S = 2e-9


class Structure:
    """Which rows belong to which keyframe, point and (keyframe, point) edge; fixed over all iterations."""

    def __init__(self, problem: Problem) -> None:
        obs = problem.observations
        self.size = 9 if problem.free_intrinsics else 6
        self.free = np.flatnonzero(~problem.fixed)
        self.n_free, self.n_points, self.n_rows = len(self.free), problem.n_points, len(obs)
        self._row_keyframe, self._row_point = obs.keyframe, obs.point
        self._n_keyframes = problem.n_keyframes
        column = np.full(problem.n_keyframes, -1, dtype=np.intp)
        column[self.free] = np.arange(self.n_free)
        # By point: rows are sorted already; only points with rows take part in the sums.
        self.point_start = columns.starts(obs.point)
        self.seen_points = obs.point[self.point_start]
        # By keyframe: the rows of free keyframes.
        row_column = column[obs.keyframe]
        rows = np.flatnonzero(row_column >= 0)
        self._keyframe_rows, self._keyframe_bounds = _runs(row_column, rows, self.n_free)
        # Edges: distinct (point, free keyframe); a stereo pair is one edge. In the order of dense_products.py.
        key = obs.point[rows] * max(self.n_free, 1) + row_column[rows]
        order = np.argsort(key, kind="stable")
        rows, start = rows[order], columns.starts(key[order])
        count = columns.counts(start, len(rows))
        point, keyframe = obs.point[rows[start]], row_column[rows[start]]
        order = dense_products.edge_order(point, keyframe)
        self.edge_point, self.edge_keyframe, start, count = (a[order] for a in (point, keyframe, start, count))
        # First the first row of every edge, then the second one of those that have two, and so on.
        self._edge_rows = [(np.flatnonzero(count > i), rows[start[count > i] + i]) for i in range(count.max(initial=1))]
        self._edge_by_point, self._indptr_point = _runs(self.edge_point, np.arange(len(order)), self.n_points)
        self._edge_by_keyframe, self._indptr_keyframe = _runs(self.edge_keyframe, self._edge_by_point, self.n_free)

    @property
    def n_edges(self) -> int:
        """Return the number of (point, free keyframe) pairs."""
        return len(self.edge_point)

    @property
    def schur_products(self) -> int:
        """Return the number of block products that forming S takes."""
        return int(np.sum(np.diff(self._indptr_point).astype(np.int64) ** 2))

    @property
    def form_schur(self) -> bool:
        """Return True if forming S is cheaper than working without it."""
        return self.schur_products <= _PRODUCTS_PER_OBSERVATION * max(self.n_edges, 1)

    def point_blocks(
        self, d_point: FloatArray, residual: FloatArray, squares: list[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return C (n_points, 3, 3) and gp (n_points, 3); ``squares`` are those of ``d_point``."""
        c, gradient = columns.normal_equations(d_point, residual, self.point_start, squares)
        if len(c) == self.n_points:
            return c, gradient
        all_c, all_gradient = np.zeros((self.n_points, 3, 3), order="F"), np.zeros((self.n_points, 3), order="F")
        all_c[self.seen_points], all_gradient[self.seen_points] = c, gradient
        return all_c, all_gradient

    def edge_products(self, d_keyframe: FloatArray, d_point: FloatArray) -> FloatArray:
        """Return E (n_edges, d, 3): ``Jc' Jp``, summed over the rows of each edge."""

        def products(rows: IntArray) -> FloatArray:
            return columns.product(columns.transposed(columns.take(d_keyframe, rows)), columns.take(d_point, rows))

        out = products(self._edge_rows[0][1])
        for edges, rows in self._edge_rows[1:]:
            columns.put(out, edges, columns.take(out, edges) + products(rows))
        return out

    def local_edge_products(self, squares: list[FloatArray], points: FloatArray) -> FloatArray:
        """Return E where poses step locally: ``Jc = [x x g; g]'`` for rows g of Jp, so E is ``[[x] G; G]``, G = g g'.

        ``squares`` are the entries of G of each observation, (n_obs,) each, ``points`` x, (n_obs, 3) m.
        """
        first = self._edge_rows[0][1]
        entries = [values.take(first) for values in squares]
        for edges, rows in self._edge_rows[1:]:
            for mine, values in zip(entries, squares, strict=True):
                mine[edges] += values.take(rows)
        xx, xy, yy, xz, yz, zz = entries
        x, y, z = (values.take(first) for values in points.T)
        out, term = columns.empty(len(first), 6, 3), np.empty(len(first))
        for k, (by_x, by_y, by_z) in enumerate(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))):
            for i, (a, b, c, d) in enumerate(((y, by_z, z, by_y), (z, by_x, x, by_z), (x, by_y, y, by_x))):
                np.multiply(a, b, out=out[:, i, k])
                out[:, i, k] -= np.multiply(c, d, out=term)
            out[:, 3, k], out[:, 4, k], out[:, 5, k] = by_x, by_y, by_z
        return out

    def keyframe_blocks(self, d_keyframe: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return B (n_free, d, d) and gc (n_free, d)."""
        rows, bounds = self._keyframe_rows, self._keyframe_bounds
        both = columns.empty(len(rows), d_keyframe.shape[1], d_keyframe.shape[2] + 1)
        # Rows are in range; a check of that would make a copy.
        d_keyframe.T.take(rows, axis=-1, out=both.T[:-1], mode="clip")
        residual.T.take(rows, axis=-1, out=both.T[-1], mode="clip")
        products = _squares(both, bounds)
        return products[:, :-1, :-1], products[:, :-1, -1]

    def edge_squares(self, blocks: FloatArray) -> FloatArray:
        """Return the sum of ``Z Z'`` over the edges (n_edges, d, 3) of each keyframe, (n_free, d, d)."""
        by_keyframe = columns.transposed(columns.take(blocks, self._edge_by_keyframe))
        return _squares(by_keyframe, self._indptr_keyframe)

    def to_keyframes(self, blocks: FloatArray, x: FloatArray) -> FloatArray:
        """Return ``Z x`` for edges (n_edges, d, 3) and x (n_points, 3): (n_free, d)."""
        return columns.sums(columns.times(blocks, columns.take(x, self.edge_point)), self.edge_keyframe, self.n_free)

    def to_points(self, blocks: FloatArray, x: FloatArray) -> FloatArray:
        """Return ``Z' x`` for edges (n_edges, d, 3) and x (n_free, d): (n_points, 3)."""
        moved = columns.times(columns.transposed(blocks), columns.take(x, self.edge_keyframe))
        return columns.sums(moved, self.edge_point, self.n_points)

    def jacobian_product(self, lin: Linearisation, step_c: FloatArray, step_p: FloatArray) -> FloatArray:
        """Return J p of every observation, (n_obs, 2 or 3), for steps (n_free, d) and (n_points, 3)."""
        full = np.zeros((self._n_keyframes, self.size))
        full[self.free] = step_c
        moved = columns.times(lin.d_keyframe, columns.take(full, self._row_keyframe))
        moved += columns.times(lin.d_point, columns.take(step_p, self._row_point))
        return moved

    @kept_property
    def _dense(self) -> dense_products.DenseProducts:
        return dense_products.DenseProducts(self.edge_point, self.edge_keyframe, self.size)

    def edge_outer(self, blocks: FloatArray) -> FloatArray | None:
        """Return ``Z Z'`` (d n_free, d n_free) by dense products; None where block-sparse ones cost less."""
        if self._dense.seconds > self.schur_products * self.size**2 * _PRODUCT_S:
            return None
        return self._dense.outer(blocks, self.n_free)

    def edge_matrix(self, blocks: FloatArray) -> scipy.sparse.bsr_matrix:
        """Return edge blocks (n_edges, d, 3) as a block-sparse (d n_free, 3 n_points) matrix."""
        shape = (self.size * self.n_free, 3 * self.n_points)
        order = self._edge_by_keyframe
        entries = np.ascontiguousarray(blocks)[order], self.edge_point[order], self._indptr_keyframe
        return scipy.sparse.bsr_matrix(entries, shape=shape)

    def edge_matrix_transposed(self, blocks: FloatArray) -> scipy.sparse.bsr_matrix:
        """Return the transpose of :meth:`edge_matrix`, block-sparse too."""
        shape = (3 * self.n_points, self.size * self.n_free)
        order = self._edge_by_point
        turned = np.ascontiguousarray(columns.transposed(blocks))[order]
        return scipy.sparse.bsr_matrix((turned, self.edge_keyframe[order], self._indptr_point), shape=shape)


@dataclass(frozen=True)
class NormalEquations:
    """H and g in blocks, undamped."""

    b: FloatArray  # (n_free, d, d) keyframe blocks
    c: FloatArray  # (n_points, 3, 3) point blocks
    e: FloatArray  # (n_edges, d, 3) coupling
    gradient_c: FloatArray  # (n_free, d)
    gradient_p: FloatArray  # (n_points, 3)
    pairs: Pairs | None = None  # blocks of B between two keyframes; None without factors

    @property
    def gradient_norm(self) -> float:
        """Return |g|."""
        return float(np.sqrt(np.sum(self.gradient_c**2) + np.sum(self.gradient_p**2)))

    def diagonals(self) -> tuple[FloatArray, FloatArray]:
        """Return diag(B) (n_free, d) and diag(C) (n_points, 3)."""
        return np.diagonal(self.b, axis1=1, axis2=2), np.diagonal(self.c, axis1=1, axis2=2)


def normal_equations(structure: Structure, lin: Linearisation) -> NormalEquations:
    """Return H and g of a linearisation."""
    b, gradient_c = structure.keyframe_blocks(lin.d_keyframe, lin.residual)
    squares = columns.squares(lin.d_point)
    c, gradient_p = structure.point_blocks(lin.d_point, lin.residual, squares)
    if lin.points is None:
        e = structure.edge_products(lin.d_keyframe, lin.d_point)
    else:
        e = structure.local_edge_products(squares, lin.points)
    if lin.factors is None:
        return NormalEquations(b, c, e, gradient_c, gradient_p)
    b[:, :6, :6] += lin.factors.diagonal
    gradient_c[:, :6] += lin.factors.gradient
    return NormalEquations(b, c, e, gradient_c, gradient_p, lin.factors.pairs)


class ReducedSystem:
    """The damped system after elimination of the points."""

    side = "points"

    def __init__(
        self, structure: Structure, equations: NormalEquations, damping_c: FloatArray, damping_p: FloatArray
    ) -> None:
        """Factor C and couple it to the keyframes; damping, (n_free, d) and (n_points, 3), adds to the diagonals."""
        self._structure = structure
        self.b = columns.plus_diagonal(equations.b, damping_c)
        self._pairs = equations.pairs
        self._inverse_l = inverse_cholesky3(columns.plus_diagonal(equations.c, damping_p))
        self._scaled_gradient_p = columns.times(self._inverse_l, equations.gradient_p)
        self._blocks, term = np.empty_like(equations.e), np.empty_like(equations.e[:, :, 0])
        for j in range(3):
            inverse = self._inverse_l[:, j, : j + 1].T.take(structure.edge_point, axis=-1)
            np.multiply(equations.e[:, :, j], inverse[j, :, None], out=self._blocks[:, :, j])
            for i in range(j):
                self._blocks[:, :, j] += np.multiply(equations.e[:, :, i], inverse[i, :, None], out=term)
        self.rhs = (structure.to_keyframes(self._blocks, self._scaled_gradient_p) - equations.gradient_c).ravel()

    @kept_property
    def z(self) -> scipy.sparse.bsr_matrix:
        """Return Z as a block-sparse matrix."""
        return self._structure.edge_matrix(self._blocks)

    @kept_property
    def z_t(self) -> scipy.sparse.bsr_matrix:
        """Return Z' as a block-sparse matrix."""
        return self._structure.edge_matrix_transposed(self._blocks)

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x without forming S."""
        own = (self.b @ x.reshape(-1, self._structure.size, 1)).ravel()
        if self._pairs is not None:
            own += self._pairs.product(x.reshape(-1, self._structure.size)).ravel()
        return np.asarray(own - self.z @ (self.z_t @ x))

    def dense(self) -> FloatArray:
        """Return S as a dense matrix."""
        s = self._structure.edge_outer(self._blocks)
        if s is None:
            s = (self.z @ self.z_t).toarray()
        np.negative(s, out=s)
        d = self._structure.size
        n = self._structure.n_free
        view = s.reshape(n, d, n, d)
        index = np.arange(n)
        view[index, :, index, :] += self.b
        if self._pairs is not None:
            rows, between = self._pairs.rows, self._pairs.columns
            view[rows, :6, between, :6] += self._pairs.blocks
            view[between, :6, rows, :6] += np.swapaxes(self._pairs.blocks, 1, 2)
        return s

    def sparse(self) -> scipy.sparse.bsr_matrix:
        """Return S as a block-sparse matrix."""
        own = block_diagonal(self.b)
        if self._pairs is not None:
            own = own + self._pairs.matrix(self._structure.n_free, self._structure.size)
        return own - self.z @ self.z_t

    def diagonal_blocks(self) -> tuple[FloatArray, ...]:
        """Return the diagonal blocks of S, (n_free, d, d), without forming S."""
        return (self.b - self._structure.edge_squares(self._blocks),)

    def own_blocks(self) -> tuple[FloatArray, ...]:
        """Return the blocks of B, damped."""
        return (self.b,)

    def gather(self, of_keyframes: FloatArray, _of_points: FloatArray) -> FloatArray:
        """Return what belongs to the unknowns of S out of values for all unknowns."""
        return of_keyframes.ravel()

    def expand(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps of keyframes (n_free, d) and points (n_points, 3) that belong to a solution (n_free d,)."""
        step_c = x.reshape(-1, self._structure.size)
        rhs = -self._scaled_gradient_p - self._structure.to_points(self._blocks, step_c)
        return step_c, columns.times(columns.transposed(self._inverse_l), rhs)


def block_diagonal(blocks: FloatArray) -> scipy.sparse.bsr_matrix:
    """Return blocks (n, d, d) as a block-sparse matrix."""
    n, d, _ = blocks.shape
    return scipy.sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(n * d, n * d))


def inverse_cholesky3(c: FloatArray) -> FloatArray:
    """Return ``L^-1`` of symmetric positive semi-definite blocks ``C = L L'``: (n, 3, 3) -> (n, 3, 3).

    A pivot below rounding of the block's largest diagonal entry is taken as zero; its row of L^-1 is zero.
    """
    floor = 1e-14 * np.max(np.diagonal(c, axis1=1, axis2=2), axis=1, initial=0.0) + 1e-300
    i00 = _inverse_root(c[:, 0, 0], floor)
    l10, l20 = c[:, 1, 0] * i00, c[:, 2, 0] * i00
    i11 = _inverse_root(c[:, 1, 1] - l10 * l10, floor)
    l21 = (c[:, 2, 1] - l20 * l10) * i11
    i22 = _inverse_root(c[:, 2, 2] - l20 * l20 - l21 * l21, floor)
    out = np.zeros(c.shape, order="F")
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = i00, i11, i22
    out[:, 1, 0] = -l10 * i00 * i11
    out[:, 2, 1] = -l21 * i11 * i22
    out[:, 2, 0] = -(l20 * i00 + l21 * out[:, 1, 0]) * i22
    return out


def _runs(key: IntArray, rows: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Return rows sorted by their key, and where those of each key 0, 1, ..., n - 1 begin and end, (n + 1,)."""
    of = key[rows]
    return rows[columns.order(of, n)], np.concatenate([[0], np.cumsum(np.bincount(of, minlength=n))])


def _squares(a: FloatArray, bounds: IntArray) -> FloatArray:
    """Return the sum of ``A' A`` over each run of blocks A (n, i, j): (n_runs, j, j)."""
    d = a.shape[2]
    out = np.zeros((len(bounds) - 1, d, d))
    for k, (begin, end) in enumerate(itertools.pairwise(bounds.tolist())):
        rows = a[begin:end].reshape(-1, d, order="F")
        np.matmul(rows.T, rows, out=out[k])
    return out


def _inverse_root(pivot: FloatArray, floor: FloatArray) -> FloatArray:
    good = pivot > floor
    return np.where(good, 1.0 / np.sqrt(np.where(good, pivot, 1.0)), 0.0)
