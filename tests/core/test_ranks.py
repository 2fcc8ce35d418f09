# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ranks that each have a part of the points come to what one process comes to."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from ba_node import native
from ba_node.config import ConfigError, SolverOptions
from ba_node.core import linear_costs, methods, native_kernels
from ba_node.core.communicator import Alone, Communicator
from ba_node.core.problem import Problem, ProblemError, State
from ba_node.core.ranks import RankKernels, deal
from ba_node.core.result import Result
from ba_node.core.solver import solve
from experiments.benchmarks.generators import loop
from experiments.benchmarks.problem_file import case_problem
from tests.core.conftest import Spec, make
from tests.ranks import on_threads


def random_problem(seed: int) -> Problem:
    """Return poses and points that are off, seen with noise."""
    return make(Spec(seed=seed, keyframes=6, points=40, noise_px=0.5))[0]


def on_ranks(problem: Problem, options: SolverOptions, size: int) -> tuple[Sequence[Result], State]:
    """Solve on threads; return the result of each rank, and the whole state."""

    def work(ranks: Communicator) -> Result:
        part, _ = deal(problem, ranks.rank, ranks.size)
        return solve(part, options, kernels=RankKernels(part, options, ranks))

    results = on_threads(size, work)
    points = np.concatenate([result.state.points for result in results])
    return results, dataclasses.replace(results[0].state, points=points)


def options(kernels: str, **changes: Any) -> SolverOptions:
    chosen = dataclasses.replace(methods.options("auto"), kernels=kernels, threads=1, function_tolerance=1e-12)
    return dataclasses.replace(chosen, **changes)


KERNELS = [
    "numpy",
    pytest.param("native", marks=pytest.mark.skipif(native.kernels is None, reason="no C++ kernels built")),
]


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("linear_solver", ["dense", "sparse", "pcg"])
@pytest.mark.parametrize("size", [2, 3])
def test_ranks_come_to_the_same_minimum(kernels: str, linear_solver: str, size: int) -> None:
    problem = random_problem(seed=4)
    chosen = options(kernels, linear_solver=linear_solver, t_eps=1e-10, q_eps=0.0, max_linear_iterations=500)
    alone = solve(problem, chosen)
    results, state = on_ranks(problem, chosen, size)
    assert {result.objective_after for result in results} == {results[0].objective_after}
    assert results[0].objective_before == pytest.approx(alone.objective_before, rel=1e-12)
    assert results[0].objective_after == pytest.approx(alone.objective_after, rel=1e-9)
    # By another route: the objective of the state that the ranks put together.
    value = native_kernels.make(problem, options("numpy")).objective(state)
    assert value == pytest.approx(results[0].objective_after, rel=1e-10)


@pytest.mark.parametrize("kernels", KERNELS)
def test_gradient_is_that_of_the_whole(kernels: str) -> None:
    problem = random_problem(seed=5)
    alone = native_kernels.make(problem, options("numpy"))
    alone.linearise(problem.start)
    results, _ = on_ranks(problem, options(kernels, max_iterations=1), 3)
    assert results[0].trace[0].gradient_norm == pytest.approx(alone.gradient_norm, rel=1e-9)


def test_points_are_dealt_once_and_evenly() -> None:
    problem = random_problem(seed=6)
    size = 4
    parts = [deal(problem, rank, size) for rank in range(size)]
    assert parts[0][1].start == 0 and parts[-1][1].stop == problem.n_points
    assert all(a[1].stop == b[1].start for a, b in itertools.pairwise(parts))
    counts = [len(part.observations) for part, _ in parts]
    most = int(np.bincount(problem.observations.point).max())
    assert sum(counts) == len(problem.observations)
    assert max(counts) - min(counts) <= 2 * most
    joined = np.concatenate([part.observations.uv for part, _ in parts])
    assert np.array_equal(joined, problem.observations.uv)


def test_more_ranks_than_points_are_refused() -> None:
    problem = random_problem(seed=7)
    with pytest.raises(ProblemError, match=f"{problem.n_points + 1} ranks for {problem.n_points} points"):
        deal(problem, 0, problem.n_points + 1)
    parts = [deal(problem, rank, problem.n_points)[1] for rank in range(problem.n_points)]
    assert [part.stop - part.start for part in parts] == [1] * problem.n_points


def test_what_ranks_cannot_do_is_refused() -> None:
    for changes in ({"schur": "cameras"}, {"preconditioner": "b_block"}):
        with pytest.raises(ConfigError, match="several ranks"):
            RankKernels(random_problem(seed=1), options("numpy", **changes), Alone())


@pytest.mark.slow
@pytest.mark.parametrize("kernels", ["numpy", "native"])
def test_ranks_take_the_same_steps_on_two_levels(kernels: str) -> None:
    if kernels == "native" and native.kernels is None:
        pytest.skip("not built")
    problem = case_problem(loop(60, 1200))
    chosen = dataclasses.replace(
        methods.options("auto"),
        kernels=kernels,
        linear_solver="pcg",
        preconditioner="two_level",
        function_tolerance=1e-13,
        t_eps=1e-8,
        q_eps=0.0,
    )
    alone = solve(problem, chosen)
    results, _ = on_ranks(problem, chosen, 3)
    assert "two levels" in results[0].linear_solver
    assert results[0].objective_after == pytest.approx(alone.objective_after, rel=1e-9)


@pytest.mark.skipif(native.kernels is None, reason="not built")
@pytest.mark.parametrize(("share", "two_levels"), [(2.5, True), (1.5, False)])
def test_two_levels_have_to_fit_for_all_ranks_of_a_machine(
    share: float, two_levels: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = case_problem(loop(400, 12000))
    options = dataclasses.replace(methods.options("auto"), max_iterations=1)
    part, _ = deal(problem, 0, 2)
    alone = native_kernels.make(part, options)
    alone.linearise(part.start)
    monkeypatch.setattr(linear_costs, "MAX_BYTES", share * alone.damp("diag", 1e-4).choose("pcg").two_level_bytes)
    results, _ = on_ranks(problem, options, 2)
    assert [result.linear_solver.endswith("on two levels") for result in results] == [two_levels] * 2
