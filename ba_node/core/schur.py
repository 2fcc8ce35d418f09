# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations and the Schur complement of the points.

With ``J = [Jc Jp]`` (rows already weighted), ``g = J'r``, and ``H = J'J = [[B, E], [E', C]]`` (3.43-3.54), B is block
diagonal by keyframe (d x d, d = 6 or 9) and C by point (3 x 3). The damped step ``(H + mu D) p = -g`` is found by
eliminating the points (3.64-3.67)::

    S pc = -gc + E C^-1 gp,    S = B - E C^-1 E'
    pp   = C^-1 (-gp - E' pc)

C is factored, ``C = L L'``, and everything uses ``Z = E L^-T``, so that ``S = B - Z Z'`` stays symmetric and the
reduction loses no more digits than C's own condition asks for. A pivot of C that is zero to rounding belongs to a
direction that no observation determines: its row of L^-1 is set to zero, which is the pseudo-inverse's answer (the
point does not move in it).

Cost for K free keyframes, P points, N observations, and k_p keyframes that see point p: linearising O(N); Z is
N blocks of d x 3; S takes sum k_p^2 block products (d x 3)(3 x d). Without S, a product with it takes 2N of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ba_node.core.objective import Linearisation
from ba_node.core.problem import Problem

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

# S is formed while it takes at most this many block products an observation.
_PRODUCTS_PER_OBSERVATION = 60.0


class Structure:
    """Which rows belong to which keyframe, point and (keyframe, point) edge; fixed over all iterations."""

    def __init__(self, problem: Problem) -> None:
        """Sort the observations once."""
        obs = problem.observations
        self.size = 9 if problem.free_intrinsics else 6
        self.free = np.flatnonzero(~problem.fixed)
        self.n_free, self.n_points = len(self.free), problem.n_points
        self._row_keyframe, self._row_point = obs.keyframe, obs.point
        self._n_keyframes = problem.n_keyframes
        column = np.full(problem.n_keyframes, -1, dtype=np.intp)
        column[self.free] = np.arange(self.n_free)
        # By point: rows are sorted already; only points with rows take part in the sums.
        self.seen_points, self._point_start = np.unique(obs.point, return_index=True)
        # By keyframe: the rows of free keyframes.
        row_column = column[obs.keyframe]
        rows = np.flatnonzero(row_column >= 0)
        self._keyframe_rows = rows[np.argsort(row_column[rows], kind="stable")]
        self._keyframe_bounds = np.searchsorted(row_column[self._keyframe_rows], np.arange(self.n_free + 1))
        # Edges: distinct (point, free keyframe), sorted by point; a stereo pair is one edge.
        key = obs.point[rows] * max(self.n_free, 1) + row_column[rows]
        order = np.argsort(key, kind="stable")
        self._edge_rows = rows[order]
        edges, self._edge_start = np.unique(key[order], return_index=True)
        self.edge_point, self.edge_keyframe = edges // max(self.n_free, 1), edges % max(self.n_free, 1)
        self._edge_by_keyframe = np.argsort(self.edge_keyframe, kind="stable")
        self._indptr_keyframe = np.searchsorted(self.edge_keyframe[self._edge_by_keyframe], np.arange(self.n_free + 1))
        self._indptr_point = np.searchsorted(self.edge_point, np.arange(self.n_points + 1))

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

    def sum_points(self, rows: FloatArray) -> FloatArray:
        """Sum rows (n_obs, ...) by point: (n_points, ...)."""
        out = np.zeros((self.n_points, *rows.shape[1:]))
        if len(self.seen_points):
            out[self.seen_points] = np.add.reduceat(rows, self._point_start, axis=0)
        return out

    def sum_edges(self, rows: FloatArray) -> FloatArray:
        """Sum rows (n_obs, ...) by edge: (n_edges, ...)."""
        taken = rows[self._edge_rows]
        if len(self._edge_start) == len(self._edge_rows):
            return taken
        return np.asarray(np.add.reduceat(taken, self._edge_start, axis=0))

    def keyframe_blocks(self, d_keyframe: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return B (n_free, d, d) and gc (n_free, d)."""
        jacobian = d_keyframe[self._keyframe_rows].reshape(-1, d_keyframe.shape[2])
        r = residual[self._keyframe_rows].reshape(-1)
        blocks, gradient = np.zeros((self.n_free, self.size, self.size)), np.zeros((self.n_free, self.size))
        bounds = self._keyframe_bounds * residual.shape[1]
        for k in range(self.n_free):
            part = jacobian[bounds[k] : bounds[k + 1]]
            blocks[k] = part.T @ part
            gradient[k] = part.T @ r[bounds[k] : bounds[k + 1]]
        return blocks, gradient

    def jacobian_product(self, lin: Linearisation, step_c: FloatArray, step_p: FloatArray) -> FloatArray:
        """Return J p of every observation, (n_obs, 2 or 3), for steps (n_free, d) and (n_points, 3)."""
        full = np.zeros((self._n_keyframes, self.size))
        full[self.free] = step_c
        moved = (lin.d_keyframe @ full[self._row_keyframe][:, :, None])[..., 0]
        moved += (lin.d_point @ step_p[self._row_point][:, :, None])[..., 0]
        return np.asarray(moved)

    def edge_matrix(self, blocks: FloatArray) -> scipy.sparse.bsr_matrix:
        """Return edge blocks (n_edges, d, 3) as a block-sparse (d n_free, 3 n_points) matrix."""
        shape = (self.size * self.n_free, 3 * self.n_points)
        order = self._edge_by_keyframe
        return scipy.sparse.bsr_matrix((blocks[order], self.edge_point[order], self._indptr_keyframe), shape=shape)

    def edge_matrix_transposed(self, blocks: FloatArray) -> scipy.sparse.bsr_matrix:
        """Return the transpose of :meth:`edge_matrix`, block-sparse too."""
        shape = (3 * self.n_points, self.size * self.n_free)
        turned = np.ascontiguousarray(np.swapaxes(blocks, 1, 2))
        return scipy.sparse.bsr_matrix((turned, self.edge_keyframe, self._indptr_point), shape=shape)


@dataclass(frozen=True)
class NormalEquations:
    """H and g in blocks, undamped.

    Attributes:
        b: (n_free, d, d) keyframe blocks.
        c: (n_points, 3, 3) point blocks.
        e: (n_edges, d, 3) coupling.
        gradient_c: (n_free, d).
        gradient_p: (n_points, 3).
    """

    b: FloatArray
    c: FloatArray
    e: FloatArray
    gradient_c: FloatArray
    gradient_p: FloatArray

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
    point_t = np.swapaxes(lin.d_point, 1, 2)
    c = structure.sum_points(point_t @ lin.d_point)
    gradient_p = structure.sum_points((point_t @ lin.residual[:, :, None])[..., 0])
    e = structure.sum_edges(np.swapaxes(lin.d_keyframe, 1, 2) @ lin.d_point)
    return NormalEquations(b, c, e, gradient_c, gradient_p)


class ReducedSystem:
    """The damped system after elimination of the points."""

    side = "points"

    def __init__(
        self, structure: Structure, equations: NormalEquations, damping_c: FloatArray, damping_p: FloatArray
    ) -> None:
        """Factor C and couple it to the keyframes.

        Args:
            structure: of the problem.
            equations: undamped.
            damping_c: (n_free, d) added to diag(B).
            damping_p: (n_points, 3) added to diag(C).
        """
        self._structure = structure
        self.b = equations.b + damping_c[:, :, None] * np.eye(structure.size)
        self._inverse_l = inverse_cholesky3(equations.c + damping_p[:, :, None] * np.eye(3))
        self._scaled_gradient_p = (self._inverse_l @ equations.gradient_p[:, :, None])[..., 0]
        blocks = equations.e @ np.swapaxes(self._inverse_l, 1, 2)[structure.edge_point]
        self._blocks = blocks
        self.z = structure.edge_matrix(blocks)
        self.z_t = structure.edge_matrix_transposed(blocks)
        self.rhs = -equations.gradient_c.ravel() + self.z @ self._scaled_gradient_p.ravel()

    def product(self, x: FloatArray) -> FloatArray:
        """Return S x without forming S."""
        own = (self.b @ x.reshape(-1, self._structure.size, 1)).ravel()
        return np.asarray(own - self.z @ (self.z_t @ x))

    def dense(self) -> FloatArray:
        """Return S as a dense matrix."""
        s: FloatArray = -(self.z @ self.z_t).toarray()
        d = self._structure.size
        n = self._structure.n_free
        view = s.reshape(n, d, n, d)
        index = np.arange(n)
        view[index, :, index, :] += self.b
        return s

    def sparse(self) -> scipy.sparse.bsr_matrix:
        """Return S as a block-sparse matrix."""
        return block_diagonal(self.b) - self.z @ self.z_t

    def diagonal_blocks(self) -> tuple[FloatArray, ...]:
        """Return the diagonal blocks of S, (n_free, d, d), without forming S."""
        blocks = self.b.copy()
        own = self._blocks @ np.swapaxes(self._blocks, 1, 2)
        np.subtract.at(blocks, self._structure.edge_keyframe, own)
        return (blocks,)

    def own_blocks(self) -> tuple[FloatArray, ...]:
        """Return the blocks of B, damped."""
        return (self.b,)

    def gather(self, of_keyframes: FloatArray, _of_points: FloatArray) -> FloatArray:
        """Return what belongs to the unknowns of S out of values for all unknowns."""
        return of_keyframes.ravel()

    def expand(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps of keyframes (n_free, d) and points (n_points, 3) that belong to a solution (n_free d,)."""
        rhs = -self._scaled_gradient_p - (self.z_t @ x).reshape(-1, 3)
        step_p = np.asarray((np.swapaxes(self._inverse_l, 1, 2) @ rhs[:, :, None])[..., 0])
        return x.reshape(-1, self._structure.size), step_p


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
    out = np.zeros_like(c)
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = i00, i11, i22
    out[:, 1, 0] = -l10 * i00 * i11
    out[:, 2, 1] = -l21 * i11 * i22
    out[:, 2, 0] = -(l20 * i00 + l21 * out[:, 1, 0]) * i22
    return out


def _inverse_root(pivot: FloatArray, floor: FloatArray) -> FloatArray:
    good = pivot > floor
    return np.where(good, 1.0 / np.sqrt(np.where(good, pivot, 1.0)), 0.0)
