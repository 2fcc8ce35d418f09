# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Square, symmetric, positive semi-definite blocks, many at a time."""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray

# Eigenvalues of a block of unit diagonal that are rounding.
_ROUNDING = 1e-14


def inverse_roots(blocks: FloatArray) -> FloatArray:
    """Return ``K`` with ``K' K`` the pseudo-inverse (Section 5.2) of each block: (n, d, d) -> (n, d, d).

    A block is first scaled to a unit diagonal, so that the units of its parameters do not decide what is rounding.
    Directions without a value have a row of zeros in K.
    """
    diagonal = np.diagonal(blocks, axis1=1, axis2=2)
    good = diagonal > 0.0
    unit = np.where(good, 1.0 / np.sqrt(np.where(good, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(np.nan_to_num(blocks * unit[:, :, None] * unit[:, None, :]))
    kept = values > _ROUNDING * blocks.shape[1]
    roots = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
    return np.asarray(roots[:, :, None] * np.swapaxes(vectors, 1, 2) * unit[:, None, :])


def positive_inverses(blocks: FloatArray) -> FloatArray:
    """Return positive definite inverses; a block that is not positive definite is lifted to one: (n, d, d)."""
    try:
        np.linalg.cholesky(blocks)
        return np.asarray(np.linalg.inv(blocks))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(np.nan_to_num(blocks))
        largest = np.max(values, axis=1, initial=0.0)[:, None]
        lifted = np.where(largest > 0.0, np.maximum(values, 1e-12 * largest), 1.0)
        return np.asarray((vectors / lifted[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def condition(blocks: FloatArray) -> float:
    """Return the largest condition number of a block: how much of it its inverse may lose; 1 if there is none."""
    if not blocks.size:
        return 1.0
    values = np.linalg.eigvalsh(np.nan_to_num(blocks))
    smallest, largest = values[:, 0], values[:, -1]
    return float(np.max(np.where(smallest > 0.0, largest / np.where(smallest > 0.0, smallest, 1.0), np.inf)))
