# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write the page about the open problems from recorded figures."""

from __future__ import annotations

from experiments.thesis.catalogue import find
from experiments.thesis.findings import FINDINGS
from experiments.thesis.page import grounds, old_cases, verdict_table
from experiments.thesis.tables import table
from experiments.thesis.verdicts import Results, verdict_on

_INTRO = """\
# What the thesis leaves open

Chapter 6 of Z. Qu, *Efficient Optimization for Robust Bundle Adjustment* (TU Munich, 2018), asks for a preconditioner
that helps, for what reweighting does to the condition of the matrices, and for more data; its figures raise two more
questions, why IRLS is no better where there are outliers, and what it costs to give every image a calibration of its
own. `ba thesis open-preconditioner open-conditioning open-conditioning-sphere open-outliers open-data open-intrinsics`
makes what stands here. Verdicts are made as in [thesis.md](thesis.md), by comparisons that are declared
(`experiments/thesis/findings.py`); the comparisons stand at the end.

"""
_SECTIONS: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    (
        "A preconditioner that helps",
        """\
PCG works on `D^-1 S D^-1` (3.98). Made of that matrix, every preconditioner of Table 3.9 saves steps. Algorithm 4
makes M "with the strategy from Section 3.3.2" two lines after it has scaled the system, and that strategy speaks of S.
Made of S as it stands, M is wrong by D^2, and where D spans orders of magnitude (the step of f is a thousand times that
of a rotation) PCG needs more steps than without any. That gives the thesis's finding and its order: none, blocks of S,
B, diagonals; its solves end near the cap of 1000.
""",
        """\
![PCG steps of each solve with five preconditioners, made of the scaled matrix and as it stands](images/open_pcg.png)

It does not hang on the start values: the rows "mu 1e-4" begin as the experiments of chapter 3 do. `auto`, `adinm`,
`irls_tq` and `ba solve --set preconditioner=schur_block` use blocks of the scaled S.
""",
        ("open-preconditioner",),
    ),
    (
        "Reweighting and the condition of C, B and S",
        """\
The weights of Huber's loss are small but never zero, and every block of H loses about as much: conditions stay near
those of squared loss. The truncated quadratic takes all weight from observations beyond its scale. A point that keeps
fewer than two of them is held by damping alone in one direction or three: its block of C is singular, and with damping
its condition is `|C|/mu`. Nielsen's policy divides mu by three in every good step, so in 35 of them it falls
below what a float64 holds beside `|C|`: the inverse of the block is rounding, S = B - E C^-1 E' takes it over, and
Cholesky meets a pivot that is not positive. B sees hundreds of observations an image, and hardly notices.

S has another reason to break, with any loss: nothing but mu holds the seven directions of the gauge. On the sphere,
where nearly every step is good, mu soon is below rounding and S is not positive definite any more. That is how IRLS and
methods with squared loss end in NaN within 10 to 40 steps in textbook algebra (crosses). We do not know the thesis's
program; the solver here inverts C with a look at its pivots and takes a step that is not finite as rejected, so it goes
on, but on what such a matrix gives.
""",
        """\
![Condition of C, B and S along 50 steps on ten frames of Ladybug-49](images/open_conditioning.png)

![The same on a sphere of 10 images](images/open_conditioning_sphere.png)

The cure has three parts: first-order weights, which are never negative (all of these use them); points that fewer than
two observations hold leave the equations; D = diag(H) with a floor on its entries and on mu. With it no condition goes
beyond what float64 holds, and nothing breaks. It does not make a truncated quadratic start well: from the plateau of
the sphere all points leave at once, hence Huber's loss before the annealing of `irls_tq`. Where a cured curve falls to
a low, level line, steps are rejected and mu rises: the run has arrived.

`auto` damps with diag(H) and the floor on its entries; any method does with `--set damping=diag`. Blocks that are
singular all the same are inverted as pseudo-inverses.
""",
        ("open-conditioning", "open-conditioning-sphere"),
    ),
    (
        "IRLS where there are outliers",
        """\
The thesis does not say which scale its losses had, and stopped by the clock. With a scale at three sigmas of the noise
and every run led to its end, the loss decides and the method does not.
""",
        """\
![Errors to truth against the share of outliers](images/open_outliers.png)

Squared loss shares an outlier of 30 px out among all that it touches. The RMSE of points is ruled by a few that two
near images see, hence the median. The truncated quadratic has D = diag(H) here: with D = I and
mu = 10 the first surrogates are over before the points have moved.
""",
        ("open-outliers",),
    ),
    (
        "More data, and the large sphere to its end",
        """\
Every method on every data set that we have, numpy's kernels but for the rows that say C++.
""",
        "",
        ("open-data",),
    ),
    (
        "One calibration where one camera took all images",
        """\
Each image of a BAL problem has its own f, k1 and k2. If one camera took all, these are 3 n unknowns in place of 3, and
what they are free to do they take from the poses.
""",
        """\
![Errors to truth with f, k1 and k2 for each image, shared, and known](images/open_intrinsics.png)

The solver has intrinsics for each image (`ba solve`) or known ones (the node, which takes them from `camera_info`). It
has no shared free ones; the row "shared" ties the steps in an experiment of its own (`SharedIntrinsics` in
`experiments/thesis/variants.py`).
""",
        ("open-intrinsics",),
    ),
)


def open_page(results: Results) -> str:
    """Return docs/open_problems.md."""
    verdicts = [verdict_on(finding, results) for finding in FINDINGS]
    parts = [_INTRO, verdict_table(verdicts, old_cases(results), "finding").markdown()]
    for title, before, after, names in _SECTIONS:
        parts.append(f"\n## {title}\n\n{before}\n")
        for name in names:
            experiment = find(name)
            shown = table(experiment, results.get(name, {})).markdown()
            parts.append(f"{experiment.title[0].upper()}{experiment.title[1:]}:\n\n{shown}\n{experiment.note}\n\n")
        parts.append(after)
    parts.append(f"\n## What the verdicts rest on\n\n{grounds(verdicts)}")
    return "".join(parts)
