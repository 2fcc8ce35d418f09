# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every way to eliminate gives the step of the dense equations, and every form of H is the same (Table 3.1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse

from ba_node.config import SolverOptions
from ba_node.core import blocks, linear, native_kernels, reduced, scaling
from ba_node.core.kernels import System
from ba_node.core.numpy_kernels import NumpyKernels
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem, State
from experiments.thesis.matrix_forms import FORMS

Make = Callable[..., tuple[Problem, State]]
SHAPES: list[dict[str, object]] = [
    {},
    {"stereo": True, "depth": True},
    {"free_intrinsics": True, "points": 60},
    {"fixed": 0},
    {"fixed": 3},
]
SIDES = ("points", "cameras", "none", "adaptive")
PRECONDITIONERS = ("none", "schur_block", "b_block", "schur_diag", "b_diag")


def dense_equations(problem: Problem, options: SolverOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return H and g by the explicit dense form."""
    h, g = FORMS["explicit dense"](problem, Objective(problem, options).linearise(problem.start))
    return np.asarray(h), g


def damped(problem: Problem, side: str, mu: float, options: SolverOptions) -> tuple[System, np.ndarray, np.ndarray]:
    """Return a system with Marquardt damping, and the damped H and g of the dense form."""
    kernels = NumpyKernels(problem, dataclasses.replace(options, schur=side))
    kernels.linearise(problem.start)
    d_c, d_p = scaling.diagonals("diag", kernels.diagonals())
    h, g = dense_equations(problem, options)
    damping = mu * np.concatenate([d_c.ravel(), d_p.ravel()])
    return kernels.reduce(mu * d_c, mu * d_p), h + np.diag(damping), g


@pytest.mark.parametrize("mu", [1e-6, 1e-2, 1e3])
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("shape", SHAPES)
def test_every_side_gives_the_dense_step(side: str, mu: float, shape: dict[str, object], make_problem: Make) -> None:
    problem, _ = make_problem(**shape)
    system, h, g = damped(problem, side, mu, SolverOptions(loss="huber"))
    expected = np.linalg.solve(h, -g)
    for matrix in (system.dense(), system.sparse()):
        x = linear.cholesky(matrix, system.rhs).x
        assert x is not None
        step_c, step_p, reduction = system.back_substitute(x)
        step = np.concatenate([step_c.ravel(), step_p.ravel()])
        error = np.linalg.norm(step - expected) / np.linalg.norm(expected)
        assert error <= 1e-8, f"{side}, mu {mu}: {error:.1e}"
    undamped, _ = dense_equations(problem, SolverOptions(loss="huber"))
    assert reduction == pytest.approx(-g @ step - 0.5 * step @ undamped @ step, rel=1e-8)


@pytest.mark.parametrize("side", ["points", "cameras", "none"])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_form_of_a_system_agrees(side: str, shape: dict[str, object], make_problem: Make) -> None:
    problem, _ = make_problem(**shape)
    system, h, _ = damped(problem, side, 1e-3, SolverOptions())
    dense, scale = system.dense(), np.abs(system.dense()).max()
    x = np.random.default_rng(0).normal(size=len(dense))
    np.testing.assert_allclose(system.product(x), dense @ x, rtol=1e-9, atol=1e-11 * scale)
    np.testing.assert_allclose(system.sparse().toarray(), dense, atol=1e-12 * scale)
    for kind, matrix in (("diagonal_blocks", dense), ("own_blocks", h)):
        start = len(h) - len(dense) if side == "cameras" and kind == "own_blocks" else 0
        for part in getattr(system, kind)():
            for block in part:
                d = len(block)
                expected = matrix[start : start + d, start : start + d]
                np.testing.assert_allclose(block, expected, atol=1e-11 * scale)
                start += d


@pytest.mark.parametrize("shape", SHAPES)
def test_reduction_of_the_reduced_model_is_that_of_the_full_one(shape: dict[str, object], make_problem: Make) -> None:
    """(3.102): -m(p) = -m_c(pc) + 1/2 gp' C^-1 gp, for any pc with the points that belong to it."""
    problem, _ = make_problem(**shape)
    kernels = NumpyKernels(problem, SolverOptions())
    kernels.linearise(problem.start)
    d_c, d_p = kernels.diagonals()
    system = kernels.reduce(0.0 * d_c, 0.0 * d_p)
    h, g = dense_equations(problem, SolverOptions())
    n_c = len(system.rhs)
    for seed in range(3):
        x = np.random.default_rng(seed).normal(size=n_c) * 1e-3
        _, step_p, reduction = system.back_substitute(x)
        own = system.rhs @ x - 0.5 * x @ system.dense() @ x
        g_p = g[n_c:]
        constant = 0.5 * g_p @ np.linalg.solve(h[n_c:, n_c:], g_p)
        step = np.concatenate([x, step_p.ravel()])
        full = -g @ step - 0.5 * step @ h @ step
        assert own + constant == pytest.approx(full, rel=1e-8)
        assert reduction == pytest.approx(full, rel=1e-8)


@pytest.mark.parametrize("mu", [1e-6, 1e-2, 1e3])
@pytest.mark.parametrize("shape", SHAPES)
def test_reduction_of_the_damped_model(mu: float, shape: dict[str, object], make_problem: Make) -> None:
    """(3.102) of H + mu D: what Algorithm 4 hands on to the gain ratio is the undamped reduction less mu/2 p'D p."""
    problem, _ = make_problem(**shape)
    system, h, g = damped(problem, "points", mu, SolverOptions())
    n_c = len(system.rhs)
    g_p = g[n_c:]
    for seed in range(3):
        x = np.random.default_rng(seed).normal(size=n_c) * 1e-3
        step_c, step_p, undamped = system.back_substitute(x)
        step = np.concatenate([step_c.ravel(), step_p.ravel()])
        plain, _ = dense_equations(problem, SolverOptions())
        held = 0.5 * step @ (h - plain) @ step
        constant = 0.5 * g_p @ np.linalg.solve(h[n_c:, n_c:], g_p)
        own = system.rhs @ x - 0.5 * x @ system.dense() @ x
        assert own + constant == pytest.approx(undamped - held, rel=1e-7, abs=1e-9 * abs(undamped))


@pytest.mark.parametrize("preconditioner", PRECONDITIONERS)
@pytest.mark.parametrize("side", ["points", "cameras", "none"])
@pytest.mark.parametrize("space", ["identity", "diag", "inc"])
def test_pcg_leaves_on_the_boundary(side: str, space: str, preconditioner: str, make_problem: Make) -> None:
    """|D p| is the radius to 1e-12 in scaled space, with any preconditioner."""
    problem, _ = make_problem(free_intrinsics=True, points=60)
    system, _, _ = damped(problem, side, 1e-3, SolverOptions())
    kernels = NumpyKernels(problem, SolverOptions())
    kernels.linearise(problem.start)
    hessian = kernels.diagonals()
    scale = system.gather(*scaling.scaled_space(space, hessian))
    exact = linear.cholesky(system.dense(), system.rhs).x
    assert exact is not None
    radius = 0.3 * float(np.linalg.norm(scale * exact))
    options = SolverOptions(
        trust_region=space, linear_solver="pcg", preconditioner=preconditioner, t_eps=1e-9, max_linear_iterations=5000
    )
    found = reduced.ReducedSolver(options).solve(system, kernels.diagonals, radius)
    assert found.x is not None and found.on_boundary
    assert np.linalg.norm(scale * found.x) == pytest.approx(radius, rel=1e-12)


@pytest.mark.parametrize("preconditioner", PRECONDITIONERS)
@pytest.mark.parametrize("side", ["points", "cameras", "none"])
def test_tight_pcg_without_a_region_gives_the_cholesky_step(side: str, preconditioner: str, make_problem: Make) -> None:
    problem, _ = make_problem(stereo=True)
    system, h, g = damped(problem, side, 1e-2, SolverOptions())
    kernels = NumpyKernels(problem, SolverOptions())
    kernels.linearise(problem.start)
    options = SolverOptions(
        linear_solver="pcg", preconditioner=preconditioner, t_eps=1e-12, max_linear_iterations=20_000
    )
    found = reduced.ReducedSolver(options).solve(system, kernels.diagonals, np.inf)
    assert found.x is not None
    step_c, step_p, _ = system.back_substitute(found.x)
    expected = np.linalg.solve(h, -g)
    step = np.concatenate([step_c.ravel(), step_p.ravel()])
    assert np.linalg.norm(step - expected) <= 1e-6 * np.linalg.norm(expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_four_matrix_forms_give_the_same_equations(shape: dict[str, object], make_problem: Make) -> None:
    problem, _ = make_problem(**shape)
    lin = Objective(problem, SolverOptions(loss="huber")).linearise(problem.start)
    h, g = FORMS["explicit dense"](problem, lin)
    for name, form in FORMS.items():
        other, gradient = form(problem, lin)
        np.testing.assert_allclose(
            scipy.sparse.csr_matrix(other).toarray(), h, rtol=0, atol=1e-12 * np.abs(h).max(), err_msg=name
        )
        np.testing.assert_allclose(gradient, g, rtol=0, atol=1e-12 * np.abs(g).max(), err_msg=name)


def test_the_adaptive_side_follows_the_conditions(make_problem: Make) -> None:
    """Algorithm 10: a point far away spoils C, and cameras are eliminated with the radius times 3m/9n."""
    problem, _ = make_problem(free_intrinsics=True)
    options = SolverOptions(schur="adaptive", trust_region="inc")
    points = problem.start.points.copy()
    points[0] *= 1e4
    far = dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points))
    for example, side, factor in ((problem, "points", 1.0), (far, "cameras", 3.0 * 40 / (9 * 4))):
        kernels = NumpyKernels(example, options)
        kernels.linearise(example.start)
        d_c, d_p = kernels.diagonals()
        system = kernels.reduce(0.0 * d_c, 0.0 * d_p)
        assert system.side == side
        assert system.radius_factor == pytest.approx(factor)


