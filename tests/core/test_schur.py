# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The reduced step is the dense step; every form of S is the same S."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.config import SolverOptions
from ba_node.core import columns, dense_products, linear
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem, State
from ba_node.core.schur import ReducedSystem, Structure, inverse_cholesky3, normal_equations

SHAPES = [{}, {"stereo": True, "depth": True}, {"free_intrinsics": True}, {"fixed": 0}, {"fixed": 3}]
Make = Callable[..., tuple[Problem, State]]


def dense_jacobian(problem: Problem, objective: Objective) -> tuple[np.ndarray, np.ndarray]:
    """Return J over free keyframes and points and r, put together row by row."""
    lin, obs = objective.linearise(problem.start), problem.observations
    free = np.flatnonzero(~problem.fixed)
    n_obs, d, size = lin.d_keyframe.shape
    jacobian = np.zeros((n_obs * d, size * len(free) + 3 * problem.n_points))
    for i in range(n_obs):
        rows = slice(i * d, (i + 1) * d)
        if not problem.fixed[obs.keyframe[i]]:
            k = int(np.searchsorted(free, obs.keyframe[i]))
            jacobian[rows, k * size : (k + 1) * size] = lin.d_keyframe[i]
        start = size * len(free) + 3 * obs.point[i]
        jacobian[rows, start : start + 3] = lin.d_point[i]
    return jacobian, lin.residual.ravel()


@pytest.mark.parametrize("mu", [1e-6, 1e-2, 1e3])
@pytest.mark.parametrize("shape", SHAPES)
def test_reduced_step_is_the_dense_step(shape: dict[str, object], mu: float, make_problem: Make) -> None:
    problem, _ = make_problem(**shape)
    objective = Objective(problem, SolverOptions(loss="huber"))
    jacobian, residual = dense_jacobian(problem, objective)
    n_c = jacobian.shape[1] - 3 * problem.n_points
    hessian, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    damping = mu * np.diagonal(hessian)
    expected = np.linalg.solve(hessian + np.diag(damping), -gradient)
    structure = Structure(problem)
    equations = normal_equations(structure, objective.linearise(problem.start))
    damping_c = damping[:n_c].reshape(-1, structure.size)
    system = ReducedSystem(structure, equations, damping_c, damping[n_c:].reshape(-1, 3))
    step_c = linear.cholesky(system.dense(), system.rhs).x
    assert step_c is not None
    step = np.concatenate([step_c, system.expand(step_c)[1].ravel()])
    assert np.linalg.norm(step - expected) <= 1e-8 * np.linalg.norm(expected)
    assert equations.gradient_norm == pytest.approx(np.linalg.norm(gradient), rel=1e-12)


@pytest.mark.parametrize("shape", [{}, {"stereo": True, "depth": True}, {"fixed": 3}])
def test_both_ways_to_couple_poses_and_points_agree(shape: dict[str, object], make_problem: Make) -> None:
    problem, _ = make_problem(**shape)
    structure = Structure(problem)
    lin = Objective(problem, SolverOptions(parameterisation="local", loss="huber")).linearise(problem.start)
    assert lin.points is not None
    expected = structure.edge_products(lin.d_keyframe, lin.d_point)
    found = structure.local_edge_products(columns.squares(lin.d_point), lin.points)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
    others = Objective(problem, SolverOptions(parameterisation="global")).linearise(problem.start)
    assert others.points is None


@pytest.mark.parametrize("shape", SHAPES)
def test_all_forms_of_s_agree(shape: dict[str, object], make_problem: Make) -> None:
    problem, _ = make_problem(**shape)
    structure = Structure(problem)
    equations = normal_equations(structure, Objective(problem, SolverOptions()).linearise(problem.start))
    d_c, d_p = equations.diagonals()
    system = ReducedSystem(structure, equations, 1e-3 * d_c, 1e-3 * d_p)
    dense = system.dense()
    n = structure.n_free
    np.testing.assert_allclose(dense, dense.T, rtol=0, atol=1e-12 * np.abs(dense).max())
    np.testing.assert_allclose(system.sparse().toarray(), dense, rtol=0, atol=1e-12 * np.abs(dense).max())
    x = np.random.default_rng(0).normal(size=len(dense))
    np.testing.assert_allclose(system.product(x), dense @ x, rtol=1e-9, atol=1e-9 * np.abs(dense).max())
    view = dense.reshape(n, structure.size, n, structure.size)
    blocks = np.stack([view[k, :, k] for k in range(n)])
    np.testing.assert_allclose(system.diagonal_blocks()[0], blocks, rtol=1e-9, atol=1e-12 * np.abs(dense).max())


