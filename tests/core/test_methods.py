# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The named methods: what they choose, what is refused, and that each runs to its stop on every data set."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy

from ba_node.config import Config, ConfigError, SolverOptions, declared
from ba_node.core import methods, native_kernels
from ba_node.core.loss import LOSSES
from ba_node.core.numpy_kernels import NumpyKernels
from ba_node.core.problem import Problem, State
from ba_node.core.reduced import ReducedSolver
from ba_node.core.result import Result, Status
from ba_node.core.solver import solve
from ba_node.io import bal
from ba_node.offline.solver_settings import solver_options

Make = Callable[..., tuple[Problem, State]]
CHOICES = {option.name: option.choices for option in declared(SolverOptions)}
# What the thesis tests of each: the table of its section 3 and 4.
VARIANTS = [
    *((name, ()) for name in methods.METHODS),
    ("lma_cd", ("schur=B",)),
    ("lma_cd", ("schur=H",)),
    ("inm", ("schur=B", "scaling=diag")),
    ("inm", ("schur=H", "scaling=I")),
    ("tnm", ("schur=B", "damping=inc")),
    ("tnm", ("schur=H", "damping=I")),
    ("tnm", ("damping=diag",)),
    ("dinm", ("scaling=inc", "damping=diag")),
    ("dinm", ("scaling=diag", "damping=I")),
    ("dinm", ("scaling=diag", "damping=inc")),
    *(("dinm", (f"preconditioner={name}",)) for name in CHOICES["preconditioner"]),
    ("adinm", ("preconditioner=b_diag",)),
    ("adinm", ("preconditioner=none",)),
    ("adinm", ("schur=adaptive_scaled",)),
    ("irls_huber", ("loss=cauchy",)),
    ("irls_huber", ("loss=geman_mcclure", "gamma=2")),
    ("irls_tq", ("annealing=none",)),
    ("irls_huber", ("loss_per=component",)),
    ("auto", ("loss=geman_mcclure", "gamma=2")),
    ("local_dinm", ("linear_solver=cholesky",)),
]
IDS = ["-".join((name, *settings)) for name, settings in VARIANTS]


def check(result: Result) -> None:
    """Assert what holds for every result."""
    assert result.state.is_finite() and result.reason
    assert result.status in (Status.CONVERGED, Status.MAX_ITERATIONS, Status.STALLED), result.reason
    objectives = [row.objective for row in result.trace]
    assert np.isfinite(objectives).all()
    assert all(b <= a for a, b in itertools.pairwise(objectives)), objectives


@pytest.mark.parametrize("shape", [{}, {"free_intrinsics": True, "points": 60}], ids=["6", "9"])
@pytest.mark.parametrize(("name", "settings"), VARIANTS, ids=IDS)
def test_every_variant_on_a_small_problem(
    name: str, settings: tuple[str, ...], shape: dict[str, object], make_problem: Make
) -> None:
    problem, _ = make_problem(**shape)
    result = solve(problem, solver_options(name, [*settings, "max_iterations=15"]))
    check(result)
    # From its plateau a truncated quadratic does not come down by itself.
    share = 1.0 if "annealing=none" in settings else 0.5
    assert result.objective_after < share * result.objective_before, result.reason


@pytest.mark.parametrize(("name", "settings"), VARIANTS, ids=IDS)
def test_every_variant_on_dubrovnik(name: str, settings: tuple[str, ...], shared_data: Path) -> None:
    problem = bal.to_problem(bal.read_bal(shared_data / "gtsam-dubrovnik-small" / "dubrovnik-3-7-pre.txt"))
    check(solve(problem, solver_options(name, settings)))


