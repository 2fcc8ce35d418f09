# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the thesis measures beside the loop: derivatives, forms of the matrices, linear solvers, the data themselves.

Each takes a problem, settings and a clock, and returns ``figures`` for tables and ``data`` for pictures.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ba_node.config import SolverOptions
from ba_node.core import linear, native_kernels
from ba_node.core.numpy_kernels import NumpyKernels, preconditioner
from ba_node.core.objective import Objective
from ba_node.core.problem import State
from ba_node.core.schur import Structure, normal_equations
from ba_node.core.solver import solve
from ba_node.offline.solver_settings import solver_options
from experiments.thesis import sketches
from experiments.thesis.conditioning import conditions
from experiments.thesis.final_state import truth_errors
from experiments.thesis.matrix_forms import FORMS
from experiments.thesis.problems import Posed
from experiments.thesis.step_search import search_steps

FloatArray = NDArray[np.float64]
Clock = Callable[[], float]
Measured = dict[str, Any]

_GLOBAL = SolverOptions(parameterisation="global")
_SYSTEMS = 50
_REPEATS = 5


def taylor(posed: Posed, _settings: Sequence[str], _clock: Clock) -> Measured:
    """Return how the remainder |F(u + tau d) - F(u) - tau J d| falls with tau = 1/2, 1/4, ... (3.39-3.41)."""
    problem = posed.problem
    objective = Objective(problem, _GLOBAL)
    rng = np.random.default_rng(0)
    size = 9 if problem.free_intrinsics else 6
    # A step of the size that a solve makes; f is in px.
    scale = np.array([1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 1.0, 1e-2, 1e-2])[:size]
    d_c = rng.normal(size=(problem.n_keyframes, size)) * scale
    d_p = rng.normal(size=(problem.n_points, 3)) * 1e-2
    lin = objective.linearise(problem.start)
    obs = problem.observations
    moved = (lin.d_keyframe @ d_c[obs.keyframe][:, :, None])[..., 0] + (lin.d_point @ d_p[obs.point][:, :, None])[
        ..., 0
    ]
    tau = 2.0 ** -np.arange(1, 16)
    remainders = [
        float(np.linalg.norm(_at(objective, problem.start, t * d_c, t * d_p) - lin.residual - t * moved)) for t in tau
    ]
    slope = float(np.polyfit(np.log(tau[6:13]), np.log(remainders[6:13]), 1)[0])
    return {"figures": {"slope": slope}, "data": {"tau": tau.tolist(), "remainder": remainders}}


def _at(objective: Objective, state: State, step_c: FloatArray, step_p: FloatArray) -> FloatArray:
    return objective.linearise(objective.retract(state, step_c, step_p)).residual


def matrix_form(posed: Posed, settings: Sequence[str], clock: Clock) -> Measured:
    """Return time and memory from residuals and their derivatives to H and g in a form of Table 3.1.

    Implicit cells stay cells, as the solver uses them; who sees whom is sorted once for all iterations.
    """
    problem, name = posed.problem, settings[0]
    lin = Objective(problem, _GLOBAL).linearise(problem.start)
    structure = Structure(problem)

    def form() -> object:
        return normal_equations(structure, lin) if name == "implicit cells" else FORMS[name](problem, lin)

    tracemalloc.start()
    form()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    seconds = _fastest(form, clock, 1 if "dense" in name else _REPEATS)
    return {"figures": {"seconds": seconds, "megabytes": peak / 2**20}}


