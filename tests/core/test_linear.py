# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Conjugate gradients inside a region (Algorithms 1 and 3), also where the matrix is not what it should be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.core import linear


def system(seed: int, n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Return a well-conditioned positive definite matrix and a right-hand side."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    return a @ a.T + n * np.eye(n), rng.normal(size=n)


def run(a: np.ndarray, b: np.ndarray, **limits: float) -> linear.Solution:
    """Run PCG without a preconditioner."""
    given: dict[str, Any] = {"t_eps": 0.1, "max_iterations": 500, **limits}
    return linear.pcg_steihaug(lambda x: a @ x, b, lambda r: r, linear.PcgLimits(**given))


@given(st.integers(0, 10_000))
def test_tight_pcg_solves(seed: int) -> None:
    a, b = system(seed)
    found = run(a, b, t_eps=1e-12)
    assert found.x is not None and not found.on_boundary
    np.testing.assert_allclose(found.x, np.linalg.solve(a, b), atol=1e-9)


@given(st.integers(0, 10_000), st.floats(0.01, 0.99))
def test_leaves_on_the_boundary(seed: int, share: float) -> None:
    a, b = system(seed)
    radius = share * float(np.linalg.norm(np.linalg.solve(a, b)))
    found = run(a, b, t_eps=1e-12, radius=radius)
    assert found.x is not None and found.on_boundary
    assert np.linalg.norm(found.x) == pytest.approx(radius, rel=1e-12)


@given(st.integers(0, 10_000), st.floats(0.05, 2.0))
def test_the_model_never_rises(seed: int, share: float) -> None:
    a, b = system(seed)
    radius = share * float(np.linalg.norm(np.linalg.solve(a, b)))
    x = run(a, b, radius=radius).x
    assert x is not None
    cauchy = min(float(b @ b) / float(b @ a @ b), radius / float(np.linalg.norm(b))) * b
    assert 0.5 * x @ a @ x - b @ x <= 0.5 * cauchy @ a @ cauchy - b @ cauchy + 1e-12


def test_stops_at_the_forcing_term() -> None:
    a, b = system(1, 40)
    found = run(a, b, t_eps=0.1)
    assert found.x is not None
    residual = float(np.linalg.norm(b - a @ found.x))
    assert residual <= 0.1 * np.linalg.norm(b)
    assert found.iterations < run(a, b, t_eps=1e-10).iterations


def test_negative_curvature_goes_to_the_boundary() -> None:
    a, b = np.diag([1.0, -2.0]), np.array([1.0, 1.0])
    found = run(a, b, radius=5.0)
    assert found.x is not None and found.on_boundary
    assert np.linalg.norm(found.x) == pytest.approx(5.0, rel=1e-12)


def test_negative_curvature_without_a_region_stays_finite() -> None:
    found = run(np.diag([1.0, -2.0]), np.array([1.0, 1.0]))
    assert found.x is not None and np.isfinite(found.x).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_not_finite_input_gives_no_solution(bad: float) -> None:
    a, b = system(2)
    assert run(a, np.full(12, bad)).x is None
    with np.errstate(all="ignore"):
        assert run(np.full((12, 12), bad), b).x is None


def test_zero_right_hand_side_gives_zero() -> None:
    found = run(np.eye(3), np.zeros(3))
    assert found.x is not None and not found.x.any() and found.iterations == 0


def test_cholesky_refuses_an_indefinite_matrix() -> None:
    assert linear.cholesky(np.diag([1.0, -1.0]), np.ones(2)).x is None
    assert linear.cholesky(np.zeros((2, 2)), np.ones(2)).x is None


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_stops_where_further_steps_add_little(seed: int) -> None:
    """With an ill-conditioned matrix the rule of Nash and Sofer saves most steps and little of the gain."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(40, 40)))
    a = (basis * np.logspace(-4, 2, 40)) @ basis.T
    b = a @ rng.normal(size=40)
    whole, early = run(a, b, t_eps=1e-10), run(a, b, t_eps=1e-10, q_eps=0.1)
    assert whole.x is not None and early.x is not None
    gains = [float(b @ x - 0.5 * x @ a @ x) for x in (whole.x, early.x)]
    assert early.iterations < whole.iterations
    assert 0.5 * gains[0] <= gains[1] <= gains[0] * (1.0 + 1e-9), f"{gains[1]:.6g} of {gains[0]:.6g}"


def test_weak_modes_are_seen_by_the_residual_in_energy() -> None:
    """Forty weak modes have half of the energy, and a millionth of |b|: by |r| PCG ends with a quarter of all left."""
    stiffness = np.repeat([1e6, 1e-6], 40)
    inverse = np.concatenate([np.full(40, 1e-6), 1e6 * np.random.default_rng(1).uniform(0.2, 1.5, 40)])
    rhs = np.repeat([1e4, 1e-2], 40)

    def left(*, energy: bool) -> float:
        limits = linear.PcgLimits(0.01, 100, energy=energy)
        x = linear.pcg_steihaug(lambda x: stiffness * x, rhs, lambda r: inverse * r, limits).x
        assert x is not None
        error = x - rhs / stiffness
        return float(np.sqrt(error @ (stiffness * error) / (rhs @ (rhs / stiffness))))

    assert left(energy=False) > 0.25
    assert left(energy=True) < 0.02
