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
"""

from __future__ import annotations

import numpy as np
import scipy

from ba_node.arrays import FloatArray, IntArray
from ba_node.core import blocks, linear
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
        self.state: State  # at which the system was linearised
        self._free = free
        self._communicator = communicator or Alone()
        self._key: IntArray = np.empty(0, np.intp)  # places of the blocks of W, of all ranks
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
        inside = _Inside(s, label, self._communicator)
        p = self._coarse_space(label, s.blocksize[0])
        w = self._sum((s @ p).tobsr(blocksize=p.blocksize))
        p_t, w_t = p.T.tobsr(), w.T.tobsr()
        coarse = scipy.sparse.csc_matrix(p_t @ w)
        diagonal = coarse.diagonal()
        unit = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
        scaled = scipy.sparse.diags(unit) @ coarse @ scipy.sparse.diags(unit)
        lift = scipy.sparse.diags(np.where(unit > 0.0, _LIFT, 1.0))
        factor = linear.sparse_factor(scaled + lift)

        def coarsely(r: FloatArray) -> FloatArray:
            return np.asarray(unit * factor.solve(unit * r))

        def apply(r: FloatArray) -> FloatArray:
            y = coarsely(p_t @ r)
            z = inside.solve(r - w @ y)
            return np.asarray(z + p @ (y - coarsely(w_t @ z)))

        return apply

    def _sum(self, w: scipy.sparse.bsr_matrix) -> scipy.sparse.bsr_matrix:
        """Return the sum over ranks, whose blocks are put where those of all ranks were seen before."""
        if self._communicator.size == 1:
            return w
        (n, d), (count, q) = ((size // of, of) for size, of in zip(w.shape, w.blocksize, strict=True))
        key = np.repeat(np.arange(n), np.diff(w.indptr)) * count + w.indices
        if self._communicator.sum(np.array([len(np.setdiff1d(key, self._key))], dtype=float))[0]:
            keys = self._communicator.gather(np.union1d(key, self._key))
            self._key = self._communicator.broadcast(None if keys is None else np.unique(np.concatenate(keys)))
        data = np.zeros((len(self._key), d, q))
        data[np.searchsorted(self._key, key)] = w.data
        starts = np.searchsorted(self._key, np.arange(n + 1) * count)
        return scipy.sparse.bsr_matrix((self._communicator.sum(data), self._key % count, starts), shape=w.shape)

    def _coarse_space(self, label: IntArray, d: int) -> scipy.sparse.bsr_matrix:
        """Return P, (n_free d, n_clusters (d + 1)): all unknowns of a cluster alike, and its growth."""
        rotation, translation = self.state.rotation[self._free], self.state.translation[self._free]
        centre = -(np.swapaxes(rotation, 1, 2) @ translation[:, :, None])[..., 0]
        n, count = len(label), int(label.max()) + 1
        size = np.bincount(label, minlength=count)
        middle = np.stack([np.bincount(label, column, count) / size for column in centre.T], axis=1)
        columns = np.zeros((n, d, d + 1))
        columns[:, :, :d] = np.eye(d)
        columns[:, 3:6, d] = centre - middle[label]
        return scipy.sparse.bsr_matrix((columns, label, np.arange(n + 1)), shape=(n * d, count * (d + 1)))


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
        share = slice(*(len(size) * i // communicator.size for i in (communicator.rank, communicator.rank + 1)))
        matrices = np.zeros((len(size), most, d, most, d))
        matrices[label[row], place[row], :, place[column], :] = s.data[kept]
        matrices = communicator.sum(matrices)[share].reshape(-1, most * d, most * d)
        self._keyframe, self._d = self._keyframe[share], d
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
