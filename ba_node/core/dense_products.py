# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The sum ``Z Z'`` over all points by dense products: a few large ones instead of many of small blocks.

Points are taken in batches, and each batch with the keyframes that see any of it, as a dense matrix. Points that are
seen by the same keyframes come into the same batch, so that few of its blocks are zero.
"""

from __future__ import annotations

import itertools

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core import columns
from ba_node.kept import kept_property

_BATCH = 128
# OpenBLAS shares a larger product (rows x rows x columns) among its threads, and waits for a core that may be busy:
# products of 0.1 ms then took up to 30 ms. So those of windows are made in tiles; with more rows, sharing pays.
_ALONE = 250_000
_TILE_ROWS = 84
_MAX_ROWS = 3 * _TILE_ROWS
# Rates of one core, as in linear_costs.py: a product, an entry put into its place, what Python takes for a batch.
_FLOPS = 20e9
_ENTRY_S = 2e-9
_BATCH_S = 60e-6


class _Batch:
    """Some points.

    Attributes:
        edges: of the batch.
        unknowns: (d keyframes,) rows of S, in the order of the rows of the dense matrix; a slice where none is between.
        shape: of that, (d keyframes, 3 points).
    """

    def __init__(self, edges: slice, point: IntArray, keyframe: IntArray, size: int) -> None:
        """Number the keyframes; the points (n_edges,) have numbers 0, 1, ... already."""
        keyframes, self._own = np.unique(keyframe, return_inverse=True)
        self.edges, self._point, self._size = edges, point, size
        first, last = int(keyframes[0]), int(keyframes[-1]) + 1
        self.unknowns: IntArray | slice = slice(size * first, size * last)
        if last - first > len(keyframes):
            self.unknowns = (size * keyframes[:, None] + np.arange(size)).ravel()
        self.shape = size * len(keyframes), 3 * (int(point[-1]) + 1)

    @kept_property
    def place(self) -> IntArray:
        """Return (3, d, n_edges) where the entries of their blocks belong in the dense matrix."""
        width = self.shape[1]
        corner = width * np.arange(self._size) + width // 3 * np.arange(3)[:, None]
        return corner[:, :, None] + (width * self._size * self._own + self._point)


def edge_order(edge_point: IntArray, edge_keyframe: IntArray) -> IntArray:
    """Return the order of edges by the first and the last keyframe that see their point, then by point.

    Args:
        edge_point: (n_edges,) ascending.
        edge_keyframe: (n_edges,) ascending for each point.
    """
    start = columns.starts(edge_point)
    count = np.diff(start, append=len(edge_point))
    rank = np.empty_like(start)
    rank[np.lexsort((edge_keyframe[start + count - 1], edge_keyframe[start]))] = np.arange(len(start))
    return columns.order(np.repeat(rank, count), len(rank))


class DenseProducts:
    """The batches of a problem."""

    def __init__(self, edge_point: IntArray, edge_keyframe: IntArray, size: int) -> None:
        """Make the batches.

        Args:
            edge_point: (n_edges,) in the order of :func:`edge_order`.
            edge_keyframe: (n_edges,).
            size: d, unknowns of a keyframe.
        """
        begins = columns.starts(edge_point)
        place = np.repeat(np.arange(len(begins)), np.diff(begins, append=len(edge_point)))
        bounds = [*begins[::_BATCH].tolist(), len(edge_point)]
        self._size = size
        self._batches = [
            _Batch(slice(a, b), place[a:b] - place[a], edge_keyframe[a:b], size) for a, b in itertools.pairwise(bounds)
        ]

    @kept_property
    def seconds(self) -> float:
        """Return about how long :meth:`outer` takes."""
        seconds = len(self._batches) * _BATCH_S
        for batch in self._batches:
            rows, width = batch.shape
            entries = 3 * self._size * (batch.edges.stop - batch.edges.start)
            seconds += rows * rows * width / _FLOPS + entries * _ENTRY_S
        return seconds

    def outer(self, blocks: FloatArray, n_keyframes: int) -> FloatArray:
        """Return ``Z Z'`` of edges (n_edges, d, 3) as a dense matrix (d n_keyframes, d n_keyframes)."""
        n = self._size * n_keyframes
        out = np.zeros((n, n))
        for batch in self._batches:
            z = np.zeros(batch.shape)
            z.reshape(-1)[batch.place] = blocks.T[..., batch.edges].copy()
            if isinstance(batch.unknowns, slice):
                out[batch.unknowns, batch.unknowns] += _square(z)
            else:
                out.reshape(-1)[n * batch.unknowns[:, None] + batch.unknowns] += _square(z)
        return out


def _square(z: FloatArray) -> FloatArray:
    """Return ``Z Z'``, in tiles unless there are many rows."""
    rows, width = z.shape
    if rows > _MAX_ROWS:
        return z @ z.T
    out = np.zeros((rows, rows))
    tile = -(-rows // -(-rows // _TILE_ROWS))
    step = _ALONE // tile**2
    for i in range(0, rows, tile):
        for j in range(0, i + 1, tile):
            part = out[i : i + tile, j : j + tile]
            for k in range(0, width, step):
                part += z[i : i + tile, k : k + step] @ z[j : j + tile, k : k + step].T
            out[j : j + tile, i : i + tile] = part.T
    return out
