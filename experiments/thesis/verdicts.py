# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check a claim by its comparisons of recorded metrics: it holds if all of them do, partly if some do.

Comparisons of times ask for a margin that noise does not reach; most compare counts, objectives and gradients, which a
second run repeats to the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from experiments.thesis.metrics import METRICS, shown

Results = Mapping[str, Mapping[str, Mapping[str, Any]]]
HOLDS, PARTLY, HOLDS_NOT, NOT_RUN = "holds", "partly", "holds not", "not run"


class NotRunError(LookupError):
    """A metric that has not been measured."""


def metric_of(results: Results, experiment: str, label: str, metric: str) -> float:
    """Return a metric.

    Raises:
        NotRunError: there is none.
    """
    value = results.get(experiment, {}).get(label, {}).get(metric)
    if not isinstance(value, float):
        raise NotRunError(f"{experiment}, {label}: {metric}")
    return value


class Check(Protocol):
    """One comparison."""

    def cases(self) -> tuple[tuple[str, str], ...]:
        """Return experiment and label of each case that it looks at."""

    def evaluate(self, results: Results) -> tuple[bool, str]:
        """Return whether it is so, and in words what was asked and found."""


@dataclass(frozen=True)
class Below:
    """A metric of one case is below that of others, by a factor."""

    experiment: str
    metric: str
    small: str
    large: tuple[str, ...]
    factor: float = 1.0

    def cases(self) -> tuple[tuple[str, str], ...]:
        """Return experiment and label of each case that it looks at."""
        return tuple((self.experiment, label) for label in (self.small, *self.large))

    def evaluate(self, results: Results) -> tuple[bool, str]:
        """Return whether it is so, and what was asked and found."""
        small = metric_of(results, self.experiment, self.small, self.metric)
        others = {label: metric_of(results, self.experiment, label, self.metric) for label in self.large}
        good = all(small * self.factor <= value for value in others.values())
        asked = "below"
        if self.factor > 1.0:
            asked = f"below by a factor of {self.factor:.3g}"
        elif self.factor < 1.0:
            asked = f"at most {100.0 * (1.0 / self.factor - 1.0):.2g} % above"
        found = ", ".join(f"{label} {shown(self.metric, value)}" for label, value in others.items())
        return good, f"{METRICS[self.metric].title}: {self.small} {shown(self.metric, small)} {asked} {found}"


@dataclass(frozen=True)
class Within:
    """A metric lies between two bounds."""

    experiment: str
    metric: str
    label: str
    low: float = -math.inf
    high: float = math.inf

    def cases(self) -> tuple[tuple[str, str], ...]:
        """Return experiment and label of each case that it looks at."""
        return ((self.experiment, self.label),)

    def evaluate(self, results: Results) -> tuple[bool, str]:
        """Return whether it is so, and what was asked and found."""
        value = metric_of(results, self.experiment, self.label, self.metric)
        bounds = [f"at least {self.low:g}"] * (self.low > -math.inf) + [f"at most {self.high:g}"] * (
            self.high < math.inf
        )
        title = METRICS[self.metric].title
        return (
            self.low <= value <= self.high,
            f"{title}: {self.label} {shown(self.metric, value)} {' and '.join(bounds)}",
        )


@dataclass(frozen=True)
class Breaks:
    """A method ends without a finite result in some experiment."""

    experiments: tuple[str, ...]
    label: str

    def cases(self) -> tuple[tuple[str, str], ...]:
        """Return experiment and label of each case that it looks at."""
        return tuple((name, self.label) for name in self.experiments)

    def evaluate(self, results: Results) -> tuple[bool, str]:
        """Return whether it is so, and what was asked and found."""
        steps = [metric_of(results, name, self.label, "steps") for name in self.experiments]
        # What is not finite is null in a record.
        broken = sum(results[name][self.label].get("objective") is None for name in self.experiments)
        counted = ", ".join(f"{count:.0f}" for count in steps)
        return broken > 0, f"{self.label} breaks down in {broken} of {len(steps)} runs (it took {counted} steps)"


@dataclass(frozen=True)
class Claim:
    """What the thesis says."""

    text: str  # the claim
    where: str  # in the thesis
    checks: tuple[Check, ...]  # what has to be so
    remark: str = ""  # what is to be known about it


@dataclass(frozen=True)
class Verdict:
    """What became of a claim: the verdict, and for each check whether it is so and the words."""

    claim: Claim
    word: str
    found: tuple[tuple[bool, str], ...]


def verdict_on(claim: Claim, results: Results) -> Verdict:
    """Return the verdict; NOT_RUN if a metric that it needs has not been measured."""
    try:
        found = tuple(check.evaluate(results) for check in claim.checks)
    except NotRunError:
        return Verdict(claim, NOT_RUN, ())
    good = sum(so for so, _ in found)
    return Verdict(claim, HOLDS if good == len(found) else PARTLY if good else HOLDS_NOT, found)


def verdicts_on(claims: Sequence[Claim], results: Results) -> list[Verdict]:
    """Return the verdicts on all claims for which there are metrics."""
    return [verdict for claim in claims if (verdict := verdict_on(claim, results)).word != NOT_RUN]
