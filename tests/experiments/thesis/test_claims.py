# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The judge: the thesis's own figures pass it, wrong ones fail, and a verdict that seeds can flip says so."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from experiments.thesis import catalogue
from experiments.thesis.claims import CLAIMS
from experiments.thesis.findings import FINDINGS
from experiments.thesis.metrics import METRICS, over_seeds
from experiments.thesis.open_page import open_page
from experiments.thesis.page import claims_page, old_cases
from experiments.thesis.tasks import Run
from experiments.thesis.verdicts import (
    HOLDS,
    HOLDS_NOT,
    NOT_RUN,
    PARTLY,
    Below,
    Check,
    Claim,
    NotRunError,
    Within,
    verdict_on,
)

RECORDED = Path(__file__).resolve().parents[3] / "docs" / "thesis_results.json"
Results = dict[str, dict[str, dict[str, Any]]]
MADE_UP: Results = {
    "e": {
        "a": {"seconds": 1.0, "objective": 5.0, "steps": 3.0, "spread": {"objective": [4.0, 7.0]}},
        "b": {"seconds": 2.0, "objective": None, "steps": 4.0},
        "c": {"objective": 6.0, "end": "took 3 steps"},
    }
}


@pytest.fixture(scope="module")
def recorded() -> Results:
    found: Results = json.loads(RECORDED.read_text())
    return found


@pytest.mark.parametrize(
    ("checks", "word"),
    [
        ((Below("e", "seconds", "a", ("b",), 1.5),), HOLDS),
        ((Below("e", "seconds", "a", ("b",), 2.5),), HOLDS_NOT),
        ((Below("e", "seconds", "a", ("b",)), Below("e", "seconds", "b", ("a",))), PARTLY),
        ((Within("e", "seconds", "b", 1.0, 3.0),), HOLDS),
        ((Within("e", "seconds", "b", high=1.9),), HOLDS_NOT),
        ((Within("e", "seconds", "c", high=1.9),), NOT_RUN),
        ((Below("f", "seconds", "a", ("b",)),), NOT_RUN),
        ((Below("e", "objective", "a", ("b",)),), HOLDS),
        ((Below("e", "objective", "b", ("b",)),), HOLDS_NOT),
    ],
)
def test_verdicts(checks: tuple[Check, ...], word: str) -> None:
    verdict = verdict_on(Claim("it is so", "1", checks), MADE_UP)
    assert verdict.word == word
    assert len(verdict.found) == (0 if word == NOT_RUN else len(checks))


def test_a_verdict_that_seeds_can_flip_says_so() -> None:
    close = verdict_on(Claim("it is so", "1", (Below("e", "objective", "a", ("c",)),)), MADE_UP)
    assert close.word == HOLDS and not close.steady and "can flip" in close.said
    far = verdict_on(Claim("it is so", "1", (Below("e", "steps", "a", ("b",)),)), MADE_UP)
    assert far.steady and far.said == HOLDS
    # A clock is not trusted to a tenth.
    near = verdict_on(Claim("it is so", "1", (Below("e", "seconds", "a", ("b",), 1.9),)), MADE_UP)
    assert near.word == HOLDS and not near.steady


def test_medians_and_spread_of_seeds() -> None:
    found = over_seeds([{"a": 1.0, "b": None, "end": "x"}, {"a": 3.0, "b": 2.0, "end": "y"}, {"a": 2.0, "b": None}])
    assert over_seeds([{"a": 1.0}, {"a": 2.0}])["a"] == 1.5
    assert found == {"a": 2.0, "b": None, "end": "x", "spread": {"a": [1.0, 3.0], "b": [2.0, None]}}
    assert over_seeds([{"a": 1.0}]) == {"a": 1.0}


def used(check: Check) -> list[tuple[str, str, str]]:
    """Return experiment, label and metric of everything that a check looks at."""
    assert isinstance(check, (Below, Within))
    return [(experiment, label, check.metric) for experiment, label in check.cases()]


@pytest.mark.parametrize("claim", CLAIMS + FINDINGS, ids=lambda claim: claim.text)
def test_a_claim_looks_at_what_is_run(claim: Claim) -> None:
    assert claim.checks
    for check in (*claim.checks, *claim.cause, *claim.elsewhere):
        for name, label, metric in used(check):
            assert label in [case.label for case in catalogue.find(name).cases], (name, label)
            assert metric in METRICS


