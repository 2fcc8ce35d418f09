# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of the experiments on open problems do what they say, and the figures rest on what they measure."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core import scaling
from ba_node.core.numpy_kernels import NumpyKernels, preconditioner
from ba_node.core.objective import Objective
from ba_node.core.solver import solve
from ba_node.io.bal import to_problem
from ba_node.offline.solver_settings import solver_options
from experiments.thesis.conditioning import WORST, conditions, worst
from experiments.thesis.data_sets import DATA_SETS, KITTI, read_kitti
from experiments.thesis.matrix_forms import FORMS
from experiments.thesis.problems import Posed, known_calibration, one_calibration
from experiments.thesis.sphere import generate_sphere
from experiments.thesis.sphere_file import start_of, truth_of
from experiments.thesis.sphere_options import SphereOptions
from experiments.thesis.variants import MU_FLOOR, Cured, SharedIntrinsics, UnscaledPreconditioner, lone

SMALL = SphereOptions(images=8, points=60, min_image_points=10, outlier_share=0.05)
ONE = dataclasses.replace(SMALL, outlier_share=0.0, camera_spread=0.0)


def posed(options: SphereOptions) -> Posed:
    sphere = generate_sphere(options)
    return Posed(to_problem(start_of(sphere)), to_problem(truth_of(sphere)).start)


@pytest.mark.parametrize("kind", ["schur_block", "b_block", "schur_diag", "b_diag"])
def test_m_as_it_stands_is_that_of_the_matrix_without_scaling(kind: str) -> None:
    """In the scaled space it is applied as the inverse of S's own blocks, where the solver's own is D^-1 S D^-1's."""
    problem = posed(SMALL).problem
    options = solver_options("dinm", [f"preconditioner={kind}"])
    found = {}
    for kernels in (UnscaledPreconditioner, NumpyKernels):
        made = kernels(problem, options)
        made.linearise(problem.start)
        system = made.damp("identity", 10.0)
        scale = 1.0 / system.gather(*scaling.scaled_space("inc", made.diagonals()))
        r = np.random.default_rng(0).normal(size=len(system.rhs))
        found[kernels] = preconditioner(kind, system, scale)(r)
        plain = system.dense()
    own = NumpyKernels(problem, options)
    own.linearise(problem.start)
    standing = preconditioner(kind, own.damp("identity", 10.0), np.ones_like(scale))(r)
    np.testing.assert_allclose(found[UnscaledPreconditioner], standing, rtol=1e-6)
    assert np.linalg.norm(found[NumpyKernels] - standing) > 0.1 * np.linalg.norm(standing)
    assert np.isfinite(plain).all()


class TestCure:
    def test_points_that_nothing_holds_leave_the_equations(self) -> None:
        problem = posed(SMALL).problem
        rules = SolverOptions(loss="truncated_quadratic", loss_scale_px=20.0)
        plain, cured = NumpyKernels(problem, rules), Cured(problem, rules)
        assert plain.linearise(problem.start) == cured.linearise(problem.start), "the objective counts all"
        left = lone(problem, Objective(problem, rules).linearise(problem.start))
        assert 0 < left.sum() < problem.n_points
        blocks = cured._equations.c
        assert not blocks[left].any() and not cured._equations.gradient_p[left].any()
        np.testing.assert_array_equal(blocks[~left], plain._equations.c[~left])

    def test_mu_has_a_floor(self) -> None:
        problem = posed(SMALL).problem
        cured = Cured(problem, SolverOptions())
        cured.linearise(problem.start)
        assert (cured.damp("identity", 1e-30).dense() == cured.damp("identity", MU_FLOOR).dense()).all()

    def test_it_bounds_the_conditions_that_reweighting_spoils(self) -> None:
        """Without it the damped blocks of C follow 1/mu beyond what numbers hold, and textbook algebra breaks."""
        settings = ("irls_tq", "60", "", "gamma=3", "annealing=none")
        spoilt = conditions(posed(SMALL), settings, lambda: 0.0)["figures"]
        cure = ("irls_tq", "60", "cured", "damping=diag", "initial_damping=1e-3", "gamma=3", "annealing=none")
        cured = conditions(posed(SMALL), cure, lambda: 0.0)["figures"]
        assert spoilt["lone_points"] > 0 and spoilt["condition_c"] > 1e11 and spoilt["breaks"] > 0, spoilt
        assert cured["condition_c"] < 1e10 and cured["breaks"] == 0, cured
        assert np.isfinite(spoilt["objective"]) and np.isfinite(cured["objective"])


def test_worst_condition() -> None:
    blocks = np.stack([np.diag([1.0, 2.0, 8.0]), np.diag([1.0, 1.0, 1.0])])
    assert worst(blocks) == pytest.approx(8.0)
    assert worst(np.zeros((1, 3, 3))) == WORST
    assert worst(np.diag([1.0, -1e-17])[None]) == WORST