@pytest.fixture(scope="module")
def results(shared_data: Path) -> dict[str, Result]:
    """Return what every method makes of Ladybug-49."""
    problem = bal.to_problem(bal.read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"))
    return {name: solve(problem, options) for name, options in methods.METHODS.items()}


@pytest.mark.slow
class TestLadybug:
    """The problem that the thesis measures on, 50 iterations each."""

    def test_every_method_stops_with_a_reason(self, results: dict[str, Result]) -> None:
        for result in results.values():
            check(result)

    def test_gradients(self, results: dict[str, Result]) -> None:
        dinm, local = results["dinm"].gradient_norm, results["local_dinm"].gradient_norm
        adaptive = results["adinm"].gradient_norm
        assert dinm < 10.0, f"dinm: {dinm:.3g}"
        assert adaptive < 1.0, f"adinm: {adaptive:.3g}"
        assert local < 1.0, f"local_dinm: {local:.3g}, dinm: {dinm:.3g}"

    def test_adinm_changes_sides_once_and_gains_by_it(self, results: dict[str, Result]) -> None:
        """Section 4.1: the same as dinm at first, then cameras are eliminated and the gradient falls at once."""
        trace = results["adinm"].trace[1:]
        sides = [row.side for row in trace]
        change = sides.index("cameras")
        assert 20 <= change <= 45 and set(sides[:change]) == {"points"}, sides
        first = min(row.gradient_norm for row in trace[change : change + 3])
        assert first < 0.6 * trace[change - 1].gradient_norm, (change, first, trace[change - 1].gradient_norm)

    def test_adinm_comes_to_the_end_from_most_start_values(self, shared_data: Path) -> None:
        """From which ones it does not hangs on rounding: docs/methods.md."""
        problem = bal.to_problem(bal.read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"))
        chosen, ends = methods.options("adinm"), []
        for damping, share in ((5.0, 1.5), (15.0, 0.5), (10.0, 1.5)):
            radius = share * chosen.initial_radius
            result = solve(problem, dataclasses.replace(chosen, initial_damping=damping, initial_radius=radius))
            ends.append(result.gradient_norm)
            assert result.objective_after == pytest.approx(13344.25, abs=0.1)
        assert sorted(ends)[1] < 1.0, ends

    def test_objectives_agree(self, results: dict[str, Result]) -> None:
        values = {name: results[name].objective_after for name in ("dinm", "adinm", "local_dinm", "lma_cd")}
        assert max(values.values()) <= 1.01 * min(values.values()), values


class TestAnnealing:
    """A truncated quadratic from a cold start."""

    @pytest.fixture
    def problem(self, make_problem: Make) -> Problem:
        problem, _ = make_problem(stereo=True, points=80, start_error=0.05)
        uv = problem.observations.uv.copy()
        uv[::4] += 80.0
        return dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, uv=uv))

    def test_it_leaves_the_plateau(self, problem: Problem) -> None:
        ends = {
            name: solve(problem, solver_options("irls_tq", [f"annealing={name}", "gamma=3"]))
            for name in ("none", "gnc")
        }
        for result in ends.values():
            check(result)
        assert ends["gnc"].objective_after < 0.7 * ends["none"].objective_after, ends

    @pytest.mark.parametrize("loss", ["truncated_quadratic", "geman_mcclure"])
    def test_it_ends_no_higher_than_from_the_optimum_of_hubers_loss(self, loss: str, problem: Problem) -> None:
        """Where it can win: from there a truncated quadratic by itself comes far down."""
        huber = solve(problem, solver_options("irls_huber", ["gamma=3"]))
        settings = [f"loss={loss}", "gamma=3"]
        second = dataclasses.replace(problem, start=huber.state)
        by_hand = solve(second, solver_options("auto", [*settings, "annealing=none"]))
        alone = solve(problem, solver_options("auto", [*settings, "annealing=none"]))
        led = solve(problem, solver_options("auto", settings))
        assert led.objective_after <= 1.01 * by_hand.objective_after, (led.objective_after, by_hand.objective_after)
        assert led.objective_after <= 1.01 * alone.objective_after

    @pytest.mark.parametrize("cap", [1, 2, 5])
    def test_stopped_halfway_it_returns_the_best_state(self, cap: int, problem: Problem) -> None:
        options = solver_options("irls_tq", [f"max_iterations={cap}", "gamma=3"])
        result = solve(problem, options)
        check(result)
        again = solve(dataclasses.replace(problem, start=result.state), dataclasses.replace(options, annealing="none"))
        assert again.objective_before == pytest.approx(result.objective_after, rel=1e-12)