def so_that_it_holds(claim: Claim) -> Results:
    """Return figures with which every comparison of a claim is as asked for, found by moving what is not."""
    figures: Results = {}
    for check in claim.checks:
        for name, label, metric in used(check):
            figures.setdefault(name, {}).setdefault(label, {})[metric] = 1.0
    for _ in range(50):
        for check in claim.checks:
            here = figures[used(check)[0][0]]
            if isinstance(check, Within):
                low, high = max(check.low, -1e30), min(check.high, 1e30)
                here[check.label][check.metric] = min(max(here[check.label][check.metric], 1.001 * low), 0.999 * high)
            elif isinstance(check, Below):
                for label in check.large:
                    least = check.factor * here[check.small][check.metric]
                    if here[label][check.metric] < least:
                        here[label][check.metric] = 1.00001 * least
    return figures


def wrong(check: Check, figures: Results) -> Results:
    """Return figures with which a comparison is the other way round."""
    out = copy.deepcopy(figures)
    name, label, metric = used(check)[0]
    if isinstance(check, Below):
        out[name][label][metric] = 1.01 * max(figures[name][other][metric] for other in check.large) / check.factor
    elif isinstance(check, Within):
        outside = check.low - 0.1 * abs(check.low) - 1e-30 if check.low > -1e30 else 1.1 * check.high + 1e-30
        out[name][label][metric] = outside
    return out


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.text)
class TestTheJudge:
    def test_the_figures_of_the_thesis_pass(self, claim: Claim) -> None:
        """Of every comparison for which it prints both sides."""
        for check in claim.checks:
            try:
                found = check.evaluate(catalogue.PRINTED, {})
            except NotRunError:
                continue
            assert found.good, found.words

    def test_it_can_hold_and_wrong_figures_fail(self, claim: Claim) -> None:
        figures = so_that_it_holds(claim)
        verdict = verdict_on(claim, figures)
        assert verdict.word == HOLDS, [one.words for one in verdict.found if not one.good]
        for number, check in enumerate(claim.checks):
            again = verdict_on(claim, wrong(check, figures))
            assert not again.found[number].good, again.found[number].words
            assert again.word != HOLDS


def test_most_printed_tables_are_judged() -> None:
    """By at least one comparison of which the thesis prints both sides."""
    judged = set()
    for claim in CLAIMS:
        for check in claim.checks:
            try:
                check.evaluate(catalogue.PRINTED, {})
            except NotRunError:
                continue
            judged |= {name for name, _, _ in used(check)}
    assert judged >= {"3.1", "3.2", "3.3", *(f"3.{i}" for i in range(5, 12)), "4.1", "4.2", "5.1", "5.2", "5.3", "5.4"}


class TestRecorded:
    """The figures in docs/thesis_results.json, on which docs/thesis.md rests."""

    def test_they_judge_every_claim(self, recorded: Results) -> None:
        assert [claim.text for claim in CLAIMS if verdict_on(claim, recorded).word == NOT_RUN] == []

    def test_every_solve_of_the_thesis_is_there_from_three_starts(self, recorded: Results) -> None:
        solves = [
            (experiment.name, case.label)
            for experiment in catalogue.REPEATED
            for case in experiment.cases
            if isinstance(case.task, Run)
        ]
        assert len(solves) == 143
        assert {recorded[name][label]["seeds"] for name, label in solves} == {3}

    def test_the_page_shows_every_claim(self, recorded: Results) -> None:
        page = claims_page(recorded)
        assert all(claim.text in page for claim in CLAIMS)
        assert max(len(line) for line in page.splitlines() if line.startswith("|")) < 400, (
            "a table that nobody can read"
        )

    def test_a_second_run_is_set_beside_them(self, recorded: Results) -> None:
        words = {claim.text: verdict_on(claim, recorded).word for claim in CLAIMS}
        same = claims_page(recorded, {"kernels": "C++, avx2", "verdicts": words})
        assert f"A second run (C++, avx2) gives the same verdict on {len(CLAIMS)} of them.\n" in same
        first = CLAIMS[0].text
        other = claims_page(recorded, {"kernels": "numpy", "verdicts": words | {first: HOLDS_NOT}})
        assert f"verdict on {len(CLAIMS) - 1} of them; another one on 1 (holds not).\n" in other

    def test_the_other_page_shows_every_finding_and_its_pictures(self, recorded: Results) -> None:
        page = open_page(recorded)
        assert all(finding.text in page for finding in FINDINGS)
        for finding in FINDINGS:
            verdict = verdict_on(finding, recorded)
            assert verdict.word == HOLDS, [one.words for one in verdict.found if not one.good]

    def test_figures_of_another_declaration_are_marked(self, recorded: Results) -> None:
        moved = copy.deepcopy(recorded)
        moved["fig-3.1"]["remainder"]["key"] = "another"
        assert ("fig-3.1", "remainder") in old_cases(moved)
        row = next(line for line in claims_page(moved).splitlines() if "derivatives are right" in line)
        assert "| holds (old) |" in row