class TestCalibration:
    def test_one_camera_has_one_calibration(self) -> None:
        sphere = generate_sphere(ONE)
        assert (sphere.cameras[:, 6:] == sphere.cameras[0, 6:]).all()
        spread = generate_sphere(dataclasses.replace(ONE, camera_spread=1.0))
        assert len(np.unique(spread.cameras[:, 6])) == ONE.images

    def test_shared_steps_are_those_of_the_tied_equations(self) -> None:
        """By another route: columns of f, k1 and k2 of the dense J added up over the images."""
        problem = one_calibration(posed(ONE).problem)
        h, g = FORMS["explicit dense"](problem, Objective(problem, SolverOptions()).linearise(problem.start))
        n, rest = problem.n_keyframes, 3 * problem.n_points
        tie = np.zeros((9 * n + rest, 6 * n + 3 + rest))
        for k in range(n):
            tie[9 * k : 9 * k + 6, 6 * k : 6 * k + 6] = np.eye(6)
            tie[9 * k + 6 : 9 * k + 9, 6 * n : 6 * n + 3] = np.eye(3)
        tie[9 * n :, 6 * n + 3 :] = np.eye(rest)
        h = np.asarray(h) + np.eye(len(g))
        expected = tie @ np.linalg.solve(tie.T @ h @ tie, -tie.T @ g)
        kernels = SharedIntrinsics(problem, SolverOptions())
        kernels.linearise(problem.start)
        system = kernels.damp("identity", 1.0)
        x = system.solve_dense()
        assert x is not None
        step_c, step_p, _ = system.back_substitute(x)
        step = np.concatenate([step_c.ravel(), step_p.ravel()])
        assert np.linalg.norm(step - expected) <= 1e-8 * np.linalg.norm(expected)

    def test_known_shared_and_free_fit_in_that_order(self) -> None:
        """Each is free to do what the one before does: its objective is no higher, and its images stay one camera's."""
        given = posed(ONE)
        assert given.truth is not None
        options = solver_options("lma_cd", ["linear_solver=dense", "function_tolerance=1e-12", "max_iterations=100"])
        shared_problem = one_calibration(given.problem)
        kernels = SharedIntrinsics(shared_problem, options)
        known = solve(known_calibration(given.problem, given.truth), options)
        shared, free = solve(shared_problem, options, kernels=kernels), solve(shared_problem, options)
        own = shared.state.intrinsics
        np.testing.assert_allclose(own, np.broadcast_to(own[0], own.shape), rtol=1e-9, atol=1e-12)
        assert free.objective_after < shared.objective_after < known.objective_after
        assert abs(own[0, 0] - given.truth.intrinsics[0, 0]) < 0.02 * given.truth.intrinsics[0, 0]


class TestData:
    def test_kitti_is_the_problem_that_others_solve(self, shared_data: Path) -> None:
        """Its objectives at start and end are those of a batch solve by another library."""
        problem = read_kitti(DATA_SETS[KITTI].find(shared_data))
        problem.check()
        result = solve(problem, solver_options("auto", ["function_tolerance=1e-12", "max_iterations=100"]))
        assert result.objective_before == pytest.approx(17069.622, abs=1e-3)
        assert result.objective_after == pytest.approx(2042.482, abs=2e-3)

    def test_every_data_set_says_where_it_comes_from(self, tmp_path: Path) -> None:
        for name, data_set in DATA_SETS.items():
            assert data_set.path(tmp_path) is None
            words = data_set.left_out(name, tmp_path)
            assert "https://" in words and str(tmp_path) in words


def test_a_system_by_other_kernels_is_solved_with_them() -> None:
    """The loop takes the kernels that it is given."""
    problem = posed(SMALL).problem
    asked = []

    class Counted(NumpyKernels):
        def damp(self, kind: str, mu: float):  # type: ignore[no-untyped-def]
            asked.append(mu)
            return super().damp(kind, mu)

    options = solver_options("lma_cd", ["max_iterations=3"])
    result = solve(problem, options, kernels=Counted(problem, options))
    assert len(asked) == 3 and result.objective_after == solve(problem, options).objective_after


@pytest.fixture(scope="module")
def recorded() -> dict[str, dict[str, dict[str, float]]]:
    path = Path(__file__).resolve().parents[3] / "docs" / "thesis_results.json"
    found: dict[str, dict[str, dict[str, float]]] = json.loads(path.read_text())
    return found


def test_fifty_steps_of_local_dinm_in_numpy_took_under_thirty_seconds(
    recorded: dict[str, dict[str, dict[str, float]]],
) -> None:
    row = recorded["4.2"]["local"]
    assert row["steps"] == 50.0 and row["seconds"] < 30.0