def linear_solver(posed: Posed, settings: Sequence[str], clock: Clock) -> Measured:
    """Return what CG, Cholesky or LU takes to solve S p = rhs at 50 dampings, and how far p is from Cholesky's.

    The difference is that of (3.83), |p - p_CD|^2 / s, over all s parameters.
    """
    kernels = NumpyKernels(posed.problem, _GLOBAL)
    kernels.linearise(posed.problem.start)
    d_c, d_p = (np.ones_like(d) for d in kernels.diagonals())
    seconds, differences, steps = 0.0, [], 0
    for mu in np.logspace(4.0, -2.0, _SYSTEMS):
        system = kernels.reduce(mu * d_c, mu * d_p)
        matrix, rhs = system.dense(), system.rhs
        exact = linear.cholesky(matrix.copy(), rhs).x
        began = clock()
        if settings[0] == "CG":
            none = preconditioner("none", system, np.ones_like(rhs))
            found = linear.pcg_steihaug(matrix.__matmul__, rhs, none, linear.PcgLimits(0.1, 100_000))
            x, steps = found.x, steps + found.iterations
        elif settings[0] == "Cholesky":
            x = linear.cholesky(matrix, rhs).x
        else:
            x = scipy.linalg.lu_solve(scipy.linalg.lu_factor(matrix, check_finite=False), rhs, check_finite=False)
        seconds += clock() - began
        if x is not None and exact is not None:
            parts = zip(system.back_substitute(x)[:2], system.back_substitute(exact)[:2], strict=True)
            differences.append(sum(float(np.sum((a - b) ** 2)) for a, b in parts) / (d_c.size + d_p.size))
    return {
        "figures": {
            "seconds": seconds / _SYSTEMS,
            "difference": float(np.mean(differences)),
            "pcg_per_solve": steps / _SYSTEMS,
        }
    }


def inc_steps(posed: Posed, _settings: Sequence[str], _clock: Clock) -> Measured:
    """Return the steps that the search behind (3.38) finds; none for a parameter in which the residual is linear."""
    return {"figures": {item.kind: item.step for item in search_steps(posed.problem, "global")}}


def start(posed: Posed, _settings: Sequence[str], _clock: Clock) -> Measured:
    """Return how far the start is from the truth, and its objective."""
    problem = posed.problem
    out = {"objective": Objective(problem, _GLOBAL).value(problem.start)}
    return {"figures": out | (truth_errors(problem.start, posed.truth) if posed.truth else {})}


def layout(posed: Posed, _settings: Sequence[str], _clock: Clock) -> Measured:
    """Return where cameras and points truly are, who sees whom, and how many images see a point."""
    state, obs = posed.truth or posed.problem.start, posed.problem.observations
    centres = -(np.swapaxes(state.rotation, 1, 2) @ state.translation[:, :, None])[..., 0]
    views = np.bincount(obs.point, minlength=posed.problem.n_points)
    pairs = np.unique(obs.keyframe * posed.problem.n_points + obs.point)
    share = len(pairs) / (posed.problem.n_keyframes * posed.problem.n_points)
    shown = pairs[:: max(1, len(pairs) // 20_000)]
    return {
        "figures": {"fill_of_e": float(share), "views_per_point": float(views.mean())},
        "data": {
            "cameras": np.round(centres, 3).tolist(),
            "points": np.round(state.points, 3).tolist(),
            "image": (shown // posed.problem.n_points).tolist(),
            "point": (shown % posed.problem.n_points).tolist(),
        },
    }


def linearisation(posed: Posed, settings: Sequence[str], clock: Clock) -> Measured:
    """Return what one linearisation takes with the kernels of a backend and a parameterisation, local if none, s."""
    backend, *parameterisation = settings
    options = SolverOptions(kernels=backend, parameterisation=parameterisation[0] if parameterisation else "local")
    kernels = native_kernels.make(posed.problem, options)
    kernels.linearise(posed.problem.start)
    seconds = _fastest(lambda: kernels.linearise(posed.problem.start), clock, _REPEATS)
    return {"figures": {"seconds": seconds, "observations": float(len(posed.problem.observations))}}


def _fastest(work: Callable[[], object], clock: Clock, repeats: int) -> float:
    times = []
    for _ in range(repeats):
        began = clock()
        work()
        times.append(clock() - began)
    return min(times)


def memory(posed: Posed, settings: Sequence[str], _clock: Clock) -> Measured:
    """Return the most memory that steps of a method had in use, MB; settings: method, steps, options."""
    method, steps, *assignments = settings
    options = solver_options(method, [*assignments, f"max_iterations={steps}", "backend=numpy"])
    tracemalloc.start()
    solve(posed.problem, options)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"figures": {"megabytes": peak / 2**20}}


MEASURES: dict[str, Callable[[Posed, Sequence[str], Clock], Measured]] = {
    "taylor": taylor,
    "matrix_form": matrix_form,
    "linear_solver": linear_solver,
    "inc_steps": inc_steps,
    "start": start,
    "layout": layout,
    "linearisation": linearisation,
    "conditions": conditions,
    "memory": memory,
    "blocks": sketches.blocks,
    "cap": sketches.cap,
}
