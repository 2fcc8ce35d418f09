# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The claims of the thesis, each with the comparisons by which it is checked."""

from __future__ import annotations

from experiments.thesis.verdicts import Below, Breaks, Claim, Within

# Objectives that differ by less than this are the same.
_SAME = 0.999
# So much faster is faster: more than noise of a clock.
_FASTER = 1.2
_SIMILAR = 1.0 / 1.05

# Curves of the gradient differ by orders of magnitude; rounding alone moves an end by a factor of two and more.
_DEEPER, _STEADIER = 10.0, 1.5
# Objectives and errors to truth hang on rounding much less; what is lower must be so by more.
_LOWER, _NEARER, _FEWER = 1.001, 1.2, 1.2

_FOUR = ("5.1", "5.2", "5.3", "5.4")
_PAIRS = ("H-I", "C-inc", "B-diag")

_UNDAMPED = (
    "C-inc and C-diag are left after one step: where nothing damps C, a point far away jumps by -C^-1 gp however small"
    " the region is, which holds the cameras alone."
)


def _deeper(experiment: str, small: str, large: tuple[str, ...]) -> Below:
    """Return that the gradient of one case comes down further than those of others."""
    return Below(experiment, "gradient_smallest", small, large, _DEEPER)


def _lower(experiment: str, small: str, large: tuple[str, ...]) -> Below:
    """Return that the objective of one case ends below those of others."""
    return Below(experiment, "objective", small, large, _LOWER)


def _steadier(experiment: str, small: str, large: tuple[str, ...]) -> Below:
    """Return that the gradient of one case rises less on its way than those of others."""
    return Below(experiment, "gradient_rise", small, large, _STEADIER)


