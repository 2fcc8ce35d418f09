# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The C++ kernels give the same bits for any number of threads, and ask for no memory in an iteration."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core import solver
from ba_node.core.native_kernels import NativeKernels
from ba_node.core.problem import Problem, State

Make = Callable[..., tuple[Problem, State]]
SHAPES = {"pinhole": {"distorted": False}, "rig with depth": {"stereo": True, "depth": True}, "own intrinsics": {}}
pytestmark = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")


def large(shape: str, make_problem: Make) -> Problem:
    """Return a problem that is worked on in several pieces, from a start far off."""
    own = shape == "own intrinsics"
    return make_problem(points=400, keyframes=12, start_error=0.03, free_intrinsics=own, **SHAPES[shape])[0]


def quantities(problem: Problem, threads: int) -> dict[str, object]:
    """Return everything that the kernels compute."""
    kernels = NativeKernels(problem, SolverOptions(loss="huber", threads=threads))
    assert kernels._kernel.n_chunks > 4, "too small: one piece is all that a thread needs"
    out: dict[str, object] = {"value": kernels.linearise(problem.start), "norm": kernels.gradient_norm}
    system = kernels.damp("diag", 1e-3)
    x = system.solve_dense()
    assert x is not None
    out |= {"rhs": system.rhs.copy(), "x": x.copy(), "dense": system.dense(), "sparse": system.sparse().toarray()}
    out |= {"product": system.product(x), "blocks": system.diagonal_blocks()[0], "back": system.back_substitute(x)[1:]}
    moved = kernels.step(problem.start, system, x, 3)
    out |= {"moved": (dataclasses.astuple(moved.state), *moved[1:]), "objective": kernels.objective(moved.state)}
    return out


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("threads", [2, 3])
def test_every_quantity_is_the_same_for_any_number_of_threads(shape: str, threads: int, make_problem: Make) -> None:
    problem = large(shape, make_problem)
    one, more = quantities(problem, 1), quantities(problem, threads)
    for name, expected in one.items():
        assert _bits(expected) == _bits(more[name]), name


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("threads", [0, 2, 3])
def test_whole_solves_are_the_same_for_any_number_of_threads(shape: str, threads: int, make_problem: Make) -> None:
    problem = large(shape, make_problem)
    one = solver.solve(problem, SolverOptions(kernels="native"))
    more = solver.solve(problem, SolverOptions(kernels="native", threads=threads))
    assert len(one.trace) > 3
    assert one.trace == more.trace
    assert _bits(dataclasses.astuple(one.state)) == _bits(dataclasses.astuple(more.state))


@pytest.mark.parametrize("shape", SHAPES)
def test_an_iteration_asks_for_no_memory(shape: str, make_problem: Make) -> None:
    """Neither the kernels for any, nor Python for as much as one array over the points."""
    problem = large(shape, make_problem)
    kernels = NativeKernels(problem, SolverOptions(loss="huber", threads=2))
    state, known = problem.start, []
    tracemalloc.start()
    for _ in range(4):
        tracemalloc.reset_peak()
        before = native.kernels.allocations(), tracemalloc.get_traced_memory()[0]
        kernels.linearise(state)
        system = kernels.damp("diag", 1e-3)
        x = system.solve_dense()
        assert x is not None
        state = kernels.step(state, system, x, 3).state
        known.append((native.kernels.allocations() - before[0], tracemalloc.get_traced_memory()[1] - before[1]))
    tracemalloc.stop()
    assert known[0][0] > 0, "the first iteration makes room for S, or the counter does not count"
    for count, size in known[1:]:
        assert count == 0
        assert size < problem.start.points.nbytes, f"{size} bytes"


def _bits(value: object) -> object:
    """Return a value in which arrays are compared byte by byte."""
    if isinstance(value, tuple):
        return tuple(_bits(part) for part in value)
    return value.tobytes() if isinstance(value, np.ndarray) else value
