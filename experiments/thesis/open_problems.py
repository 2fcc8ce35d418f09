# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Experiments on what the thesis leaves open (its chapter 6): preconditioners, reweighting, data, calibration."""

from __future__ import annotations

import dataclasses

from experiments.thesis.chapter3 import CAP, CURVES, NUMPY, SOLVE_COLUMNS, ladybug
from experiments.thesis.data_sets import KITTI, LADYBUG
from experiments.thesis.experiments import Case, Experiment
from experiments.thesis.problems import (
    LADYBUG_ONE,
    LADYBUG_PART,
    ONE_CAMERA,
    ONE_CAMERA_KNOWN,
    OPEN_SMALL,
    SHARES,
    outliers,
)
from experiments.thesis.starts import START
from experiments.thesis.tasks import Measure, Run

_NATIVE = "backend=native"
# To the end: what a step gains is lost in rounding.
MU = "initial_damping=10"
_TO_THE_END = "function_tolerance=1e-10"
_BLOCKS = "preconditioner=schur_block"
_HUBER, _TRUNCATED = "gamma=0.5", "gamma=0.7"
_CURE = ("cured", "damping=diag", "initial_damping=1e-3")

_PRECONDITIONERS = (
    ("diag block of S", "schur_block", 835.0),
    ("B", "b_block", 920.0),
    ("diag of S", "schur_diag", 913.0),
    ("diag of B", "b_diag", 920.0),
)


def _dinm(*settings: str) -> Run:
    """Return DINM with its own start values."""
    return ladybug("dinm", CAP, *settings)


def _unscaled(name: str) -> Run:
    """Return DINM with M made of the matrix that is not scaled."""
    return Run(LADYBUG, "dinm", (NUMPY, CAP, f"preconditioner={name}"), 50, (), "unscaled M")


def _from_small(name: str) -> Run:
    """Return the same from the first damping and radius of the experiments of chapter 3."""
    return Run(LADYBUG, "dinm", (NUMPY, CAP, *START, f"preconditioner={name}"), 50)


def _unscaled_from_small(name: str) -> Run:
    """Return DINM with M made of the matrix that is not scaled, from these."""
    return Run(LADYBUG, "dinm", (NUMPY, CAP, *START, f"preconditioner={name}"), 50, (), "unscaled M")


def _conditions(problem: str, gammas: tuple[str, str], steps: int = 50) -> tuple[Case, ...]:
    """Return cases that watch the matrices of one problem; gammas of Huber's loss and of the truncated quadratic."""
    huber, truncated = gammas
    rows: tuple[tuple[str, str, tuple[str, ...]], ...] = (
        ("squared, Cholesky", "lma_cd", ()),
        ("squared, PCG", "local_dinm", (MU,)),
        ("Huber", "irls_huber", (huber,)),
        ("TQ", "irls_tq", (truncated, "annealing=none")),
        ("TQ, annealed", "irls_tq", (truncated,)),
    )
    plain = [Case(label, Measure(problem, "conditions", (m, str(steps), "", *s))) for label, m, s in rows]
    cured = [
        Case(f"{label}, cured", Measure(problem, "conditions", (m, str(steps), *_CURE, *s))) for label, m, s in rows
    ]
    return (*plain, *cured)


_CONDITION_COLUMNS = (
    "condition_c",
    "condition_b",
    "condition_s",
    "lone_points",
    "first_break",
    "breaks",
    "solves",
    "objective",
    "gradient",
)
_CONDITION_NOTE = (
    " Conditions are the worst of 50 steps, damping included; 1e20 stands for all that rounding has lost. A break:"
    " textbook algebra (C inverted as it stands, Cholesky) does not come through; the solver goes on, as it inverts"
    " otherwise. Cure: points that fewer than two observations hold leave the equations, D = diag(H) with entries of"
    " 1e-6 at least, and mu stays at or above 1e-8."
)
_CONDITIONS = tuple(
    Experiment(
        f"open-conditioning{name}",
        f"condition of C, B and S along the iterations, {where}",
        _conditions(problem, gammas),
        _CONDITION_COLUMNS,
        plots=("conditions",),
        note=about + _CONDITION_NOTE,
    )
    for name, where, problem, gammas, about in (
        ("", "ten frames of Ladybug-49", LADYBUG_PART, ("gamma=1", "gamma=3"), "Real data."),
        ("-sphere", "a sphere of 10 images", OPEN_SMALL, ("gamma=0.5", "gamma=1"), "2 % outliers."),
    )
)

_OUTLIER_METHODS = (
    ("LMA-CD", "lma_cd", ("parameterisation=local", _NATIVE)),
    ("local DINM", "local_dinm", (_BLOCKS, MU, _NATIVE)),
    ("IRLS, Huber", "irls_huber", (_BLOCKS, _HUBER, _NATIVE)),
    ("IRLS, TQ", "irls_tq", (_BLOCKS, _TRUNCATED, "damping=diag", "initial_damping=1e-3", NUMPY)),
    ("auto, Huber", "auto", ("loss=huber", _HUBER, "q_eps=0", _NATIVE)),
)
_ERRORS = ("rmse_cameras", "rmse_points", "median_points")