@pytest.mark.parametrize(
    "shape", [*SHAPES, {"fixed": 5}, {"keyframes": 12, "seen_share": 0.2}, {"keyframes": 50, "points": 9}]
)
def test_dense_products_in_batches_are_the_products_of_blocks(
    shape: dict[str, object], make_problem: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batches of any size, the last one not full, with keyframes that see none of it."""
    structure = Structure(make_problem(**shape)[0])
    blocks = np.random.default_rng(0).normal(size=(structure.n_edges, structure.size, 3))
    z = structure.edge_matrix(blocks).toarray()
    for size in (1, 7, 40, 100):
        monkeypatch.setattr(dense_products, "_BATCH", size)
        products = dense_products.DenseProducts(structure.edge_point, structure.edge_keyframe, structure.size)
        np.testing.assert_allclose(products.outer(blocks, structure.n_free), z @ z.T, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(structure.edge_matrix_transposed(blocks).toarray(), z.T)
    x_p, x_c = np.arange(3.0 * structure.n_points), np.arange(1.0 * len(z))
    np.testing.assert_allclose(structure.to_keyframes(blocks, x_p.reshape(-1, 3)).ravel(), z @ x_p, atol=1e-10)
    np.testing.assert_allclose(structure.to_points(blocks, x_c.reshape(-1, structure.size)).ravel(), z.T @ x_c)


def test_a_window_takes_dense_products_and_few_common_points_do_not(make_problem: Make) -> None:
    window = Structure(make_problem(keyframes=20, points=300)[0])
    blocks = np.random.default_rng(0).normal(size=(window.n_edges, window.size, 3))
    z = window.edge_matrix(blocks)
    outer = window.edge_outer(blocks)
    assert outer is not None
    np.testing.assert_allclose(outer, (z @ z.T).toarray(), rtol=0, atol=1e-11)
    far_apart = Structure(make_problem(keyframes=5, points=5)[0])
    assert far_apart.edge_outer(np.zeros((far_apart.n_edges, 6, 3))) is None


@pytest.mark.parametrize("shape", SHAPES)
def test_tight_pcg_and_sparse_cholesky_give_the_cholesky_step(shape: dict[str, object], make_problem: Make) -> None:
    problem, _ = make_problem(**shape)
    structure = Structure(problem)
    equations = normal_equations(structure, Objective(problem, SolverOptions()).linearise(problem.start))
    d_c, d_p = equations.diagonals()
    system = ReducedSystem(structure, equations, 1e-3 * d_c, 1e-3 * d_p)
    exact = linear.cholesky(system.dense(), system.rhs).x
    sparse = linear.cholesky(system.sparse(), system.rhs).x
    inverse = np.linalg.inv(system.diagonal_blocks()[0])
    found = linear.pcg_steihaug(
        system.product,
        system.rhs,
        lambda r: (inverse @ r.reshape(-1, structure.size, 1)).ravel(),
        linear.PcgLimits(t_eps=1e-13, max_iterations=5000),
    )
    assert exact is not None and sparse is not None and found.x is not None
    assert np.linalg.norm(found.x - exact) <= 1e-7 * np.linalg.norm(exact)
    assert np.linalg.norm(sparse - exact) <= 1e-8 * np.linalg.norm(exact)


@given(st.integers(0, 10_000), st.integers(1, 3))
def test_inverse_cholesky_of_blocks(seed: int, rank: int) -> None:
    """L^-1 C L^-T is the identity on the directions that C determines, zero elsewhere."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(20, 3, rank))
    c = a @ np.swapaxes(a, 1, 2) * 10.0 ** rng.uniform(-6, 6)
    inverse = inverse_cholesky3(c)
    assert np.isfinite(inverse).all()
    if rank == 3:
        product = inverse @ c @ np.swapaxes(inverse, 1, 2)
        condition = np.linalg.cond(c).max()
        np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), c.shape), atol=1e-14 * max(condition, 100.0))


def test_a_point_that_nobody_sees_does_not_move() -> None:
    assert not inverse_cholesky3(np.zeros((2, 3, 3))).any()
