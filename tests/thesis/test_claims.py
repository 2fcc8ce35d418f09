# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts on the claims: they follow from figures, refer to what is run, and do not hang on a clock."""

from __future__ import annotations

from typing import Any

import pytest

from ba_node.thesis import catalogue
from ba_node.thesis.claims import CLAIMS
from ba_node.thesis.judging import (
    HOLDS,
    HOLDS_NOT,
    NOT_RUN,
    PARTLY,
    Below,
    Breaks,
    Check,
    Claim,
    Within,
    judge,
)
from ba_node.thesis.quantities import QUANTITIES

MADE_UP: dict[str, dict[str, dict[str, Any]]] = {
    "e": {"a": {"seconds": 1.0, "objective": 5.0, "steps": 3.0}, "b": {"seconds": 2.0, "objective": None, "steps": 4.0}}
}


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
    verdict = judge(Claim("it is so", "1", checks), MADE_UP)
    assert verdict.word == word
    assert len(verdict.found) == (0 if word == NOT_RUN else len(checks))


def used(check: Check) -> list[tuple[str, str, str]]:
    """Return experiment, label and quantity of everything that a check looks at."""
    if isinstance(check, Below):
        return [(check.experiment, label, check.quantity) for label in (check.small, *check.large)]
    if isinstance(check, Within):
        return [(check.experiment, check.label, check.quantity)]
    assert isinstance(check, Breaks)
    return [(name, check.label, "objective") for name in check.experiments]


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.text)
def test_a_claim_looks_at_what_is_run(claim: Claim) -> None:
    assert claim.checks
    for check in claim.checks:
        for name, label, quantity in used(check):
            assert label in [case.label for case in catalogue.find(name).cases], (name, label)
            assert quantity in QUANTITIES
