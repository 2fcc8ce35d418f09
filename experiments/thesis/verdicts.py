# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check a claim by its comparisons of recorded metrics: it holds if all of them do, partly if some do.

Metrics are medians over the starts of a run. Each comparison is made three times: with the medians, and with what
seeds and another machine may make of them at its worst and at its best. Where that changes the verdict, it says so.
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


@dataclass(frozen=True)
class Figure:
    """A metric of a case: the median, and the least and the largest that seeds and another machine may make of it."""

    low: float
    median: float
    high: float


@dataclass(frozen=True)
class Found:
    """What became of a comparison."""

    good: bool  # with the medians
    words: str  # what was asked and found
    at_worst: bool  # with what seeds and machines may do against it
    at_best: bool  # with what they may do for it


def figure_of(results: Results, experiment: str, label: str, metric: str) -> Figure:
    """Return a metric; what is not finite is infinite.

    Raises:
        NotRunError: there is none.
    """
    case = results.get(experiment, {}).get(label, {})
    if metric not in case or isinstance(case[metric], str):
        raise NotRunError(f"{experiment}, {label}: {metric}")
    low, high = case.get("spread", {}).get(metric) or (case[metric], case[metric])
    low, median, high = (math.inf if value is None else float(value) for value in (low, case[metric], high))
    noise = METRICS[metric].noise
    return Figure(min(low / noise, median), median, max(high * noise, median))


def told(results: Results, thesis: Results, where: tuple[str, str], metric: str) -> str:
    """Return a metric in words: the median, its spread over seeds, and the thesis's figure where it prints one."""
    experiment, label = where
    case = results[experiment][label]
    spread = case.get("spread", {}).get(metric)
    notes = [f"{shown(metric, spread[0])} to {shown(metric, spread[1])}"] if spread else []
    printed = thesis.get(experiment, {}).get(label, {}).get(metric)
    notes += [] if printed is None else [f"thesis {shown(metric, printed)}"]
    return f"{label} {shown(metric, case[metric])}" + (f" ({'; '.join(notes)})" if notes else "")


class Check(Protocol):
    """One comparison."""

    def cases(self) -> tuple[tuple[str, str], ...]:
        """Return experiment and label of each case that it looks at."""

    def evaluate(self, results: Results, thesis: Results) -> Found:
        """Return whether it is so, and in words what was asked and found, beside the thesis's figures.

        Raises:
            NotRunError: a metric has not been measured.
        """


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

    def evaluate(self, results: Results, thesis: Results) -> Found:
        """Return whether it is so, and what was asked and found."""
        small = figure_of(results, self.experiment, self.small, self.metric)
        large = [figure_of(results, self.experiment, label, self.metric) for label in self.large]
        words = [told(results, thesis, case, self.metric) for case in self.cases()]
        return Found(
            all(self._so(small.median, value.median) for value in large),
            f"{METRICS[self.metric].title}: {words[0]} {self._asked()} {', '.join(words[1:])}",
            all(self._so(small.high, value.low) for value in large),
            all(self._so(small.low, value.high) for value in large),
        )

    def _so(self, small: float, large: float) -> bool:
        return small * self.factor <= large and math.isfinite(small)

    def _asked(self) -> str:
        if self.factor > 1.0:
            return f"below by a factor of {self.factor:.4g}"
        return f"at most {100.0 * (1.0 / self.factor - 1.0):.2g} % above" if self.factor < 1.0 else "below"


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

    def evaluate(self, results: Results, thesis: Results) -> Found:
        """Return whether it is so, and what was asked and found."""
        value = figure_of(results, self.experiment, self.label, self.metric)
        bounds = [f"at least {self.low:g}"] * (self.low > -math.inf)
        bounds += [f"at most {self.high:g}"] * (self.high < math.inf)
        words = told(results, thesis, self.cases()[0], self.metric)
        ends = [self.low <= end <= self.high for end in (value.low, value.high)]
        good = self.low <= value.median <= self.high
        return Found(
            good, f"{METRICS[self.metric].title}: {words} {' and '.join(bounds)}", good and all(ends), good or any(ends)
        )


@dataclass(frozen=True)
class Claim:
    """What the thesis says."""

    text: str  # the claim
    where: str  # in the thesis
    checks: tuple[Check, ...]  # what has to be so
    remark: str = ""  # what is to be known about it
    cause: tuple[Check, ...] = ()  # comparisons that show why it is not so, where it is not
    elsewhere: tuple[Check, ...] = ()  # the same on data on which nothing was chosen


@dataclass(frozen=True)
class Verdict:
    """What became of a claim: the verdict, and the comparisons that it rests on."""

    claim: Claim
    word: str
    found: tuple[Found, ...]
    cause: tuple[Found, ...] = ()
    elsewhere: tuple[Found, ...] = ()

    @property
    def steady(self) -> bool:
        """Return False if seeds or another machine may give another verdict."""
        corners = ([one.at_worst for one in self.found], [one.at_best for one in self.found])
        return self.word == NOT_RUN or all(word_for(corner) == self.word for corner in corners)

    @property
    def said(self) -> str:
        """Return the verdict in words."""
        parts = [self.word, "" if self.steady else "seeds or a machine can flip it"]
        if self.elsewhere:
            parts.append(f"elsewhere: {word_for([one.good for one in self.elsewhere])}")
        return "; ".join(part for part in parts if part)


def word_for(good: Sequence[bool]) -> str:
    """Return the verdict that comparisons make."""
    return HOLDS if all(good) else PARTLY if any(good) else HOLDS_NOT


def verdict_on(claim: Claim, results: Results, thesis: Results | None = None) -> Verdict:
    """Return the verdict; NOT_RUN if a metric that it needs has not been measured."""
    try:
        found = _evaluated(claim.checks, results, thesis)
    except NotRunError:
        return Verdict(claim, NOT_RUN, ())
    others = (_if_run(checks, results, thesis) for checks in (claim.cause, claim.elsewhere))
    return Verdict(claim, word_for([one.good for one in found]), found, *others)


def verdicts_on(claims: Sequence[Claim], results: Results, thesis: Results | None = None) -> list[Verdict]:
    """Return the verdicts on all claims for which there are metrics."""
    return [verdict for claim in claims if (verdict := verdict_on(claim, results, thesis)).word != NOT_RUN]


def _if_run(checks: Sequence[Check], results: Results, thesis: Results | None) -> tuple[Found, ...]:
    """Return what became of comparisons, nothing if one of them has not been run."""
    try:
        return _evaluated(checks, results, thesis)
    except NotRunError:
        return ()


def _evaluated(checks: Sequence[Check], results: Results, thesis: Results | None) -> tuple[Found, ...]:
    return tuple(check.evaluate(results, thesis or {}) for check in checks)
