# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Precondition PCG on two levels: exactly inside clusters of keyframes, and one coarse system between clusters.

With K the blocks of S inside clusters and P the coarse space, ``Q = P (P' S P)^-1 P'`` and (balancing, Mandel 1993)::

    M^-1 = Q + (I - Q S) K^-1 (I - S Q)

K takes care of what is stiff, Q of what is weak: clusters that turn, move and grow against each other. A column of P
steps all keyframes of one cluster alike. With ``R <- R Exp(dphi), t <- t + R dt`` that is a rotation about the origin
or a translation; one more makes the cluster grow, and those of free intrinsics change them alike. On a loop of 1000
cameras (mu = 1e-7, to 1e-4) block Jacobi takes more than 3000 steps and this 37; 69 with no columns for intrinsics,
twice as many with K^-1 + Q.

S is formed. A step costs a product with it, one with the inverses of K, and two with W = S P, which is as sparse as S
between clusters and takes the place of further products with S.

On several ranks each has the part of S and of W that its points leave, and the inverses of a share of the clusters.
Only vectors are summed in a step, and the coarse system, which all of them factor, once a system.

PCG ends by the residual in energy: on a long loop nearly all of |r| is what each keyframe has against its neighbours,
while what is worth most is left in modes that |r| does not show. By |r| a loop of 20 000 cameras took one step a system
and stood still.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from ba_node.arrays import FloatArray, IntArray
from ba_node.core import blocks, columns, linear
from ba_node.core.communicator import Alone, Communicator, total
from ba_node.core.problem import State

# Keyframes of a cluster.
_CLUSTER = 8
# Clusters become larger where the coarse system would have more numbers.
_MAX_COARSE = 2e7
# By so much of its diagonal the coarse system is lifted: without fixed keyframes it is singular but for damping.
_LIFT = 1e-12


class TwoLevel:
    """The clusters of one problem, found once, and how its systems are solved by PCG that they precondition."""

    def __init__(self, free: IntArray, communicator: Communicator | None = None) -> None:
        """Take the indices of the free keyframes, (n_free,), and the ranks of which each has a part of S."""
        columns.keep_memory()
        self.state: State  # at which the system was linearised
        self._free = free
        self._communicator = communicator or Alone()
        self._label: IntArray | None = None  # (n_free,) cluster of each free keyframe

    def solve(
        self, s: scipy.sparse.bsr_matrix, rhs: FloatArray, scale: FloatArray, limits: linear.PcgLimits
    ) -> linear.Solution:
        """Return the solution of ``S x = rhs`` by PCG in the space scaled by 1 / ``scale``, (n,).

        ``s`` is this rank's part of S, ``rhs`` that of all.
        """
        if self._label is None:
            self._label = self._clusters(s)
        precondition = self._preconditioner(s, self._label)

        def product(x: FloatArray) -> FloatArray:
            return scale * self._communicator.sum(s @ (scale * x))

        limits = replace(limits, energy=True)
        found = linear.pcg_steihaug(product, scale * rhs, lambda r: precondition(r / scale) / scale, limits)
        return linear.Solution(None if found.x is None else scale * found.x, found.iterations, found.on_boundary)

    def _clusters(self, s: scipy.sparse.bsr_matrix) -> IntArray:
        """Return (n_free,) the cluster of each keyframe, the same on all ranks."""
        n, d = len(self._free), s.blocksize[0]
        squares = scipy.sparse.csr_matrix((np.sum(s.data**2, axis=(1, 2)), s.indices, s.indptr), shape=(n, n))
        squares = total(self._communicator, squares)
        coupling = scipy.sparse.triu(squares, 1).tocoo()
        own = np.sqrt(np.maximum(squares.diagonal(), 1e-300))
        strength = coupling.data / (own[coupling.row] * own[coupling.col])
        most = _CLUSTER
        while True:
            label = cluster(coupling.row, coupling.col, strength, n, most)
            count = int(label.max()) + 1
            between = np.unique(label[coupling.row].astype(np.int64) * count + label[coupling.col])
            if (2 * len(between) + count) * (d + 1) ** 2 <= _MAX_COARSE or count == 1:
                return label
            most *= 2

    def _preconditioner(self, s: scipy.sparse.bsr_matrix, label: IntArray) -> linear.Product:
        """Return ``r -> M^-1 r`` of the system that is not scaled."""
        inside, ranks = _Inside(s, label, self._communicator), self._communicator
        p = self._coarse_space(label, s.blocksize[0])
        w = (s @ p).tobsr(blocksize=p.blocksize)
        p_t, w_t = p.T.tobsr(), w.T.tobsr()
        coarse = scipy.sparse.csc_matrix(total(ranks, p_t @ w))
        diagonal = coarse.diagonal()
        unit = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
        scaled = scipy.sparse.diags(unit) @ coarse @ scipy.sparse.diags(unit)
        lift = scipy.sparse.diags(np.where(unit > 0.0, _LIFT, 1.0))
        factor = linear.sparse_factor(scaled + lift)

        def coarsely(r: FloatArray) -> FloatArray:
            return np.asarray(unit * factor.solve(unit * r))

        def apply(r: FloatArray) -> FloatArray:
            y = coarsely(p_t @ r)
            z = inside.solve(r - ranks.sum(w @ y))
            return np.asarray(z + p @ (y - coarsely(ranks.sum(w_t @ z))))

        return apply

    def _coarse_space(self, label: IntArray, d: int) -> scipy.sparse.bsr_matrix:
        """Return P, (n_free d, n_clusters (d + 1)): all unknowns of a cluster alike, and its growth."""
        rotation, translation = self.state.rotation[self._free], self.state.translation[self._free]
        centre = -(np.swapaxes(rotation, 1, 2) @ translation[:, :, None])[..., 0]
        n, count = len(label), int(label.max()) + 1
        size = np.bincount(label, minlength=count)
        middle = np.stack([np.bincount(label, column, count) / size for column in centre.T], axis=1)
        steps = np.zeros((n, d, d + 1))
        steps[:, :, :d] = np.eye(d)
        steps[:, 3:6, d] = centre - middle[label]
        return scipy.sparse.bsr_matrix((steps, label, np.arange(n + 1)), shape=(n * d, count * (d + 1)))


class _Inside:
    """The inverses of the blocks of S inside clusters, in single precision: M need not be exact.

    Every rank has those of a share of the clusters.
    """

    def __init__(self, s: scipy.sparse.bsr_matrix, label: IntArray, communicator: Communicator) -> None:
        self._communicator = communicator
        n, (d, _) = len(label), s.blocksize
        row = np.repeat(np.arange(n), np.diff(s.indptr))
        kept = np.flatnonzero(label[row] == label[s.indices])
        row, column = row[kept], s.indices[kept]
        # Clusters as rows of a table of keyframes; what is left of a row stands for keyframe n, which is nowhere.
        order = np.argsort(label, kind="stable")
        size = np.bincount(label)
        place = np.empty(n, dtype=np.intp)
        place[order] = np.arange(n) - np.repeat(np.cumsum(size) - size, size)
        most = int(size.max())
        self._keyframe = np.full((len(size), most), n)
        self._keyframe[label, place] = np.arange(n)
        bounds = len(size) * np.arange(communicator.size + 1) // communicator.size
        first, stop = bounds[communicator.rank : communicator.rank + 2]
        self._keyframe, self._d = self._keyframe[first:stop], d
        matrices = np.zeros((stop - first, most, d, most, d))
        owner = np.searchsorted(bounds, label[row], side="right") - 1
        of = [np.flatnonzero(owner == rank) for rank in range(communicator.size)]
        for i, j, data in communicator.exchange([(row[at], column[at], s.data[kept[at]]) for at in of]):
            matrices[label[i] - first, place[i], :, place[j], :] += data
        matrices = matrices.reshape(-1, most * d, most * d)
        diagonal = np.arange(most * d)
        squares = matrices[:, diagonal, diagonal]
        squares = np.where(squares > 0.0, squares, 1.0)
        matrices[:, diagonal, diagonal] = squares
        unit = 1.0 / np.sqrt(squares)
        inverses = blocks.positive_inverses(matrices * unit[:, :, None] * unit[:, None, :])
        self._inverses = (0.5 * (inverses + np.swapaxes(inverses, 1, 2))).astype(np.float32)
        self._unit = unit[:, :, None]

    def solve(self, r: FloatArray) -> FloatArray:
        """Return ``K^-1 r``."""
        padded = np.concatenate([r.reshape(-1, self._d), np.zeros((1, self._d))])
        right = self._unit * padded[self._keyframe].reshape(len(self._inverses), -1, 1)
        solved = self._unit * (self._inverses @ right.astype(np.float32))
        padded[:] = 0.0
        padded[self._keyframe] = solved.reshape(*self._keyframe.shape, self._d)
        return self._communicator.sum(padded[:-1].ravel())


def cluster(row: IntArray, column: IntArray, strength: FloatArray, n: int, most: int) -> IntArray:
    """Return (n,) clusters 0, 1, ... of at most so many: the strongest pairs are joined first, as long as they fit."""
    parent, size = list(range(n)), [1] * n

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = i = parent[parent[i]]
        return i

    order = np.argsort(-strength, kind="stable")
    for i, j in zip(row[order].tolist(), column[order].tolist(), strict=True):
        a, b = root(i), root(j)
        if a != b and size[a] + size[b] <= most:
            parent[b] = a
            size[a] += size[b]
    return np.unique([root(i) for i in range(n)], return_inverse=True)[1].reshape(-1)
