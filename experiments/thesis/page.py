# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write the page about the thesis's claims from recorded figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from experiments.thesis.catalogue import EXPERIMENTS, PRINTED
from experiments.thesis.claims import CLAIMS
from experiments.thesis.problems import DATA, Library
from experiments.thesis.tables import Table, escaped
from experiments.thesis.tasks import key
from experiments.thesis.verdicts import HOLDS, HOLDS_NOT, PARTLY, Found, Results, Verdict, verdict_on

SecondRun = Mapping[str, Any]

_INTRO = """\
# The claims of the thesis

The local DINM method comes from Z. Qu, *Efficient Optimization for Robust Bundle Adjustment*, master's thesis, TU
Munich, 2018. `ba thesis --all` repeats its experiments; from the figures recorded there
([thesis_results.json](thesis_results.json)) each of its claims is checked by comparisons that were declared with it
(`experiments/thesis/claims_chapter3.py`, `claims_chapter45.py`): it **holds** if all of them do, **partly** if some do.
The comparisons stand below the table, with the thesis's figures beside ours. What the thesis leaves open:
[open_problems.md](open_problems.md).

"""
_HOW = """\
## How it was judged

- The margins come from the thesis's own ratios where it prints them: half of a ratio, in orders of magnitude, is asked
  for (its square root). So its own figures pass, which a test checks, as it checks that wrong figures fail every
  comparison. Where it prints curves alone, an objective is lower by more than 1e-4 of it, a gradient deeper by a factor
  of two, or of ten where its curves lie orders of magnitude apart (`experiments/thesis/margins.py`). Depth is the value
  at the end of a run.
- `ba thesis` makes every solve from three starts, the file's and two that differ from it by 1e-13 of the points'
  coordinates; figures are medians, the least and the largest in brackets.
  Each comparison is made again with the worst and the best that seeds and another machine may make of it (another tenth
  of a time, half of a gradient, 1e-4 of an objective): a verdict that would change says so.
- The second run has its start points, seeds and order of work from the first, and other machine code: the kernels for
  AVX2 and OpenBLAS for Haswell (`BA_NODE_SIMD=avx2 OPENBLAS_CORETYPE=Haswell`), whose sums are rounded otherwise.
- "Elsewhere" are the same comparisons on data on which none of our choices was made.
- Times are processor time of one thread; only ratios are compared with the thesis's (Matlab, another machine). Where it
  compares curves against time, ours are compared at the time at which the first of them ends.

## How it was done

- All of a table runs with the same kernels, numpy's; a row "C++" is an addition.
- A step is one that was taken, as in the thesis; rejected ones are tried again. Ladybug-49 gets 50 steps and the
  thesis's caps on PCG. Where a step is costly fewer are made, said in the tables: 15 of all variants of INM and TNM, 2
  with Cholesky on all 23 769 unknowns, 4 and 2 on the two largest spheres in numpy.
- First damping and radius are not given. Those of chapter 3 are chosen by the number of solves that the thesis's times
  mean, those of section 4.1 and of the spheres by what it says of C and B: `experiments/thesis/starts.py`, and the
  table in [methods.md](methods.md). D of `inc` is damaged in our copy.
- The spheres have the thesis's numbers of images and points, its number of observations within 1 %, and its errors at
  the start. Its radius, noise and share of outliers are not known. Here: radius 500, noise 0.17 px, 2 % outliers of 10
  to 60 px (none for 10-253).

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
        rows.append((str(number), claim.text, claim.where, f"{verdict.said}{' (old)' * is_old}"))
    return Table(("", what, "where", "verdict"), tuple(rows))


def grounds(verdicts: Sequence[Verdict]) -> str:
    """Return, as Markdown, what each verdict rests on, numbered as in the table."""
    parts = []
    for number, verdict in enumerate(verdicts, start=1):
        parts.append(f"**{number}. {verdict.claim.text}**: {verdict.said}\n")
        parts.append("".join(f"- {line}\n" for line in lines(verdict.found)))
        if verdict.claim.remark:
            parts.append(f"{verdict.claim.remark}\n")
        shows_cause = verdict.word != HOLDS and verdict.cause
        for head, found in (("The cause", verdict.cause if shows_cause else ()), ("Elsewhere", verdict.elsewhere)):
            if found:
                parts.append(f"{head}:\n\n" + "".join(f"- {line}\n" for line in lines(found)))
    return "\n".join(parts)


def lines(found: Sequence[Found]) -> list[str]:
    """Return a line for each comparison, as Markdown."""
    return [
        f"{'yes' if one.good else '**no**'}{'' if one.at_worst == one.at_best else ' (not steadily)'}:"
        f" {escaped(one.words)}"
        for one in found
    ]


def old_cases(results: Results) -> set[tuple[str, str]]:
    """Return experiment and label of the cases that are declared otherwise now than when they were recorded."""
    library = Library(DATA)
    return {
        (experiment.name, case.label)
        for experiment in EXPERIMENTS
        for case in experiment.cases
        if results.get(experiment.name, {}).get(case.label, {}).get("key") != key(case.task, library)
    }


def claims_page(results: Results, second: SecondRun | None = None) -> str:
    """Return docs/thesis.md.

    Args:
        results: the recorded figures.
        second: verdicts.json of a run with the kernels and the linear algebra of another processor.
    """
    verdicts, old = [verdict_on(claim, results, PRINTED) for claim in CLAIMS], old_cases(results)
    counts = Counter(verdict.word for verdict in verdicts)
    summary = f"Of {len(verdicts)} claims {counts[HOLDS]} hold, {counts[PARTLY]} partly, {counts[HOLDS_NOT]} do not."
    if old:
        summary += (
            ' "(old)": the options of the method have changed since its figures were recorded; `ba thesis --all` and a'
            " copy of its results.json renew them."
        )
    summary += _second(verdicts, second) if second else ""
    table = verdict_table(verdicts, old).markdown()
    return f"{_INTRO}{summary}\n\n{table}\n{_HOW}\n## What the verdicts rest on\n\n{grounds(verdicts)}"


def _second(verdicts: Sequence[Verdict], second: SecondRun) -> str:
    """Return in words what a second run found otherwise; claims by their numbers in the table."""
    numbered = [(n, verdict, second["verdicts"][verdict.claim.text]) for n, verdict in enumerate(verdicts, start=1)]
    other = [(n, verdict, word) for n, verdict, word in numbered if word != verdict.word]
    said = f" A second run ({second['kernels']}) gives the same verdict on {len(verdicts) - len(other)} of them"
    parts = [f"{n} ({word}{', as it warns' * (not verdict.steady)})" for n, verdict, word in other]
    return f"{said}; another one on {', '.join(parts)}." if parts else f"{said}."