class TestBadInput:
    """Nothing to solve, or nothing that can be: a status and a reason."""

    @pytest.mark.parametrize("name", list(methods.METHODS))
    def test_no_weight_anywhere(self, name: str, make_problem: Make) -> None:
        """All residuals lie on the plateau, or where a redescending loss no longer pulls."""
        problem, _ = make_problem()
        uv = problem.observations.uv + 1e6
        problem = dataclasses.replace(problem, observations=dataclasses.replace(problem.observations, uv=uv))
        options = dataclasses.replace(
            methods.options(name),
            loss="truncated_quadratic",
            loss_scale_px=1.0,
            cheirality="keep",
            annealing="none",
        )
        result = solve(problem, options)
        check(result)
        assert result.status == Status.CONVERGED and "gradient" in result.reason

    @pytest.mark.parametrize("name", list(methods.METHODS))
    def test_one_camera_one_point(self, name: str, make_problem: Make) -> None:
        problem, _ = make_problem(keyframes=2, points=1, fixed=1)
        obs = problem.observations
        one = {f.name: getattr(obs, f.name)[:1] for f in dataclasses.fields(obs)}
        check(solve(dataclasses.replace(problem, observations=dataclasses.replace(obs, **one)), methods.options(name)))

    @pytest.mark.parametrize("name", list(methods.METHODS))
    def test_no_points(self, name: str, make_problem: Make) -> None:
        problem, _ = make_problem()
        obs = problem.observations
        none = {f.name: getattr(obs, f.name)[:0] for f in dataclasses.fields(obs)}
        start = dataclasses.replace(problem.start, points=problem.start.points[:0])
        empty = dataclasses.replace(problem, start=start, observations=dataclasses.replace(obs, **none))
        assert solve(empty, methods.options(name)).status == Status.SKIPPED

    @pytest.mark.parametrize("side", CHOICES["schur"])
    def test_nothing_but_points_is_free(self, side: str, make_problem: Make) -> None:
        problem, _ = make_problem()
        fixed = dataclasses.replace(problem, fixed=np.ones(problem.n_keyframes, bool))
        result = solve(fixed, dataclasses.replace(SolverOptions(), schur=side, inner_iterations=0))
        check(result)
        assert result.objective_after < 0.5 * result.objective_before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (SolverOptions(damping="big"), "damping = 'big': choose one of none, identity, diag, inc"),
        (SolverOptions(schur="B"), "choose one of points, cameras"),
        (SolverOptions(loss="huber", loss_scale_px=0.0), "a robust loss needs the residual"),
        (
            SolverOptions(loss="cauchy", loss_scale_px=float("nan")),
            "set loss_scale_px to a number > 0",
        ),
        (SolverOptions(loss="huber", annealing="gnc"), "loss = truncated_quadratic"),
    ],
)
def test_contradictions_are_refused_with_the_reason(options: SolverOptions, words: str, make_problem: Make) -> None:
    with pytest.raises(ConfigError, match=words):
        solve(make_problem()[0], options)


def test_every_choice_of_every_method_is_declared() -> None:
    assert tuple(methods.METHODS) == CHOICES["method"]
    assert tuple(LOSSES) == CHOICES["loss"]
    for options in methods.METHODS.values():
        options.check()


def test_methods_are_the_table_of_the_thesis() -> None:
    expected = {
        "lma_cd": ("identity", "none", "cholesky", "points", "global", "squared"),
        "bal": ("diag", "none", "pcg", "points", "global", "squared"),
        "bal_scaled": ("diag", "none", "pcg", "points", "global", "squared"),
        "inm": ("none", "inc", "pcg", "points", "global", "squared"),
        "tnm": ("inc", "none", "pcg", "points", "global", "squared"),
        "dinm": ("identity", "inc", "pcg", "points", "global", "squared"),
        "adinm": ("identity", "inc", "pcg", "adaptive", "global", "squared"),
        "local_dinm": ("identity", "inc", "pcg", "points", "local", "squared"),
        "irls_huber": ("identity", "inc", "pcg", "points", "local", "huber"),
        "irls_tq": ("identity", "inc", "pcg", "points", "local", "truncated_quadratic"),
        "local_irls": ("diag", "diag", "auto", "points", "local", "squared"),
    }
    parts = ("damping", "trust_region", "linear_solver", "schur", "parameterisation", "loss")
    for name, row in expected.items():
        values = dataclasses.asdict(methods.options(name))
        assert tuple(values[part] for part in parts) == row, name
    assert dataclasses.asdict(methods.options("bal"))["preconditioner"] == "b_literal"
    assert dataclasses.asdict(methods.options("bal_scaled"))["preconditioner"] == "b_block"
    assert methods.options("auto") is methods.options("local_irls")


