# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Each option is declared once, and everything that shows or reads options follows the declaration."""

from __future__ import annotations

import ast
import dataclasses
from collections import Counter
from pathlib import Path

import pytest

from ba_node.config import Config, ConfigError, SolverConfig, SolverOptions, declarations, declared, parse_assignment
from ba_node.config.front_end import FrontEndNodeOptions, FrontEndOptions
from ba_node.core import methods
from ba_node.offline.solver_settings import solver_options

PACKAGE = Path(__file__).resolve().parent.parent.parent / "ba_node"


def defaults() -> list[tuple[str, str, object]]:
    """Return file, name and default of every field of the package, the default being "option" where it is declared."""
    found: list[tuple[str, str, object]] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ClassDef):
                continue
            for item in node.body:
                if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name) and item.value is not None:
                    call = item.value.func if isinstance(item.value, ast.Call) else None
                    is_option = isinstance(call, ast.Name) and call.id == "option"
                    literal = item.value.value if isinstance(item.value, ast.Constant) else None
                    found.append((str(path.relative_to(PACKAGE)), item.target.id, "option" if is_option else literal))
    return found


def test_each_option_is_declared_exactly_once() -> None:
    declared_in = Counter(file for file, _, default in defaults() if default == "option")
    names = {
        "config/solver.py": len(declared(SolverOptions)),
        "config": len(declarations()) - len(declared(SolverConfig)),
        "config/front_end.py": len(declared(FrontEndOptions)) + len(declared(FrontEndNodeOptions)),
    }
    counted = {
        "config": declared_in.pop("config/estimation.py") + declared_in.pop("config/node.py"),
        **declared_in,
    }
    assert counted == names


@pytest.mark.slow
def test_nothing_else_repeats_a_default_of_the_solver() -> None:
    options = {option.name: option.default for option in declared(SolverOptions)}
    # A factor has a loss of its own; for PCG itself 0 is the sign that q_eps is not to be used.
    others = [(file, name) for file, name, default in defaults() if name in options and default == options[name]]
    factors = {(f"core/{name}.py", "loss") for name in ("factors", "marginal", "priors")}
    assert set(others) == {*factors, ("core/linear.py", "q_eps")}


def test_parameters_of_the_solver_are_options_of_the_core() -> None:
    """The same name, type, unit and range; the default and what ``auto`` adds may be the node's own."""
    options = {option.name: option for option in declared(SolverOptions)}
    for parameter in declared(SolverConfig, "solver"):
        option = options[parameter.name.removeprefix("solver.")]
        same = dataclasses.replace(
            parameter, name=option.name, default=option.default, doc=option.doc, allowed=option.allowed
        )
        if parameter.name == "solver.function_tolerance":
            # Below its range stands what the method has.
            assert parameter.default == parameter.minimum == -1.0
            same = dataclasses.replace(same, minimum=option.minimum)
        assert same == option
        assert parameter.allowed[: len(option.allowed)] == option.allowed


def test_parameters_reach_the_core() -> None:
    """Every parameter ``solver.*`` that is changed changes the options of the solve."""
    for parameter in declared(SolverConfig, "solver"):
        choices = [choice for choice in parameter.choices if choice not in ("auto", parameter.default)]
        value = choices[-1] if choices else parameter.kind(parameter.maximum or 0)
        config = Config().with_values({parameter.name: value})
        options = methods.from_config(config.solver)
        assert getattr(options, parameter.name.removeprefix("solver.")) == value
    assert methods.from_config(Config().solver).max_iterations == 12
    assert SolverOptions().max_iterations == 50


@pytest.mark.parametrize(
    ("text", "option", "value"),
    [
        ("gamma=3", "loss_scale_px", 3.0),
        ("loss_scale=3", "loss_scale_px", 3.0),
        ("solver.loss_scale_px=3", "loss_scale_px", 3.0),
        ("backend=numpy", "kernels", "numpy"),
        ("solver.backend=numpy", "kernels", "numpy"),
        ("polish_steps=1", "inner_iterations", 1),
        ("cap=7", "max_linear_iterations", 7),
        ("linear_solver=cd", "linear_solver", "cholesky"),
    ],
)
def test_other_names_are_understood(text: str, option: str, value: object) -> None:
    method = "lma_cd" if option == "linear_solver" else "auto"
    assert getattr(solver_options(method, [text]), option) == value


def test_a_parameter_is_still_known_by_its_name_of_before() -> None:
    assert parse_assignment("solver.backend=numpy") == ("solver.kernels", "numpy")
    assert Config().with_values({"solver.backend": "numpy"}).solver.kernels == "numpy"
    with pytest.raises(ConfigError, match=r"did you mean 'solver\.kernels'"):
        Config().with_values({"solver.kernel": "numpy"})
