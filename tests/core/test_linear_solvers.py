# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Dense, sparse and PCG give the same step; the choice between them follows their costs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node import native
from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import linear, linear_costs, native_kernels, solver
from ba_node.core.kernels import Hessian, System
from ba_node.core.linear_costs import Factor, Sizes
from ba_node.core.numpy_kernels import NumpySystem, preconditioner
from ba_node.core.problem import Observations, Problem, State
from ba_node.core.reduced import ReducedSolver
from tests.core.conftest import Spec, make

Make = Callable[..., tuple[Problem, State]]
built = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")


def _telling(diagonals: tuple[FloatArray, FloatArray]) -> Hessian:
    def tell(*, of_points: bool) -> tuple[FloatArray, FloatArray]:
        return diagonals if of_points else (diagonals[0], diagonals[1][:0])

    return tell


def only(problem: Problem, kept: np.ndarray) -> Problem:
    """Return the problem with some of its observations."""
    fields = {
        field.name: value[kept] if len(value := getattr(problem.observations, field.name)) else value
        for field in dataclasses.fields(Observations)
    }
    return dataclasses.replace(problem, observations=Observations(**fields))


def ring(problem: Problem, reach: int) -> Problem:
    """Keep observations by up to ``reach`` neighbours on a ring of keyframes, so that S has a band and a corner."""
    obs, n = problem.observations, problem.n_keyframes
    return only(problem, (obs.keyframe - obs.point) % n < reach)


def systems(problem: Problem, damping: float, backend: str = "native") -> tuple[System, tuple[np.ndarray, np.ndarray]]:
    """Return the system of the start with Marquardt damping, and the diagonal of H."""
    kernels = native_kernels.make(problem, SolverOptions(kernels=backend))
    kernels.linearise(problem.start)
    d_c, d_p = kernels.diagonals()
    system = kernels.reduce(damping * np.maximum(d_c, 1e-6), damping * np.maximum(d_p, 1e-6))
    return system, (d_c, d_p)


@built
@pytest.mark.parametrize("damping", [1e-8, 1e-4, 1.0])
@pytest.mark.parametrize("free_intrinsics", [False, True])
@pytest.mark.parametrize("reach", [2, 4, 13])
def test_every_linear_solver_gives_the_dense_step(
    reach: int, free_intrinsics: bool, damping: float, make_problem: Make
) -> None:
    whole, _ = make_problem(keyframes=13, points=400, free_intrinsics=free_intrinsics, fixed=2, seen_share=1.0)
    problem = ring(whole, reach)
    system, hessian = systems(problem, damping)
    expected = np.linalg.solve(system.dense(), system.rhs)
    scale = np.abs(expected).max()
    condition = np.linalg.cond(system.dense())
    tolerance = max(1e-8, 1e-15 * condition) * scale
    for kind, options in {
        "dense": SolverOptions(linear_solver="dense"),
        "sparse": SolverOptions(linear_solver="sparse"),
        "auto": SolverOptions(),
    }.items():
        found = ReducedSolver(options).solve(system, _telling(hessian), np.inf).x
        assert found is not None, kind
        worst = float(np.abs(found - expected).max())
        assert worst <= tolerance, f"{kind}: off by {worst / scale:.1e}, condition {condition:.1e}"
    if damping >= 1e-4:
        options = SolverOptions(linear_solver="pcg", t_eps=1e-14, max_linear_iterations=20_000)
        found = ReducedSolver(options).solve(system, _telling(hessian), np.inf).x
        assert found is not None
        np.testing.assert_allclose(system.product(found), system.rhs, atol=1e-9 * np.abs(system.rhs).max())