CLAIMS: tuple[Claim, ...] = (
    Claim(
        "the analytic derivatives are right", "3.1.4, Figure 3.1", (Within("fig-3.1", "slope", "remainder", 1.9, 2.1),)
    ),
    Claim(
        "the steps found for forward differences suit other data too",
        "3.1.4",
        (
            Below("eq-3.38", "translation", "sphere 10-253", ("Ladybug-49",)),
            Below("eq-3.38", "point", "sphere 10-253", ("Ladybug-49",)),
        ),
        "The best step grows with the scale of the scene: on a sphere of radius 500 it is a thousand times that of a"
        " street a few units wide.",
    ),
    Claim(
        "implicit cells need the least time of the four forms of the matrices",
        "3.1.6, Table 3.1",
        tuple(Below("3.1", "seconds", "IS-cell", (other,), _FASTER) for other in ("IS-sparse", "ES-sparse", "ES")),
        "The thesis forms the sparse ones by Matlab's assignments, which is what takes 194 s there.",
    ),
    Claim(
        "implicit cells need the least memory",
        "3.1.6, Table 3.1",
        (Below("3.1", "megabytes", "IS-cell", ("IS-sparse", "ES-sparse", "ES")),),
    ),
    Claim(
        "with Cholesky the Schur complement of C is fastest, that of B slowest",
        "3.2.2, Table 3.2",
        (
            Below("3.2", "seconds_per_solve", "SC of C", ("no SC",), 2.0),
            Below("3.2", "seconds_per_solve", "SC of C, 10 frames", ("no SC, 10 frames", "SC of B, 10 frames"), 2.0),
            Below("3.2", "seconds_per_solve", "no SC, 10 frames", ("SC of B, 10 frames",), 2.0),
        ),
    ),
    Claim(
        "with Cholesky the Schur complement of C brings the gradient down further than the others",
        "3.2.2, Figure 3.5",
        (_deeper("3.2", "SC of C, 10 frames", ("no SC, 10 frames", "SC of B, 10 frames")),),
        "All three solve the same equations, and their steps agree to rounding: only the time differs.",
    ),
    Claim(
        "LMA-CD reduces objective and gradient further than BAL",
        "3.2.3, Figures 3.6, 3.7",
        (
            _lower("baselines", "LMA-CD", ("BAL",)),
            _deeper("baselines", "LMA-CD", ("BAL",)),
        ),
    ),
    Claim(
        "CG solves the reduced system faster than Cholesky and LU",
        "3.3.1, Table 3.3",
        (Below("3.3", "seconds", "CG", ("Cholesky", "LU"), _FASTER),),
        "90 unknowns are too few for it: its products take longer than the factorisation.",
    ),
    Claim(
        "CG's solution is not that of the decompositions, which agree",
        "3.3.1, Table 3.4",
        (Within("3.4", "difference", "CG", low=1e-6), Within("3.4", "difference", "LU", high=1e-12)),
    ),
    Claim(
        "INM: C-inc comes to the smallest objective",
        "3.3.3, Figure 3.8",
        (
            Below(
                "3.5",
                "objective",
                "C-inc",
                ("H-I", "H-inc", "H-diag", "C-I", "C-diag", "B-I", "B-inc", "B-diag"),
                _SAME,
            ),
        ),
        _UNDAMPED,
    ),
    Claim(
        "INM: all but C-diag and H-diag come to similar objectives",
        "3.3.3, Figure 3.8",
        (
            *(
                Below("3.5", "objective", other, ("B-diag",), _SIMILAR)
                for other in ("H-I", "H-inc", "C-I", "C-inc", "B-I", "B-inc")
            ),
            *(Below("3.5", "objective", "B-diag", (other,), 1.05) for other in ("H-diag", "C-diag")),
        ),
        _UNDAMPED,
    ),
    Claim(
        "INM: B-diag has the best curve of the gradient",
        "3.3.3, Figure 3.9",
        (_deeper("3.5", "B-diag", ("H-I", "H-inc", "H-diag", "C-I", "C-inc", "C-diag", "B-I", "B-inc")),),
    ),
    Claim(
        "INM: C-inc takes less time than H-I and B-diag",
        "3.3.3, Table 3.5",
        (
            Within("3.5", "steps", "C-inc", low=25.0),
            Below("3.5", "seconds_per_solve", "C-inc", ("H-I",), _FASTER),
            Below("3.5", "seconds_per_solve", "C-inc", ("B-diag",), _FASTER),
        ),
    ),
    Claim(
        "INM without damping cannot go on after some steps where C is badly conditioned, as in C-diag",
        "3.3.4",
        (Within("3.5", "steps", "C-diag", high=49.0),),
    ),
    Claim(
        "TNM: C-diag comes to the smallest objective",
        "3.3.4, Figure 3.10",
        (
            Below(
                "3.6",
                "objective",
                "C-diag",
                ("H-I", "H-inc", "H-diag", "C-I", "C-inc", "B-I", "B-inc", "B-diag"),
                _SAME,
            ),
        ),
    ),
    Claim(
        "TNM: H-I has the gradient that fluctuates least",
        "3.3.4, Figure 3.11",
        (_steadier("3.6", "H-I", ("H-inc", "H-diag", "C-I", "C-inc", "C-diag", "B-I", "B-inc", "B-diag")),),
    ),
    Claim(
        "TNM: the Schur complement of C takes less time a solve",
        "3.3.4, Table 3.6",
        tuple(Below("3.6", "seconds_per_solve", "C-inc", (other,), _FASTER) for other in ("H-I", "B-inc")),
    ),
    Claim(
        "INM's gradient falls more steadily than TNM's",
        "3.3.4, Figure 3.13",
        tuple(_steadier("inm-tnm", f"INM:{pair}", (f"TNM:{pair}",)) for pair in _PAIRS),
        _UNDAMPED,
    ),
    Claim(
        "INM's gradient falls deeper than TNM's",
        "3.3.4, Figure 3.13",
        tuple(_deeper("inm-tnm", f"INM:{pair}", (f"TNM:{pair}",)) for pair in _PAIRS),
        _UNDAMPED,
    ),
    Claim(
        "TNM's objective falls faster and deeper than INM's",
        "3.3.4, Figure 3.12",
        tuple(Below("inm-tnm", "objective", f"TNM:{pair}", (f"INM:{pair}",), 1.05) for pair in _PAIRS),
    ),
    Claim(
        "DINM: inc-I has the lowest objective and takes the least time",
        "3.3.5, Figure 3.14, Table 3.7",
        (
            Below("3.7", "objective", "inc-I", ("inc-diag", "diag-I", "diag-inc"), _SAME),
            Below("3.7", "seconds", "inc-I", ("inc-diag", "diag-I", "diag-inc"), 1.0 / _FASTER),
        ),
    ),
    Claim(
        "DINM: inc-I and inc-diag bring the gradient down further than diag-I and diag-inc",
        "3.3.5, Figure 3.15",
        tuple(_deeper("3.7", inc, ("diag-I", "diag-inc")) for inc in ("inc-I", "inc-diag")),
    ),
    Claim(
        "DINM is better than INM and TNM in objective and gradient",
        "3.3.5, Figures 3.16, 3.17",
        (
            Below("3.8", "objective", "DINM:inc-I", ("INM:B-diag", "TNM:C-inc"), _SAME),
            _deeper("3.8", "DINM:inc-I", ("INM:B-diag", "TNM:C-inc")),
        ),
    ),
    Claim(
        "DINM: inc-I has the lowest objective of all after 50 steps",
        "3.3.5, Figure 3.16",
        (
            Below(
                "3.8", "objective", "DINM:inc-I", ("DINM:inc-diag", "INM:B-diag", "TNM:C-inc", "BAL", "LMA-CD"), _SAME
            ),
        ),
    ),
    Claim(
        "after 50 steps of DINM the gradient is below 10, its largest entry about 0.5",
        "3.3.5",
        (
            Within("3.8", "gradient_smallest", "DINM:inc-I", high=10.0),
            Within("3.8", "gradient_largest_entry", "DINM:inc-I", high=1.0),
        ),
    ),
    Claim(
        "LMA-CD's gradient stays near 100",
        "3.3.5, Figure 3.17",
        (Within("3.8", "gradient_smallest", "LMA-CD", low=10.0),),
    ),
    Claim(
        "DINM takes about 1.5 times less time than INM and TNM",
        "3.3.5, Table 3.8",
        tuple(Below("3.8", "seconds", "DINM:inc-I", (other,), _FASTER) for other in ("INM:B-diag", "TNM:C-inc")),
    ),
    Claim(
        "LMA-CD and BAL take less time than DINM",
        "3.3.5, Table 3.8",
        tuple(Below("3.8", "seconds", other, ("DINM:inc-I",), _FASTER) for other in ("LMA-CD", "BAL")),
    ),
    Claim(
        "no preconditioner is needed: without one PCG takes the fewest steps",
        "3.3.5, Table 3.9",
        tuple(
            Below("3.9", "pcg_per_solve", "I", (other,), _FEWER)
            for other in ("diag block of S", "B", "diag of S", "diag of B")
        ),
        "Here M is made of the scaled matrix D^-1 S D^-1, on which PCG works.",
    ),
    Claim(
        "without a preconditioner the gradient falls deeper",
        "3.3.5, Figure 3.19",
        (_deeper("3.9", "I", ("diag block of S", "B", "diag of S", "diag of B")),),
    ),
    Claim(
        "a larger cap on the PCG steps is cheaper overall",
        "3.3.5, Table 3.10",
        tuple(Below("3.10", "pcg_total", "2000", (other,), _FEWER) for other in ("100", "300", "500")),
        "A cap of 500 hardly ever binds here: PCG takes some 200 steps at the mean.",
    ),
    Claim(
        "a larger cap brings the gradient down further; it should be above 700",
        "3.3.5, Figure 3.21",
        (
            _deeper("3.10", "1000", ("100", "300", "500")),
            _deeper("3.10", "700", ("100", "300")),
        ),
    ),
    Claim(
        "t_eps should be 0.05 to 0.1: smaller costs more, larger makes the gradient fall less",
        "3.3.5, Table 3.11, Figure 3.23",
        (
            Below("3.11", "pcg_total", "0.1", ("0.01",), 1.5),
            Below("3.11", "pcg_total", "0.05", ("0.01",), 1.2),
            _deeper("3.11", "0.1", ("0.5", "0.2")),
            _deeper("3.11", "0.05", ("0.5", "0.2")),
        ),
    ),
    Claim(
        "ADINM brings the gradient down deeper than DINM",
        "4.1, Figure 4.2",
        (
            _deeper("4.1", "ADINM:inc-I", ("DINM:inc-I",)),
            _deeper("4.1", "ADINM:inc-I-diag", ("DINM:inc-I-diag",)),
        ),
    ),
    Claim(
        "ADINM and DINM come to the same objective",
        "4.1, Figure 4.1",
        (
            Below("4.1", "objective", "ADINM:inc-I", ("DINM:inc-I",), 0.99),
            Below("4.1", "objective", "DINM:inc-I", ("ADINM:inc-I",), 0.99),
        ),
    ),
    Claim(
        "ADINM needs fewer PCG steps than DINM, but more time",
        "4.1, Table 4.1",
        (
            Below("4.1", "pcg_per_solve", "ADINM:inc-I", ("DINM:inc-I",), _FEWER),
            Below("4.1", "pcg_per_solve", "ADINM:inc-I-diag", ("DINM:inc-I-diag",), _FEWER),
            Below("4.1", "seconds", "DINM:inc-I", ("ADINM:inc-I",), 1.4),
            Below("4.1", "seconds", "DINM:inc-I-diag", ("ADINM:inc-I-diag",), 1.4),
        ),
    ),
    Claim(
        "local parameterisation comes to the same objective and no larger a gradient",
        "4.2, Figures 4.3, 4.4",
        (
            Below("4.2", "objective", "local", ("global",), 0.99),
            Below("4.2", "objective", "global", ("local",), 0.99),
            Below("4.2", "gradient_smallest", "local", ("global",), 1.0 / _DEEPER),
        ),
    ),
    Claim(
        "local parameterisation takes less time",
        "4.2, Table 4.2",
        (
            Below("4.2", "seconds", "local", ("global",), _FASTER),
            Below("linearisation", "seconds", "local", ("global",), 1.05),
        ),
        "Of an iteration's time the derivatives are a small part; the thesis's own ratio is 1.14.",
    ),
    Claim(
        "more reprojection errors are large than in a Gaussian distribution: there are outliers",
        "4.3.1, Figures 4.5, 4.6",
        (Within("outliers", "outside_two_px", "ADINM", 1.0, 3.0), Within("outliers", "kurtosis", "ADINM", low=6.0)),
    ),
    Claim(
        "DINM brings the sphere of 10 images and 253 points from about 1e5 down to 25.2",
        "5.3.1, Figure 5.5",
        (Within("fig-5.5", "objective_before", "DINM", low=5e4), Within("fig-5.5", "objective", "DINM", high=30.0)),
    ),
    Claim(
        "DINM, ADINM and local DINM come to the smallest objective on Ladybug-49",
        "5.3.2, Figure 5.6",
        tuple(
            Below("ladybug", "objective", name, ("LMA-CD", "BAL"), _SAME) for name in ("DINM", "ADINM", "local DINM")
        ),
    ),
    Claim(
        "ADINM has the deepest gradient of all on Ladybug-49",
        "5.3.2, Figure 5.7",
        (_deeper("ladybug", "ADINM", ("LMA-CD", "BAL", "DINM", "local DINM")),),
    ),
    Claim(
        "LMA-CD and IRLS break down on spheres with NaN or Inf",
        "5.3.2",
        (Breaks(_FOUR, "LMA-CD"), Breaks(_FOUR, "IRLS")),
        "Singular blocks are inverted as pseudo-inverses, and a step that is not finite counts as rejected.",
    ),
    Claim(
        "on spheres C is better conditioned than B at first, and ADINM does as DINM",
        "5.3.2",
        tuple(Within(name, "side", "ADINM", high=0.0) for name in _FOUR),
    ),
    Claim(
        "DINM and ADINM fall deepest on the small sphere",
        "5.3.2, Figures 5.9, 5.10",
        (
            Below("5.1", "objective", "DINM", ("LMA-CD", "BAL", "local DINM", "ADINM"), _SAME),
            _deeper("5.1", "DINM", ("LMA-CD", "BAL", "local DINM")),
        ),
    ),
    Claim(
        "on all spheres DINM and local DINM fall deeper than both baselines",
        "5.3.2, 6",
        tuple(_lower(name, method, ("LMA-CD", "BAL")) for name in _FOUR for method in ("DINM", "local DINM")),
        "With Cholesky each step is exact, and nothing broke it off.",
    ),
    Claim(
        "local DINM is the best on the larger spheres",
        "5.3.2, Figures 5.15 to 5.19",
        tuple(_lower(name, "local DINM", ("LMA-CD", "BAL", "DINM", "ADINM")) for name in ("5.3", "5.4")),
    ),
    Claim(
        "IRLS does worse than the others on the small sphere",
        "5.3.2, Table 5.1",
        (
            Below("5.1", "rmse_cameras", "DINM", ("IRLS",), _NEARER),
            Below("5.1", "median_points", "DINM", ("IRLS",), _NEARER),
        ),
        "With a loss scale that fits the noise it does far better.",
    ),
    Claim(
        "IRLS comes nearest to the truth at scale",
        "5.3.2, 6, Tables 5.3, 5.4",
        tuple(
            Below("5.3", metric, huber, ("local DINM, C++", "LMA-CD", "BAL", "DINM", "ADINM"), _NEARER)
            for huber in ("IRLS, C++", "auto, Huber, C++")
            for metric in ("rmse_cameras", "median_points")
        ),
        "Huber's loss does where it is led to its end, as by `auto` in 30 steps; PCG without a preconditioner is on its"
        " way there. The RMSE of points is that of one or two which lie anywhere.",
    ),
    Claim(
        "PCG solves a large system faster than Cholesky",
        "6, Table 5.4",
        (Below("5.4", "seconds_per_solve", "DINM", ("LMA-CD",), 1.5),),
    ),
)
