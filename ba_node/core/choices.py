# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a method and what each may be: declared once, for the solver's checks, ``--set`` and the documents."""

from __future__ import annotations

from dataclasses import dataclass

from ba_node.core.loss import LOSSES


class ChoiceError(ValueError):
    """A choice that does not exist, or that contradicts another."""


@dataclass(frozen=True)
class Choice:
    """One thing that a part may be.

    Attributes:
        name: how it is asked for.
        doc: what it is.
        source: equation, algorithm or table of the thesis; empty if it is not from there.
        aliases: other names for it.
    """

    name: str
    doc: str
    source: str = ""
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class Part:
    """One part of a method.

    Attributes:
        option: the field of SolverOptions or Rules.
        doc: what it decides.
        choices: what it may be.
        aliases: other names of the option.
    """

    option: str
    doc: str
    choices: tuple[Choice, ...]
    aliases: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the choices."""
        return tuple(choice.name for choice in self.choices)

    def resolve(self, value: str) -> str:
        """Return the name of a choice given by its name or an alias.

        Raises:
            ChoiceError: there is no such choice.
        """
        for choice in self.choices:
            if value == choice.name or value in choice.aliases:
                return choice.name
        raise ChoiceError(f"option {self.option} = {value!r}: choose one of {', '.join(self.names)}")


_INC = "D = 1/step, the steps of the search for the best forward differences"

_PARTS = (
    Part(
        "parameterisation",
        "How a pose is stepped.",
        (
            Choice("local", "R <- R Exp(dphi), t <- t + R dt", "4.1-4.19"),
            Choice("global", "phi <- phi + dphi, t <- t + dt, on the rotation vector", "3.26-3.28"),
        ),
    ),
    Part(
        "loss",
        "Cost Psi of a residual of norm x and its IRLS weight w, with the scale c = loss_scale.",
        tuple(Choice(loss.name, loss.doc, loss.source, loss.aliases) for loss in LOSSES.values()),
    ),
    Part(
        "annealing",
        "How a loss with a plateau is led up to.",
        (
            Choice("none", "the loss itself from the start"),
            Choice("gnc", "graduated non-convexity: surrogates of the truncated quadratic, one step for each"),
        ),
    ),
    Part(
        "cheirality",
        "What a point on or behind the plane of a camera costs.",
        (
            Choice("keep", "its plain residual, as the published results on BAL data count"),
            Choice("constant", "as much as a residual of 100, and it pulls at nothing"),
            Choice("drop", "nothing, if it is behind at the start"),
        ),
    ),
    Part(
        "damping",
        "D in H + mu D.",
        (
            Choice("none", "H as it is", "3.56, 3.57"),
            Choice("identity", "D = I", "3.55, 3.58", ("I",)),
            Choice("diag", "D = diag(H), each entry at least 1e-6 (Marquardt)", "3.55, 3.58"),
            Choice("inc", _INC, "3.38"),
        ),
    ),
    Part(
        "damping_policy",
        "How mu follows the gain ratio rho.",
        (
            Choice("nielsen", "rho > 0: mu max(1/3, 1 - (2 rho - 1)^3); else mu nu, nu = 2, 4, 8, ...", "Alg. 6"),
            Choice("fast", "as nielsen, but mu/5 where rho > 1/2, and mu/2 where rho > 1/4"),
        ),
    ),
    Part(
        "gain_model",
        "The reduction that the gain ratio rho expects of a step p.",
        (
            Choice("undamped", "-g'p - 1/2 p'H p, as Nielsen writes the policy"),
            Choice("damped", "-g'p - 1/2 p'(H + mu D)p, that of the equations which p solves", "3.102, 3.104, 3.105"),
        ),
    ),
    Part(
        "trust_region",
        "D of the region (no further than the radius in D p), and of the scaled space in which PCG works.",
        (
            Choice("none", "no region; PCG works in the space scaled by D of the damping", "Alg. 7"),
            Choice("identity", "D = I", "3.91", ("I",)),
            Choice("diag", "D = sqrt(diag(H)), so that D p has no unit", "3.94-3.99"),
            Choice("inc", _INC, "3.38, 3.94-3.99"),
        ),
        ("scaling",),
    ),
    Part(
        "schur",
        "Which unknowns are eliminated before the linear solver.",
        (
            Choice("points", "S = B - E C^-1 E'", "3.64-3.67", ("C",)),
            Choice("cameras", "S = C - E' B^-1 E", "3.70-3.73", ("B",)),
            Choice("none", "nothing: H as a whole", "3.61", ("H",)),
            Choice("adaptive", "points where cond(C) < cond(B), else cameras with radius 3m/9n", "Alg. 10"),
        ),
    ),
    Part(
        "linear_solver",
        "How S p = rhs is solved.",
        (
            Choice("auto", "pcg with a region, else what costs least by the structure of the problem"),
            Choice("cholesky", "exactly: dense or sparse, whichever costs less", "3.2.2", ("cd",)),
            Choice("dense", "exactly: S as a whole, LAPACK's Cholesky"),
            Choice("sparse", "exactly: S by blocks, sparse Cholesky"),
            Choice("pcg", "by conjugate gradients (Steihaug): an inexact Newton step", "Alg. 1, 3, 4"),
        ),
    ),
    Part(
        "preconditioner",
        "M of PCG, made in the scaled space.",
        (
            Choice("none", "M = I", "Table 3.9", ("I",)),
            Choice("schur_block", "diagonal blocks of S", "Table 3.9"),
            Choice("b_block", "blocks of B (of C where cameras are eliminated), damped", "Table 3.9", ("b",)),
            Choice("schur_diag", "diagonal of S", "Table 3.9"),
            Choice("b_diag", "diagonal of B (of C where cameras are eliminated), damped", "Table 3.9"),
        ),
    ),
    Part(
        "backend",
        "Which kernels work.",
        (
            Choice("auto", "native where it has everything that is asked for, else numpy"),
            Choice("native", "C++: local parameterisation, squared, Huber or Cauchy, points eliminated"),
            Choice("numpy", "numpy and scipy: everything"),
        ),
    ),
)
PARTS: dict[str, Part] = {part.option: part for part in _PARTS}
