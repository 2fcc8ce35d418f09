# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The claims of chapters 4 to 6 of the thesis, each with the comparisons by which it is checked."""

from __future__ import annotations

from experiments.thesis.margins import DEEPER, SAME, by_ratio, deeper, lower, same
from experiments.thesis.verdicts import Below, Claim, Within

_SPHERES = ("10-289", "50-1000")
# Squared loss leads both to one minimum: what differs is how soon, and what outliers make of it.
_ONE_MINIMUM = "Squared loss has one minimum there, and LMA-CD comes to it too."

CHAPTER_4: tuple[Claim, ...] = (
    Claim(
        "ADINM brings the gradient down deeper than DINM",
        "4.1, Figure 4.2",
        (*deeper("4.1", "ADINM:inc-I", "DINM:inc-I"), *deeper("4.1", "ADINM:inc-I-diag", "DINM:inc-I-diag")),
        "Without a preconditioner PCG comes to its cap on the side of the points, and the step is a poor one; with"
        " blocks of S for M it does not.",
        cause=(*deeper("4.1", "ADINM:inc-I, M of blocks", "ADINM:inc-I"),),
    ),
    Claim("ADINM and DINM come to the same objective", "4.1, Figure 4.1", same("4.1", "ADINM:inc-I", "DINM:inc-I")),
    Claim(
        "ADINM needs fewer PCG steps than DINM, but more time",
        "4.1, Table 4.1",
        (
            *by_ratio("4.1", "pcg_per_solve", "ADINM:inc-I", "DINM:inc-I"),
            *by_ratio("4.1", "pcg_per_solve", "ADINM:inc-I-diag", "DINM:inc-I-diag"),
            *by_ratio("4.1", "seconds", "DINM:inc-I", "ADINM:inc-I"),
            *by_ratio("4.1", "seconds", "DINM:inc-I-diag", "ADINM:inc-I-diag"),
        ),
        cause=(Below("4.1", "pcg_per_solve", "ADINM:inc-I, M of blocks", ("DINM:inc-I", "ADINM:inc-I"), 2.0),),
    ),
    Claim(
        "late on C has a condition of over 1e7, and B still one of about 1e4",
        "4.1",
        (
            Within("conditions", "condition_c", "DINM", low=1e7),
            Within("conditions", "condition_b_scaled", "DINM", 3e3, 1e5),
        ),
        "The condition of B is that in the scaled space; as B stands it compares px with radians.",
    ),
    Claim(
        "with a diagonal preconditioner 3000 PCG steps in place of 1000 bring the gradient down further in less time",
        "4.1",
        (
            *by_ratio("4.1", "seconds", "DINM:inc-I-diag", "DINM:inc-I-diag, 1000"),
            *deeper("4.1", "DINM:inc-I-diag", "DINM:inc-I-diag, 1000"),
        ),
        "M of the scaled matrix needs less than 1000 steps.",
        cause=(Within("4.1", "pcg_per_solve", "DINM:inc-I-diag, 1000", high=500.0),),
    ),
    Claim(
        "local parameterisation comes to the same objective and a smaller gradient",
        "4.2, Figures 4.3, 4.4",
        (*same("4.2", "local", "global"), *deeper("4.2", "local", "global", factor=1.0)),
    ),
    Claim(
        "local parameterisation takes less time",
        "4.2, Table 4.2",
        (
            *by_ratio("4.2", "seconds", "local", "global"),
            Below("linearisation", "seconds", "local", ("global",), 1.05),
        ),
        "Of an iteration's time the derivatives are a small part.",
        cause=(Below("linearisation", "seconds", "local", ("global",)),),
    ),
    Claim(
        "more reprojection errors are large than in a Gaussian distribution: there are outliers",
        "4.3.1, Figures 4.5, 4.6",
        (
            Within("outliers", "outside_two_px", "ADINM", 0.8, 3.2),
            Within("outliers", "gaussian_outside", "ADINM", high=0.8),
            Within("outliers", "kurtosis", "ADINM", low=6.0),
        ),
    ),
)
CHAPTER_5: tuple[Claim, ...] = (
    Claim(
        "DINM brings the sphere of 10 images and 253 points from 2.44e5 down to 25.2, what noise alone leaves, and the"
        " gradient to 6.5",
        "5.3.1, Figure 5.5",
        (
            Within("fig-5.5", "objective_before", "DINM", 1e5, 5e5),
            Within("fig-5.5", "noise_px", "DINM", 0.14, 0.2),
            Within("fig-5.5", "gradient", "DINM", high=65.0),
        ),
        "The noise of 0.17 px and the errors at the start were chosen so that these figures can come out; the objective"
        " at the end says only that the minimum is reached. Elsewhere: another draw, with noise of 0.5 px.",
        elsewhere=(
            Within("fig-5.5", "noise_px", "DINM, noise 0.5 px", 0.42, 0.58),
            Within("fig-5.5", "gradient", "DINM, noise 0.5 px", high=65.0),
        ),
    ),
    Claim(
        "DINM, ADINM and local DINM come to the smallest objective on Ladybug-49",
        "5.3.2, Figure 5.6",
        tuple(check for name in ("DINM", "ADINM", "local DINM") for check in lower("ladybug", name, "LMA-CD", "BAL")),
    ),
    Claim(
        "ADINM has the deepest gradient of all on Ladybug-49, below 1",
        "5.3.2, Figure 5.7",
        (
            *deeper("ladybug", "ADINM", "LMA-CD", "BAL", "DINM", "local DINM"),
            Within("ladybug", "gradient", "ADINM", high=1.0),
        ),
        cause=(*deeper("4.1", "ADINM:inc-I, M of blocks", "ADINM:inc-I"),),
    ),
    Claim(
        "LMA-CD and IRLS break down on spheres with NaN or Inf",
        "5.3.2",
        tuple(
            Within("breaks", "breaks", f"{name}, {method}", low=1.0)
            for name in _SPHERES
            for method in ("LMA-CD", "IRLS")
        ),
        "Asked of textbook algebra: whether C, inverted as it stands, and Cholesky come through. The solver itself"
        " takes pseudo-inverses of singular blocks, counts a step that is not finite as rejected, and goes on. LMA-CD's"
        " S stays within what float64 holds in these steps; that of IRLS does not.",
        cause=tuple(Within("breaks", "condition_s", f"{name}, LMA-CD", high=1e16) for name in _SPHERES),
    ),
    Claim(
        "IRLS breaks down on Ladybug-49 after some 20 steps",
        "5.3.2",
        (Within("conditions", "breaks", "IRLS", low=1.0),),
        "Asked of textbook algebra.",
    ),
    Claim(
        "on spheres C is better conditioned than B at first, and ADINM does as DINM in its first steps",
        "5.3.2",
        tuple(Within(name, "switch", "ADINM", low=3.0) for name in ("5.1", "5.2", "5.3", "5.4")),
        "The condition of the damped blocks of C follows 1/mu: on Ladybug-49 it is above that of B from the start if mu"
        " begins at 1e-4, which the number of solves of chapter 3 asks for.",
    ),
    Claim(
        "DINM falls deepest on the small sphere",
        "5.3.2, Figures 5.9, 5.10",
        (
            *(check for name in ("LMA-CD", "BAL", "local DINM") for check in lower("5.1", "DINM", name)),
            *deeper("5.1", "DINM", "LMA-CD", "BAL", "local DINM"),
        ),
        f"{_ONE_MINIMUM} Near it exact steps converge fastest.",
        cause=same("5.1", "DINM", "LMA-CD"),
    ),
    Claim(
        "ADINM falls deepest on the sphere of 50 images",
        "5.3.2, Figures 5.12, 5.13",
        (
            *(check for name in ("LMA-CD", "BAL", "DINM", "local DINM") for check in lower("5.2", "ADINM", name)),
            *deeper("5.2", "ADINM", "LMA-CD", "BAL", "DINM", "local DINM"),
        ),
        f"ADINM never changes sides there: it is DINM. {_ONE_MINIMUM}",
        cause=(Within("5.2", "side", "ADINM", high=0.0), *same("5.2", "ADINM", "LMA-CD")),
    ),
    Claim(
        "on all spheres DINM and local DINM fall deeper than both baselines in the same time",
        "5.3.2, 6",
        (
            *(
                Below(name, "objective_in_time", method, (other,), SAME)
                for name in ("5.1", "5.2")
                for method in ("DINM", "local DINM")
                for other in ("LMA-CD", "BAL")
            ),
            *(Below(name, "objective_in_time", "local DINM, C++", ("LMA-CD, C++",), SAME) for name in ("5.3", "5.4")),
            *(lower(name, method, "BAL")[0] for name in ("5.3", "5.4") for method in ("DINM", "local DINM")),
        ),
        "The time is that which local DINM takes for its steps; BAL on the two largest spheres step by step."
        f" {_ONE_MINIMUM}",
        cause=(*same("5.1", "local DINM", "LMA-CD"), *same("5.2", "local DINM", "LMA-CD")),
    ),
    Claim(
        "local DINM is the best on the larger spheres, in objective and gradient",
        "5.3.2, Figures 5.15 to 5.19",
        (
            *(
                Below(name, metric, "local DINM, C++", ("LMA-CD, C++",), factor)
                for name in ("5.3", "5.4")
                for metric, factor in (("objective_in_time", SAME), ("gradient_in_time", DEEPER))
            ),
            *(lower(name, "local DINM", other)[0] for name in ("5.3", "5.4") for other in ("DINM", "BAL")),
        ),
        "Against LMA-CD in the time of its own steps, C++ kernels and M of blocks of S; against DINM and BAL step by"
        f" step, in numpy. {_ONE_MINIMUM} BAL with M of the scaled matrix comes to it as fast.",
        cause=(
            *same("5.3", "local DINM, C++", "LMA-CD, C++", 1e-5),
            *same("5.4", "local DINM, C++", "BAL, scaled, C++"),
        ),
    ),
    Claim(
        "BAL is extremely bad on spheres",
        "Tables 5.1 to 5.4",
        (
            *by_ratio("5.1", "rmse_cameras", "LMA-CD", "BAL"),
            *by_ratio("5.2", "rmse_cameras", "LMA-CD", "BAL"),
            *by_ratio("5.3", "rmse_cameras", "LMA-CD, C++", "BAL"),
            *by_ratio("5.4", "rmse_cameras", "LMA-CD, C++", "BAL"),
        ),
        "On the small sphere 2 % of outliers draw the minimum of squared loss itself away from the truth.",
        cause=(Below("5.1", "rmse_cameras", "DINM, no outliers", ("LMA-CD",), 10.0),),
    ),
    Claim(
        "local DINM comes nearest to the truth on the small sphere, in points",
        "5.3.2, Table 5.1",
        by_ratio("5.1", "rmse_points", "local DINM", "LMA-CD", "BAL", "DINM", "ADINM", "IRLS"),
        f"The thesis's RMSE of cameras has LMA-CD nearer. {_ONE_MINIMUM}",
        cause=same("5.1", "local DINM", "LMA-CD"),
    ),
    Claim(
        "IRLS does worse than the others on the small sphere",
        "5.3.2, Table 5.1",
        (
            *by_ratio("5.1", "rmse_cameras", "DINM", "IRLS"),
            *by_ratio("5.1", "rmse_points", "DINM", "IRLS"),
        ),
        "With a loss scale that fits the noise it does far better where there are outliers. Elsewhere: the same sphere"
        " without outliers.",
        cause=(Below("5.1", "rmse_cameras", "IRLS", ("DINM",)),),
        elsewhere=(Below("5.1", "rmse_cameras", "DINM, no outliers", ("IRLS, no outliers",), 1.2),),
    ),
    Claim(
        "DINM comes nearest to the truth on the sphere of 50 images, in points",
        "5.3.2, Table 5.2",
        by_ratio("5.2", "rmse_points", "DINM", "LMA-CD", "BAL", "ADINM", "local DINM", "IRLS"),
        f"The thesis's RMSE of cameras has ADINM nearer. {_ONE_MINIMUM}",
        cause=same("5.2", "DINM", "LMA-CD"),
    ),
    Claim(
        "local DINM and IRLS come nearest to the truth on the sphere of 100 images, in cameras",
        "5.3.2, Table 5.3",
        (
            *by_ratio("5.3", "rmse_cameras", "local DINM, C++", "LMA-CD, C++", "BAL", "DINM", "ADINM"),
            *by_ratio("5.3", "rmse_cameras", "IRLS, C++", "LMA-CD, C++", "BAL", "DINM", "ADINM"),
        ),
        "Squared loss has one minimum, and LMA-CD comes to it too: what 2 % of outliers make of it is no nearer.",
        cause=same("5.3", "local DINM, C++", "LMA-CD, C++"),
    ),
    Claim(
        "IRLS comes nearest to the truth on the sphere of 500 images, in cameras",
        "5.3.2, 6, Table 5.4",
        by_ratio("5.4", "rmse_cameras", "IRLS, C++", "LMA-CD, C++", "BAL", "DINM", "ADINM", "local DINM, C++"),
    ),
    Claim(
        "LMA-CD takes the most memory",
        "5.3.2",
        tuple(
            Below("memory", "megabytes", f"DINM, {name}", (f"LMA-CD, {name}",), 1.05)
            for name in ("ladybug-49", "50-1000")
        ),
        "S of 441 or 450 unknowns takes 1.6 MB: what is kept of each observation takes more.",
    ),
    Claim(
        "PCG solves a large system faster than Cholesky",
        "6, Table 5.4",
        (Below("5.4", "seconds_per_solve", "local DINM, C++", ("LMA-CD, C++",), 1.5),),
    ),
)