@pytest.mark.parametrize("method", list(methods.METHODS))
def test_every_method_brings_its_loss_to_a_window(method: str, make_problem: Make) -> None:
    """With the node's defaults; and it gets there, where the node's own tolerance of before ended some early."""
    config = Config().with_values({"solver.method": method}).solver
    options = methods.from_config(config)
    own = methods.options(method)
    assert options.loss == ("cauchy" if own.loss == "squared" else own.loss)
    assert options.annealing == ("gnc" if method == "irls_tq" else "none")
    assert options.function_tolerance == (1e-3 if own.method == "local_irls" else 1e-5)
    assert methods.from_config(dataclasses.replace(config, function_tolerance=1e-2)).function_tolerance == 1e-2
    problem, _ = make_problem(start_error=0.02)
    result = solve(problem, dataclasses.replace(options, max_iterations=50))
    best = solve(problem, dataclasses.replace(options, max_iterations=300, function_tolerance=0.0))
    assert result.objective_after <= 1.02 * best.objective_after + 1e-6, (result.reason, best.reason)


@pytest.mark.parametrize("loss", ["truncated_quadratic", "geman_mcclure"])
def test_a_window_is_led_up_to_a_plateau_by_any_method(loss: str) -> None:
    assert methods.from_config(Config().with_values({"solver.loss": loss}).solver).annealing == "gnc"


def test_a_method_that_is_named_after_a_loss_takes_no_other() -> None:
    for method, loss in (("irls_tq", "huber"), ("irls_huber", "cauchy"), ("irls_tq", "squared")):
        with pytest.raises(ConfigError, match=rf"solver.loss = '{loss}': method '{method}' is named after the loss"):
            Config().with_values({"solver.method": method, "solver.loss": loss})


class TestBal:
    def test_to_the_letter_pcg_is_that_of_algorithm_7(self, make_problem: Make) -> None:
        """By the textbook's PCG on dense matrices: D = diag(H), M = B as it stands."""
        problem, _ = make_problem(free_intrinsics=True, points=60)
        options = methods.options("bal")
        kernels = NumpyKernels(problem, options)
        kernels.linearise(problem.start)
        system = kernels.damp("diag", 1e-4)
        d = kernels.diagonals()[0].ravel()
        s, b = system.dense() / d[:, None] / d, scipy.linalg.block_diag(*system.own_blocks()[0])
        x, r = np.zeros_like(d), system.rhs / d
        end = min(0.1, float(np.linalg.norm(r))) * np.linalg.norm(r)
        z = p = np.linalg.solve(b, r)
        steps = 0
        while np.linalg.norm(r) > end:
            alpha = (r @ z) / (p @ s @ p)
            x, old = x + alpha * p, r @ z
            r = r - alpha * (s @ p)
            z = np.linalg.solve(b, r)
            p, steps = z + (r @ z) / old * p, steps + 1
        found = ReducedSolver(options).solve(system, kernels.diagonals, np.inf)
        assert found.x is not None and found.iterations == steps
        np.testing.assert_allclose(found.x * d, x, rtol=1e-6, atol=1e-8 * np.abs(x).max())


class TestRegion:
    """An exact solution is the limit of PCG inside the region, and is cut off at its boundary."""

    @pytest.mark.parametrize("backend", ["numpy", "native"])
    @pytest.mark.parametrize("linear_solver", ["dense", "sparse"])
    def test_an_exact_step_ends_at_the_boundary(self, linear_solver: str, backend: str, make_problem: Make) -> None:
        problem, _ = make_problem(keyframes=6, start_error=0.05)
        exact = solver_options("local_irls", [f"kernels={backend}", f"linear_solver={linear_solver}"])
        inexact = dataclasses.replace(exact, linear_solver="pcg", t_eps=1e-12, q_eps=0.0)
        kernels = native_kernels.make(problem, exact)
        kernels.linearise(problem.start)
        d = np.sqrt(kernels.diagonals()[0].ravel())

        def step(options: SolverOptions, radius: float) -> np.ndarray:
            found = ReducedSolver(options).solve(kernels.damp("diag", 1e-4), kernels.diagonals, radius)
            assert found.x is not None and found.on_boundary == (radius < 1e9)
            return found.x.copy()

        whole = step(exact, 1e10)
        np.testing.assert_allclose(step(inexact, 1e10), whole, rtol=1e-5, atol=1e-8)
        radius = 0.3 * float(np.linalg.norm(d * whole))
        cut = step(exact, radius)
        np.testing.assert_allclose(cut, 0.3 * whole, rtol=1e-9)
        # PCG goes to the boundary as well, on a curve.
        assert np.linalg.norm(d * step(inexact, radius)) == pytest.approx(radius, rel=1e-9)