@pytest.mark.slow
@built
@given(seed=st.integers(0, 10_000), keyframes=st.integers(2, 30), share=st.floats(0.02, 1.0), own=st.booleans())
def test_sparse_solution_for_any_pattern(seed: int, keyframes: int, share: float, own: bool) -> None:
    """Whoever shares points with whom, isolated keyframes and empty rows too."""
    problem, _ = make(Spec(keyframes=keyframes, points=60, free_intrinsics=own, fixed=1, seed=seed))
    kept = np.random.default_rng(seed).random(len(problem.observations)) < share
    system, _ = systems(only(problem, kept), 1e-2)
    assert isinstance(system, native_kernels.NativeSystem)
    factor = system.factor_size(2**40, np.inf)
    assert factor.complete
    x = system.solve_sparse()
    assert x is not None
    dense = system.dense()
    np.testing.assert_allclose(dense @ x, system.rhs, rtol=0, atol=1e-9 * max(1.0, np.abs(system.rhs).max()))
    np.testing.assert_array_equal(x, system.solve_sparse(), "the same numbers every time")
    np.testing.assert_allclose(system.sparse().toarray(), dense, rtol=0, atol=1e-12 * np.abs(dense).max(initial=1e-300))


@built
@pytest.mark.parametrize("shape", [{}, {"stereo": True, "depth": True}, {"free_intrinsics": True}])
def test_diagonal_blocks_are_those_of_the_system(shape: dict[str, object], make_problem: Make) -> None:
    problem, _ = make_problem(keyframes=12, points=300, **shape)
    system, _ = systems(ring(problem, 5), 1e-3)
    whole = system.sparse().toarray()
    d = 9 if "free_intrinsics" in shape else 6
    own = np.stack([whole[i : i + d, i : i + d] for i in range(0, len(whole), d)])
    np.testing.assert_allclose(system.diagonal_blocks()[0], own, rtol=0, atol=1e-13 * np.abs(whole).max())


@built
def test_keyframes_far_apart_that_meet_again(make_problem: Make) -> None:
    """On a ring of 110 the row of the first keyframe spans all columns for three blocks: there they are searched."""
    whole, _ = make_problem(keyframes=110, points=330, fixed=0, seen_share=1.0)
    problem = ring(whole, 2)
    found, expected = systems(problem, 1e-3)[0].dense(), systems(problem, 1e-3, "numpy")[0].dense()
    assert np.count_nonzero(expected[:6].reshape(6, 110, 6).any(axis=(0, 2))) == 3
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@built
@pytest.mark.parametrize("kind", ["none", "schur_block", "schur_diag", "b_block", "b_diag"])
@pytest.mark.parametrize("formed", [False, True])
@pytest.mark.parametrize("own", [False, True])
def test_the_kernels_pcg_goes_as_that_of_linear(kind: str, formed: bool, own: bool, make_problem: Make) -> None:
    """To the same place by as many steps or so, be it converged, at the cap, or at the boundary of a region."""
    problem, _ = make_problem(keyframes=12, points=300, free_intrinsics=own)
    system, hessian = systems(ring(problem, 5), 1e-2)
    scale = 1.0 / np.sqrt(np.maximum(hessian[0].ravel(), 1e-6))
    s = system.sparse().toarray() * scale[:, None] * scale
    oracle = systems(ring(problem, 5), 1e-2, "numpy")[0]
    assert isinstance(oracle, NumpySystem)
    precondition = preconditioner(kind, oracle, scale)
    whole = linear.pcg_steihaug(lambda x: s @ x, scale * system.rhs, precondition, linear.PcgLimits(1e-8, 2000)).x
    assert whole is not None
    length = float(np.linalg.norm(whole))
    for limits in (
        linear.PcgLimits(1e-9, 5000),
        linear.PcgLimits(0.1, 500, np.inf, 0.1),
        linear.PcgLimits(1e-8, 4),
        linear.PcgLimits(1e-8, 500, 0.3 * length),
    ):
        expected = linear.pcg_steihaug(lambda x: s @ x, scale * system.rhs, precondition, limits)
        found = system.solve_pcg(kind, scale, limits, formed=formed)
        assert found.x is not None and expected.x is not None
        assert found.on_boundary == expected.on_boundary == np.isfinite(limits.radius)
        assert abs(found.iterations - expected.iterations) <= 1 + expected.iterations // 6
        off = float(np.linalg.norm(found.x / scale - expected.x)) / length
        assert off <= 1e-6, f"{limits}: off by {off:.1e} of the solution"
        if found.on_boundary:
            assert abs(np.linalg.norm(found.x / scale) / limits.radius - 1.0) <= 1e-12