@pytest.mark.parametrize("side", SIDES)
def test_singular_blocks_leave_their_directions_alone(side: str, make_problem: Make) -> None:
    """Without damping a keyframe and a point that nothing determines stay where they are (5.2)."""
    problem, _ = make_problem()
    obs = problem.observations
    kept = np.flatnonzero((obs.keyframe != 4) & (obs.point != 7))
    few = {f.name: getattr(obs, f.name)[kept] for f in dataclasses.fields(obs) if len(getattr(obs, f.name))}
    problem = dataclasses.replace(problem, observations=dataclasses.replace(obs, **few))
    kernels = native_kernels.make(problem, SolverOptions(kernels="numpy", schur=side))
    kernels.linearise(problem.start)
    d_c, d_p = kernels.diagonals()
    system = kernels.reduce(0.0 * d_c, 0.0 * d_p)
    found = linear.pcg_steihaug(system.product, system.rhs, lambda r: r, linear.PcgLimits(1e-6, 2000))
    assert found.x is not None
    step_c, step_p, _ = system.back_substitute(found.x)
    assert np.isfinite(step_c).all() and np.isfinite(step_p).all()
    assert not step_c[3].any() and not step_p[7].any()


def test_blocks() -> None:
    """Inverse roots and lifted inverses are those of numpy where there is an inverse, and finite where not."""
    rng = np.random.default_rng(0)
    a = rng.normal(size=(10, 9, 9)) * 10.0 ** rng.uniform(-4, 4, (10, 1, 9))
    good = np.swapaxes(a, 1, 2) @ a
    roots = blocks.inverse_roots(good)
    product = roots @ good @ np.swapaxes(roots, 1, 2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(9), product.shape), atol=1e-6)
    np.testing.assert_allclose(blocks.positive_inverses(good), np.linalg.inv(good))
    bad = np.stack([np.zeros((3, 3)), np.diag([1.0, 2.0, 0.0]), np.diag([1.0, -1.0, 1.0]), np.full((3, 3), np.nan)])
    for inverse in (blocks.inverse_roots(bad), blocks.positive_inverses(bad)):
        assert np.isfinite(inverse).all()
    assert np.linalg.eigvalsh(blocks.positive_inverses(bad)).min() > 0.0
    root = blocks.inverse_roots(bad)[1]
    np.testing.assert_allclose(root.T @ root, np.diag([1.0, 0.5, 0.0]), atol=1e-15)
    assert blocks.condition(np.zeros((0, 3, 3))) == 1.0
    assert blocks.condition(np.stack([np.eye(3), np.diag([1.0, 4.0, 2.0])])) == pytest.approx(4.0)
    assert blocks.condition(bad[:1]) == np.inf
