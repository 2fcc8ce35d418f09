# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose how ``S p = rhs`` is solved from what each way would cost, counted from the structure of the problem.

Each way is charged its flops at the rate that its kernel reaches, and the bytes that it must move (n unknowns in blocks
of d, P pairs of keyframes over all points, F block products of the sparse factor, N edges = point and free keyframe):

- dense:  6 d^2 P to form S, 12 n^2 bytes to lay it out, n^3 / 3 for Cholesky;
- sparse: the same for S, 2 d^3 F for the factor, at a lower rate where a column and what it needs leave the cache;
- pcg:    N blocks of d x 3 read in each step; nothing is formed. A step carries what it knows from a keyframe to those
          that share its points: the longer the way from one end of a map to the other, the more steps. A factor with F
          products reaches ``b = sqrt(2 F / K)`` keyframes ahead, so that K keyframes are K / b stretches long.

Both factors are our own. The sparse one (native/src/linalg/sparse_cholesky.hpp), by blocks of the size of a camera,
took 0.02 s where Eigen's SimplicialLLT took 0.20 s and CHOLMOD's supernodal one 0.15 s (1000 cameras on a circle, one
core), and on 49 cameras that all see each other 0.8 ms where LAPACK took 1.1, CHOLMOD 3.8 and Eigen 9 ms. The dense one
(native/src/linalg/cholesky.hpp) takes as long as the sparse one there, and gains more from a second thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ba_node.core.kernels import DENSE_LIMIT

# Rates of one core, flop/s and byte/s: measured on an AMD EPYC (AVX2). Their ratios count.
_FORM_FLOPS = 20e9
_DENSE_FLOPS = 32e9
_SPARSE_FLOPS = 24e9
_SPARSE_FLOPS_LARGE = 10e9
_BYTES = 12e9
# Bytes that a column of the factor and its sources may take before the lower rate holds.
_CACHE_BYTES = 5e6
# Steps of PCG that an outer iteration is charged: of a map where all keyframes meet, and for each stretch of a long
# one (10 stretches of 1000 keyframes took 45 steps, then 144, then 232, where a factor ends after six iterations).
_PCG_STEPS, _PCG_STEPS_OF_STRETCH = 60, 20
# The same with clusters and a coarse system in place of block Jacobi.
_TWO_LEVEL_STEPS = 20
# From so many steps of PCG on for the cost of forming S PCG is tried first, for half as many.
_WORTH_A_TRY = 15
# And only where the map is so many tracks long at most: on longer ones PCG ends after a step or two by a residual of
# which the weak modes are next to nothing, and iteration after iteration gains next to nothing too.
_TRIED_STRETCHES = 4.0
# Up to so many unknowns S is factored as a dense matrix, in 20 microseconds at most; to count what else there is takes
# longer. At these sizes a try of PCG is never worth it.
FEW_UNKNOWNS = 128
# No factor may take more memory than this.
MAX_BYTES = 4.8e9


@dataclass(frozen=True)
class Sizes:
    """What is known of the structure of a problem's reduced system."""

    unknowns: int  # n
    block: int  # d
    edges: int  # (point, free keyframe) pairs
    pairs: int  # pairs of free keyframes that see the same point, over all points, each keyframe with itself too


@dataclass(frozen=True)
class Factor:
    """What is known of the sparse Cholesky factor of S."""

    blocks: int  # blocks of the factor that are not zero
    products: float  # multiplications of two blocks
    complete: bool = True  # False if counting was given up because there were too many


def block_bytes(block: int) -> int:
    """Return the memory of a d x d block, padded (those of 6 x 6 with AVX-512 alone)."""
    return 64 * 11 if block == 9 else 64 * 6


def max_blocks(block: int) -> int:
    """Return how many blocks a sparse factor may have."""
    return int(MAX_BYTES / block_bytes(block))


def dense_s(sizes: Sizes) -> float:
    """Return the seconds of an iteration with dense S; infinite if it would not fit into memory."""
    n = float(sizes.unknowns)
    if 8.0 * n * n > MAX_BYTES:
        return math.inf
    return _form_s(sizes) + 12.0 * n * n / _BYTES + n**3 / 3.0 / _DENSE_FLOPS