@built
def test_pcg_is_tried_where_its_steps_cost_next_to_nothing(make_problem: Make) -> None:
    """On a problem where every keyframe sees every point; a problem that needs many steps is then solved exactly."""
    problem, _ = make_problem(keyframes=80, points=200, seen_share=1.0, fixed=2, start_error=0.003, spacing_m=0.06)
    begun = solver.solve(problem, SolverOptions(q_eps=0.1, max_iterations=1))
    assert begun.linear_solver.startswith("PCG") and begun.linear_iterations > 0
    tried = solver.solve(problem, SolverOptions(q_eps=0.1, function_tolerance=1e-9))
    exact = solver.solve(problem, SolverOptions(linear_solver="cholesky", function_tolerance=1e-9))
    assert tried.linear_iterations > 0 and exact.linear_iterations == 0
    assert "PCG" not in tried.linear_solver and "PCG" not in exact.linear_solver
    np.testing.assert_allclose(tried.objective_after, exact.objective_after, rtol=1e-9)
    assert exact.objective_after < 1e-3 * exact.objective_before
    few = Sizes(unknowns=228, block=6, edges=600, pairs=1200)
    assert linear_costs.pcg_tries(few) == 0


@pytest.mark.parametrize(("keyframes", "is_tried"), [(100, True), (300, True), (500, False), (36_000, False)])
def test_pcg_is_not_tried_on_maps_that_are_many_tracks_long(keyframes: int, is_tried: bool) -> None:
    """Each point is seen by 95 keyframes; on 36 000 ten iterations of a step each were lost before the factor."""
    sizes = Sizes(unknowns=6 * keyframes, block=6, edges=190 * keyframes, pairs=190 * 48 * keyframes)
    assert (linear_costs.pcg_tries(sizes) > 0) == is_tried


@built
def test_a_try_that_does_not_get_there_is_the_last(make_problem: Make) -> None:
    problem, _ = make_problem(keyframes=12, points=300, fixed=0)
    system, hessian = systems(problem, 1e-9)
    reduced = ReducedSolver(SolverOptions())
    reduced._tries = 2
    found = reduced.solve(system, _telling(hessian), np.inf)
    assert found.x is not None and found.iterations == 0 and reduced._tries == 0
    np.testing.assert_allclose(system.dense() @ found.x, system.rhs, atol=1e-6 * np.abs(system.rhs).max())


@built
@pytest.mark.parametrize("linear_solver", ["dense", "sparse"])
def test_singular_system_has_no_solution(linear_solver: str, make_problem: Make) -> None:
    """A free keyframe that sees nothing, without damping: its block of S is zero."""
    problem, _ = make_problem(keyframes=6, fixed=1)
    problem = only(problem, problem.observations.keyframe != 4)
    system, hessian = systems(problem, 0.0)
    assert ReducedSolver(SolverOptions(linear_solver=linear_solver)).solve(system, _telling(hessian), np.inf).x is None
    result = solver.solve(problem, SolverOptions(linear_solver=linear_solver))
    assert result.state.is_finite() and result.status.usable
    assert result.objective_after < result.objective_before


def test_sparse_solver_of_numpy_agrees(make_problem: Make) -> None:
    problem, _ = make_problem(keyframes=8, points=100)
    system, hessian = systems(problem, 1e-3, "numpy")
    found = ReducedSolver(SolverOptions(linear_solver="sparse")).solve(system, _telling(hessian), np.inf).x
    assert found is not None
    np.testing.assert_allclose(found, np.linalg.solve(system.dense(), system.rhs), rtol=1e-7)


def banded(cameras: int, reach: int) -> tuple[Sizes, Factor]:
    """Return sizes of a chain of cameras, each sharing 100 points with each of its neighbours."""
    blocks = cameras * (reach + 1)
    return Sizes(9 * cameras, 9, 700 * cameras, 3000 * cameras), Factor(blocks, cameras * reach * (reach + 1) / 2.0)