_DATA = (
    ("dubrovnik-1-1", "dubrovnik-1-1"),
    ("dubrovnik-3-7", "dubrovnik-3-7"),
    ("dubrovnik-3-7-18", "dubrovnik-3-7-18"),
    ("KITTI", KITTI),
    ("Ladybug-49", LADYBUG),
)
# Every named method, with its own start values.
_DATA_METHODS = (
    ("LMA-CD", "lma_cd", (NUMPY,)),
    ("BAL", "bal", (NUMPY, CAP)),
    ("BAL, scaled", "bal_scaled", (NUMPY, CAP)),
    ("INM", "inm", (NUMPY, CAP)),
    ("TNM", "tnm", (NUMPY, CAP)),
    ("DINM", "dinm", (NUMPY, CAP)),
    ("ADINM", "adinm", (NUMPY, CAP)),
    ("local DINM", "local_dinm", (NUMPY, CAP, MU)),
    ("IRLS", "irls_huber", (NUMPY, CAP)),
    ("IRLS, TQ", "irls_tq", (NUMPY, CAP)),
    ("auto, C++", "auto", (_NATIVE, _TO_THE_END)),
)
_LARGE = (
    ("local DINM, M of blocks", "local_dinm", (_BLOCKS, MU)),
    ("IRLS, Huber, M of blocks", "irls_huber", (_BLOCKS, _HUBER)),
    ("auto, Huber", "auto", ("loss=huber", _HUBER, "q_eps=0", "function_tolerance=1e-8")),
)

_OPEN = (
    Experiment(
        "open-preconditioner",
        "preconditioners made of the scaled matrix and of the matrix as it stands",
        (
            Case("I", _dinm("preconditioner=none"), {"pcg_per_solve": 256.0}),
            Case("I, mu 1e-4", _from_small("none")),
            *(
                Case(f"{label}{how}", task, {"pcg_per_solve": steps} if how == ", as it stands" else {})
                for how, make in (
                    ("", lambda name: _dinm(f"preconditioner={name}")),
                    (", as it stands", _unscaled),
                    (", mu 1e-4", _from_small),
                    (", as it stands, mu 1e-4", _unscaled_from_small),
                )
                for label, name, steps in _PRECONDITIONERS
                for task in (make(name),)
            ),
        ),
        (*SOLVE_COLUMNS[:3], "pcg_total", *SOLVE_COLUMNS[3:]),
        (),
        ("pcg", *CURVES),
        "DINM on Ladybug-49, 50 steps, at most 1000 PCG steps a solve. As it stands: M is made of S or B in its own"
        " units, as line 4 of Algorithm 4 has it, while PCG works on D^-1 S D^-1.",
    ),
    *_CONDITIONS,
    Experiment(
        "open-outliers",
        "error to truth against the share of outliers, all methods at their end",
        tuple(
            Case(f"{share} %, {label}", Run(outliers(share), method, (*settings, _TO_THE_END), 100))
            for share in SHARES
            for label, method, settings in _OUTLIER_METHODS
        ),
        (*_ERRORS, "objective", "gradient", "steps", "end"),
        (),
        ("shares",),
        "Sphere of 50 images, 1000 points and 28 991 observations with noise of 0.17 px. The scales fit the noise:"
        " Huber's leaves the square at three sigmas, the truncated quadratic at four; the latter is annealed, with"
        " D = diag(H). LMA-CD and local DINM are squared"
        " loss, and end in the same minimum.",
    ),
    Experiment(
        "open-data",
        "real data beyond Ladybug, and the large spheres to their end",
        (
            *(
                Case(f"{name}, {label}", Run(problem, method, settings, 50), {}, "", f"{name}, auto, C++")
                for name, problem in _DATA
                for label, method, settings in _DATA_METHODS
            ),
            *(
                Case(
                    f"{name}, {label}, C++",
                    Run(name, method, (_NATIVE, _TO_THE_END, *s), 60),
                    versus=f"{name}, auto, Huber, C++",
                )
                for name, chosen in (("100-4000", _LARGE), ("500-5000", _LARGE[-1:]))
                for label, method, s in chosen
            ),
        ),
        (
            "objective_before",
            "objective",
            "gradient",
            "steps",
            "solves",
            "seconds",
            "rmse_cameras",
            "median_points",
            "end",
        ),
        note="The samples of GTSAM have fewer equations than unknowns (dubrovnik-3-7: 38 and 48), KITTI is stereo with"
        " known calibration. Times compare with `auto` on the same data.",
    ),
    Experiment(
        "open-intrinsics",
        "f, k1 and k2 free for each image, shared, and known",
        (
            Case("sphere, for each image", Run(ONE_CAMERA, "lma_cd", (NUMPY, "linear_solver=dense", _TO_THE_END), 60)),
            Case(
                "sphere, shared",
                Run(ONE_CAMERA, "lma_cd", (NUMPY, "linear_solver=dense", _TO_THE_END), 60, (), "shared intrinsics"),
            ),
            Case("sphere, known", Run(ONE_CAMERA_KNOWN, "lma_cd", (NUMPY, "linear_solver=dense", _TO_THE_END), 60)),
            Case("Ladybug-49, for each image", ladybug("lma_cd", "damping=diag", "initial_damping=1e-4", _TO_THE_END)),
            Case(
                "Ladybug-49, shared",
                Run(
                    LADYBUG_ONE,
                    "lma_cd",
                    (NUMPY, "linear_solver=dense", "damping=diag", "initial_damping=1e-4", _TO_THE_END),
                    50,
                    (),
                    "shared intrinsics",
                ),
            ),
        ),
        (*_ERRORS, "objective", "steps", "seconds", "end"),
        (),
        ("bars",),
        "A sphere of 50 images that one camera took, without outliers; errors in units in which the radius is 500."
        " Shared is an experiment of this command alone: the solver has intrinsics for each image, or known ones.",
    ),
)
# One start each: what they say is a matter of factors, not of digits.
OPEN = tuple(
    dataclasses.replace(experiment, cases=tuple(dataclasses.replace(case, seeds=1) for case in experiment.cases))
    for experiment in _OPEN
)