def sparse_s(sizes: Sizes, factor: Factor) -> float:
    """Return the seconds of an iteration with sparse S."""
    if not factor.complete:
        return math.inf
    columns = max(sizes.unknowns // sizes.block, 1)
    working_set = 2.0 * factor.products / columns * block_bytes(sizes.block)
    rate = _SPARSE_FLOPS if working_set <= _CACHE_BYTES else _SPARSE_FLOPS_LARGE
    return _form_s(sizes) + flops(sizes, factor) / rate


def pcg_s(sizes: Sizes, products: float) -> float:
    """Return the seconds of an iteration with conjugate gradients where a factor takes so many block products."""
    keyframes = max(sizes.unknowns / sizes.block, 1.0)
    stretches = keyframes / math.sqrt(max(2.0 * products / keyframes, 1.0))
    return (_PCG_STEPS + _PCG_STEPS_OF_STRETCH * stretches) * _pcg_step_s(sizes)


def preconditioner(sizes: Sizes, schur_blocks: int) -> str:
    """Return which preconditioner of PCG costs less; S has so many blocks on and above its diagonal."""
    size = two_level_bytes(sizes, schur_blocks)
    if sizes.unknowns <= DENSE_LIMIT or size > MAX_BYTES:
        return "schur_block"
    two_level = _form_s(sizes) + (_TWO_LEVEL_STEPS + 3) * 2.0 / 3.0 * size / _BYTES
    return "two_level" if two_level < _PCG_STEPS * _pcg_step_s(sizes) else "schur_block"


def two_level_bytes(sizes: Sizes, schur_blocks: int) -> float:
    """Return the memory of two levels: S as a whole beside its upper half, each with a copy while it is made."""
    return 3.0 * 2.0 * 8.0 * sizes.block**2 * schur_blocks


def pcg_tries(sizes: Sizes) -> int:
    """Return how many steps of PCG to try before an exact solution; 0 for none.

    That costs as much as forming S at least. At half the steps that cost as much, a try that fails makes one iteration
    half as long again.
    """
    if not sizes.edges:
        return 0
    views = 2.0 * sizes.pairs / sizes.edges - 1.0  # of a point, as a keyframe finds it
    steps = _form_s(sizes) / _pcg_step_s(sizes)
    is_long = sizes.unknowns / sizes.block > _TRIED_STRETCHES * views
    return int(0.5 * steps) if steps >= _WORTH_A_TRY and not is_long else 0


def flops(sizes: Sizes, factor: Factor) -> float:
    """Return the flops of a sparse factorisation."""
    return 2.0 * sizes.block**3 * factor.products


def max_products(sizes: Sizes, *, exact: bool = False) -> float:
    """Return from how many block products on the sparse factor is not the cheapest way."""
    low, high = 1.0, max(sizes.unknowns / sizes.block, 1.0) ** 3
    dense, form = dense_s(sizes), _form_s(sizes)
    # PCG is charged less for a map that a factor with more products spans: if not even that is less than a dense S, it
    # never is.
    as_dense = max((dense - form) * _SPARSE_FLOPS / (2.0 * sizes.block**3), low)
    if as_dense < high and (exact or pcg_s(sizes, as_dense) >= dense):
        return as_dense
    while high > 1.001 * low:
        middle = math.sqrt(low * high)
        others = min(dense, math.inf if exact else pcg_s(sizes, middle)) - form
        low, high = (middle, high) if 2.0 * sizes.block**3 * middle < others * _SPARSE_FLOPS else (low, middle)
    return high


def cheapest(sizes: Sizes, factor: Factor, *, exact: bool = False) -> str:
    """Return sparse, dense or pcg; pcg only where it costs less, if need be with less memory, than what is exact."""
    costs = {"sparse": sparse_s(sizes, factor), "dense": dense_s(sizes), "pcg": pcg_s(sizes, factor.products)}
    if exact and math.isfinite(min(costs["sparse"], costs["dense"])):
        del costs["pcg"]
    return min(costs, key=lambda name: costs[name])


def describe(kind: str, n: int, sizes: Sizes | None, factor: Factor | None) -> str:
    """Return a line for the report."""
    dense = f"{1e-9 * n**3 / 3.0:.2g}"
    if kind == "dense":
        return f"dense Cholesky ({n} unknowns, {dense} GFLOP)"
    if kind == "sparse" and sizes is not None and factor is not None:
        columns = n // sizes.block
        share = 100.0 * factor.blocks / (columns * (columns + 1) / 2.0)
        own = f"{1e-9 * flops(sizes, factor):.2g}"
        return f"sparse Cholesky ({n} unknowns, fill {share:.2g} %, {own} GFLOP against {dense} dense)"
    name = "sparse Cholesky" if kind == "sparse" else "PCG"
    return f"{name} ({n} unknowns)"


def _form_s(sizes: Sizes) -> float:
    return 6.0 * sizes.block**2 * sizes.pairs / _FORM_FLOPS


def _pcg_step_s(sizes: Sizes) -> float:
    return 3.0 * 8.0 * sizes.block * sizes.edges / _BYTES
