# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Experiments behind what the thesis says without a table, on start values, and on other data."""

from __future__ import annotations

from experiments.thesis.chapter3 import CAP, NUMPY, SOLVE_COLUMNS, STEPPED, ladybug
from experiments.thesis.data_sets import LADYBUG
from experiments.thesis.experiments import Case, Experiment
from experiments.thesis.problems import ANEW
from experiments.thesis.starts import LARGE, MILD, MU, RADIUS, SOLVES, START
from experiments.thesis.tasks import Measure, Run

_GRID = ("1e-6", "1e-4", "1e-2", "10")
_NAMES = {"DINM": "dinm", "TNM": "tnm", "LMA-CD": "lma_cd"}

BESIDE = (
    Experiment(
        "conditions",
        "conditions of what is inverted, and whether textbook algebra comes through",
        (
            Case(
                "Gauss-Newton, Cholesky",
                Measure(LADYBUG, "conditions", ("lma_cd", "20", "", "damping=none")),
                {"condition_s": 1e16},
                "20 steps",
            ),
            Case("LMA-CD, D = diag(H)", Measure(LADYBUG, "conditions", ("lma_cd", "50", "", "damping=diag", MU))),
            Case("LMA-CD", Measure(LADYBUG, "conditions", ("lma_cd", "50", "", MU))),
            Case(
                "DINM",
                Measure(LADYBUG, "conditions", ("dinm", "50", "", CAP, *MILD)),
                {"condition_c": 1e7, "condition_b_scaled": 1e4},
                "first mu 10",
            ),
            Case("IRLS", Measure(LADYBUG, "conditions", ("irls_huber", "50", "", CAP, *START))),
        ),
        (
            "condition_c",
            "condition_b",
            "condition_b_scaled",
            "condition_s",
            "first_break",
            "breaks",
            "solves",
            "gradient",
        ),
        note="The worst of the run. Scaled: by D of inc, in which PCG works. A break: C inverted as it stands, or"
        " Cholesky, does not come through; the solver itself goes on, as it inverts otherwise.",
    ),
    Experiment(
        "memory",
        "memory of three steps",
        tuple(
            Case(f"{label}, {name}", Measure(name, "memory", (method, "3", *settings)))
            for name in (LADYBUG, "50-1000")
            for label, method, settings in (
                ("LMA-CD", "lma_cd", ()),
                ("DINM", "dinm", (CAP,)),
                ("BAL", "bal", (CAP,)),
            )
        ),
        ("megabytes",),
        note="The most that numpy had in use above what the problem and its Jacobian take in all of them.",
    ),
    Experiment(
        "starts",
        "first damping and radius, chosen by the solves that 50 steps take",
        (
            *(
                Case(
                    f"{name}, mu {mu}",
                    ladybug(_NAMES[name], f"initial_damping={mu}", *extra),
                    {"solves": SOLVES[name]},
                )
                for mu in _GRID
                for name, extra in (("DINM", (CAP, RADIUS)), ("TNM", (CAP,)), ("LMA-CD", ()))
            ),
            *(
                Case(
                    f"INM, radius {radius}",
                    ladybug("inm", CAP, f"initial_radius={radius}"),
                    {"solves": SOLVES["INM"]},
                )
                for radius in ("0.001", "0.01", "1")
            ),
        ),
        ("solves", "steps", "pcg_per_solve", "objective", "gradient", "gradient_rise", "end"),
        note="The thesis's solves are its time in all over its time a solve. DINM has a first radius of 0.01.",
    ),
    Experiment(
        "held-out",
        "DINM, INM, TNM and LMA-CD on a sphere on which nothing was chosen",
        (
            Case("DINM", Run(ANEW, "dinm", (NUMPY, CAP, *LARGE), 30)),
            Case("INM:C-inc", Run(ANEW, "inm", (NUMPY, CAP, LARGE[1]), 30)),
            Case("TNM:C-inc", Run(ANEW, "tnm", (NUMPY, CAP, LARGE[0], "damping=inc"), 30)),
            Case("BAL", Run(ANEW, "bal", (NUMPY, CAP), 30)),
            Case("LMA-CD", Run(ANEW, "lma_cd", (NUMPY, MU), 30)),
        ),
        (*SOLVE_COLUMNS[:6], *STEPPED, "end"),
        note="50 images and 1000 points, drawn anew and without outliers, 30 steps.",
    ),
)