def full(cameras: int) -> tuple[Sizes, Factor]:
    """Return sizes where all cameras see all points."""
    edges, pairs = 1000 * cameras, 500 * cameras * (cameras + 1)
    blocks = cameras * (cameras + 1) // 2
    fits = blocks <= linear_costs.max_blocks(9)
    return Sizes(9 * cameras, 9, edges, pairs), Factor(blocks, cameras**3 / 6.0, fits)


def test_chains_are_solved_sparsely_and_large_full_systems_are_not() -> None:
    for cameras in (20, 1000, 100_000):
        assert linear_costs.cheapest(*banded(cameras, 11)) == "sparse", cameras
    assert linear_costs.cheapest(*full(500), exact=True) == "dense"
    assert linear_costs.cheapest(*full(20_000), exact=True) == "pcg", "no factor fits into memory"
    assert linear_costs.cheapest(*full(5000)) == "pcg"


def test_a_long_map_is_not_left_to_pcg() -> None:
    """A corridor whose points are seen from 95 keyframes each: its factor costs more than 60 steps of PCG, not more
    than the hundreds that it takes to carry a correction from one end to the other."""
    for keyframes in (1000, 36_000):
        sizes = Sizes(6 * keyframes, 6, 190 * keyframes, 8300 * keyframes)
        factor = Factor(95 * keyframes, 4500.0 * keyframes)
        assert linear_costs.cheapest(sizes, factor) == "sparse"
        assert linear_costs.pcg_s(sizes, factor.products) > 2.0 * linear_costs.sparse_s(sizes, factor)
        assert factor.products < linear_costs.max_products(sizes), "counting it is not given up"


@given(st.integers(2, 400), st.integers(1, 60))
def test_a_factor_beyond_the_limit_is_never_the_cheapest(cameras: int, reach: int) -> None:
    sizes, factor = banded(cameras, reach)
    if factor.products > linear_costs.max_products(sizes):
        assert linear_costs.cheapest(sizes, factor) != "sparse"


@built
@pytest.mark.parametrize(("keyframes", "is_counted"), [(21, False), (22, True)])
def test_what_each_way_costs_is_not_counted_for_few_unknowns(
    keyframes: int, is_counted: bool, make_problem: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: list[Sizes] = []
    count = native_kernels.NativeSystem.sizes

    def counted(system: native_kernels.NativeSystem) -> Sizes:
        counts.append(count(system))
        return counts[-1]

    monkeypatch.setattr(native_kernels.NativeSystem, "sizes", counted)
    problem, _ = make_problem(keyframes=keyframes, fixed=0)
    system, hessian = systems(problem, 1e-3)
    found = ReducedSolver(SolverOptions()).solve(system, _telling(hessian), np.inf).x
    assert bool(counts) == is_counted
    assert found is not None
    np.testing.assert_allclose(found, np.linalg.solve(system.dense(), system.rhs), rtol=1e-7)


@pytest.mark.parametrize("block", [6, 9])
def test_pcg_is_worth_a_try_for_no_few_unknowns(block: int) -> None:
    """Where every keyframe sees every point there is most to form for each observation."""
    keyframes = linear_costs.FEW_UNKNOWNS // block
    for points in (1, 100, 100_000):
        pairs = points * keyframes * (keyframes + 1) // 2
        assert linear_costs.pcg_tries(Sizes(block * keyframes, block, points * keyframes, pairs)) == 0


@built
def test_the_result_names_the_linear_solver(make_problem: Make) -> None:
    problem, _ = make_problem()
    texts = {
        kind: solver.solve(problem, SolverOptions(linear_solver=kind)).linear_solver
        for kind in ("auto", "dense", "sparse", "pcg")
    }
    assert texts["dense"] == "dense Cholesky (24 unknowns, 4.6e-06 GFLOP)"
    assert texts["dense"] == texts["auto"], "that few are not counted"
    assert texts["sparse"].startswith("sparse Cholesky (24 unknowns, fill 1e+02 %, ")
    assert texts["pcg"] == "PCG (24 unknowns)"
