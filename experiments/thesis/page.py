# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write the page about the thesis's claims from recorded figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

from experiments.thesis.catalogue import EXPERIMENTS
from experiments.thesis.claims import CLAIMS
from experiments.thesis.problems import DATA, Library
from experiments.thesis.tables import Table, escaped
from experiments.thesis.tasks import key
from experiments.thesis.verdicts import HOLDS, HOLDS_NOT, PARTLY, Results, Verdict, verdict_on

_INTRO = """\
# The claims of the thesis

The local DINM method comes from Z. Qu, *Efficient Optimization for Robust Bundle Adjustment*, master's thesis, TU
Munich, 2018. `ba thesis --all` repeats its experiments; from the figures recorded there
([thesis_results.json](thesis_results.json)) each of its claims is checked by comparisons that were declared with it
(`experiments/thesis/claims.py`): it **holds** if all of them do, **partly** if some do. The comparisons stand below the
table. What the thesis leaves open: [open_problems.md](open_problems.md).

"""
_HOW = """\
## How it was done

- All of a table runs with the same kernels, numpy's; a row "C++" is an addition. Times are processor time of one
  thread. Absolute times are not compared with the thesis's (Matlab, another machine), only ratios, and where a claim
  is about time the comparison asks for a margin beyond noise. All others compare counts of PCG steps, objectives,
  gradients and errors to truth, which a second run on the same machine repeats.
- Another machine rounds otherwise: the least gradient of a run then differs by a factor of two to three, PCG steps by a
  tenth, objectives by less than 1e-4 (of INM, which nothing damps, by 2 %). So a gradient is deeper if it is so by an
  order of magnitude, as the thesis's curves differ, and a test moves every recorded figure by such factors and asks for
  the same verdict.
- A step is one that was taken, as in the thesis; rejected ones are tried again. Ladybug-49 gets 50 steps and the
  thesis's caps on PCG. Where a step is costly fewer are made, said in the tables: 25 of all variants of INM and TNM,
  3 with Cholesky on all 23 769 unknowns, 8 and 1 on the two largest spheres.
- The spheres have the thesis's numbers of images, points and observations; its radius, noise, share of outliers and
  start are not known. Here: radius 500, noise 0.17 px, 2 % outliers of 10 to 60 px (none for 10-253).
- First damping, first radius and D of `inc` are not given, or damaged in our copy: see [methods.md](methods.md).

![Objective and gradient of DINM, INM, TNM and the baselines on Ladybug-49](images/thesis_3.8.png)

Figures 3.16 and 3.17: DINM, INM, TNM and the baselines on Ladybug-49.

![All methods on a sphere of 50 images](images/thesis_5.2.png)

Figures 5.12 and 5.13: all methods on the sphere of 50 images and 1000 points; the objective of IRLS is another one.

![Reprojection in two images before and after DINM](images/thesis_5.4.png)

Figure 5.4: reprojection in two images of Ladybug-49 before and after DINM.
"""


def verdict_table(verdicts: Sequence[Verdict], old: Collection[tuple[str, str]] = (), what: str = "claim") -> Table:
    """Return the claims with their verdicts, numbered.

    Args:
        verdicts: of verdicts.verdict_on.
        old: experiment and label of cases whose figures were recorded with other options than are declared now.
        what: head of the column of claims.
    """
    rows = []
    for number, verdict in enumerate(verdicts, start=1):
        claim = verdict.claim
        is_old = any(case in old for check in claim.checks for case in check.cases())
        rows.append((str(number), claim.text, claim.where, f"{verdict.word}{' (old)' * is_old}"))
    return Table(("", what, "where", "verdict"), tuple(rows))


def grounds(verdicts: Sequence[Verdict]) -> str:
    """Return, as Markdown, what each verdict rests on, numbered as in the table."""
    parts = []
    for number, verdict in enumerate(verdicts, start=1):
        parts.append(f"**{number}. {verdict.claim.text}**: {verdict.word}\n")
        parts.append("".join(f"- {'yes' if so else '**no**'}: {escaped(text)}\n" for so, text in verdict.found))
        if verdict.claim.remark:
            parts.append(f"{verdict.claim.remark}\n")
    return "\n".join(parts)


def old_cases(results: Results) -> set[tuple[str, str]]:
    """Return experiment and label of the cases that are declared otherwise now than when they were recorded."""
    library = Library(DATA)
    return {
        (experiment.name, case.label)
        for experiment in EXPERIMENTS
        for case in experiment.cases
        if results.get(experiment.name, {}).get(case.label, {}).get("key") != key(case.task, library)
    }


def claims_page(results: Results) -> str:
    """Return docs/thesis.md."""
    verdicts, old = [verdict_on(claim, results) for claim in CLAIMS], old_cases(results)
    counts = Counter(verdict.word for verdict in verdicts)
    summary = f"Of {len(verdicts)} claims {counts[HOLDS]} hold, {counts[PARTLY]} partly, {counts[HOLDS_NOT]} do not."
    if old:
        summary += (
            ' "(old)": the options of the method have changed since its figures were recorded; `ba thesis --all` and a'
            " copy of its results.json renew them."
        )
    table = verdict_table(verdicts, old).markdown()
    return f"{_INTRO}{summary}\n\n{table}\n{_HOW}\n## What the verdicts rest on\n\n{grounds(verdicts)}"
