# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts on the claims: they follow from figures, refer to what is run, and do not hang on a clock."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest

from experiments.thesis import catalogue
from experiments.thesis.claims import CLAIMS
from experiments.thesis.findings import FINDINGS
from experiments.thesis.metrics import METRICS
from experiments.thesis.open_page import open_page
from experiments.thesis.page import claims_page, old_cases
from experiments.thesis.verdicts import (
    HOLDS,
    HOLDS_NOT,
    NOT_RUN,
    PARTLY,
    Below,
    Breaks,
    Check,
    Claim,
    Within,
    verdict_on,
)

RECORDED = Path(__file__).resolve().parents[3] / "docs" / "thesis_results.json"
# Where the objective at the end is that of a point on the way, as nothing damps INM.
FAR_FROM_THE_END = ("3.5", "inm-tnm")
# By what factor another machine's rounding moves a figure.
NOISE = {
    "gradient_smallest": 2.0,
    "gradient_rise": 1.2,
    "objective": 1.0002,
    "pcg_total": 1.1,
    "pcg_per_solve": 1.1,
    "rmse_cameras": 1.1,
    "median_points": 1.1,
}
MADE_UP: dict[str, dict[str, dict[str, Any]]] = {
    "e": {"a": {"seconds": 1.0, "objective": 5.0, "steps": 3.0}, "b": {"seconds": 2.0, "objective": None, "steps": 4.0}}
}


@pytest.fixture(scope="module")
def recorded() -> dict[str, dict[str, dict[str, Any]]]:
    found: dict[str, dict[str, dict[str, Any]]] = json.loads(RECORDED.read_text())
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
        ((Breaks(("e",), "b"),), HOLDS),
        ((Breaks(("e",), "a"),), HOLDS_NOT),
    ],
)
def test_verdicts(checks: tuple[Check, ...], word: str) -> None:
    verdict = verdict_on(Claim("it is so", "1", checks), MADE_UP)
    assert verdict.word == word
    assert len(verdict.found) == (0 if word == NOT_RUN else len(checks))


def used(check: Check) -> list[tuple[str, str, str]]:
    """Return experiment, label and metric of everything that a check looks at."""
    if isinstance(check, Below):
        return [(check.experiment, label, check.metric) for label in (check.small, *check.large)]
    if isinstance(check, Within):
        return [(check.experiment, check.label, check.metric)]
    assert isinstance(check, Breaks)
    return [(name, check.label, "objective") for name in check.experiments]


@pytest.mark.parametrize("claim", CLAIMS + FINDINGS, ids=lambda claim: claim.text)
def test_a_claim_looks_at_what_is_run(claim: Claim) -> None:
    assert claim.checks
    for check in claim.checks:
        for name, label, metric in used(check):
            assert label in [case.label for case in catalogue.find(name).cases], (name, label)
            assert metric in METRICS


class TestRecorded:
    """The figures in docs/thesis_results.json, on which docs/thesis.md rests."""

    def test_they_judge_nearly_every_claim(self, recorded: dict[str, dict[str, dict[str, Any]]]) -> None:
        left = [claim.text for claim in CLAIMS if verdict_on(claim, recorded).word == NOT_RUN]
        assert len(left) <= len(CLAIMS) // 5, left

    @pytest.mark.parametrize("claim", CLAIMS + FINDINGS, ids=lambda claim: claim.text)
    def test_no_verdict_hangs_on_what_another_run_may_change(
        self, claim: Claim, recorded: dict[str, dict[str, dict[str, Any]]]
    ) -> None:
        """Each figure is moved by what was seen between two machines; what it is compared with stays."""
        word = verdict_on(claim, recorded).word
        for check in claim.checks:
            for name, label, metric in used(check):
                value = recorded[name][label].get(metric)
                by = 1.1 if METRICS[metric].is_time else NOISE.get(metric, 1.0)
                if metric == "objective" and name in FAR_FROM_THE_END:
                    by = 1.02
                for moved in (value * by, value / by) if value is not None else ():
                    recorded[name][label][metric] = moved
                    again = verdict_on(claim, recorded).word
                    recorded[name][label][metric] = value
                    assert again == word, (label, metric, value, moved)

    def test_the_page_shows_every_claim(self, recorded: dict[str, dict[str, dict[str, Any]]]) -> None:
        page = claims_page(recorded)
        assert all(claim.text in page for claim in CLAIMS)
        assert max(map(len, page.splitlines())) < 400, "a table that nobody can read"

    def test_the_other_page_shows_every_finding_and_its_pictures(
        self, recorded: dict[str, dict[str, dict[str, Any]]]
    ) -> None:
        page = open_page(recorded)
        assert all(finding.text in page for finding in FINDINGS)
        assert all(verdict_on(finding, recorded).word == HOLDS for finding in FINDINGS)
        names = re.findall(r"\]\((images/[^)]+)\)", page)
        assert len(names) == 5
        assert all((RECORDED.parent / name).read_bytes().startswith(b"\x89PNG") for name in names)

    def test_figures_of_another_declaration_are_marked(self, recorded: dict[str, dict[str, dict[str, Any]]]) -> None:
        moved = copy.deepcopy(recorded)
        moved["fig-3.1"]["remainder"]["key"] = "another"
        assert ("fig-3.1", "remainder") in old_cases(moved)
        row = next(line for line in claims_page(moved).splitlines() if "derivatives are right" in line)
        assert "| holds (old) |" in row
