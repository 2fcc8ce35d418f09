# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Search for better parameters on recordings, and see on another one that they are better.

The score of parameters is how their errors on the recordings compare with those of the start::

    score = exp(mean_r log(error_r / error_r of the start))

so that recordings count alike, whatever their errors are measured in. For accuracy the score is lowered, under a limit
of latency if there is one; for latency the p95 of the time of a solve is, with a score of no more than 1.05.
Parameters are drawn from the ranges that ``config/`` declares.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.config import Config, ConfigError, Parameter, Value, declarations, find
from ba_node.offline.fleet import Fleet, result_of, words_of
from ba_node.offline.measure import Measured, MeasureError, Question, measure
from ba_node.offline.page import Figure
from ba_node.offline.study import MAX_LOSS, MAX_SCORE, MIN_GAIN, Goal, Plan, Study, Trial, TuneError

# Parameters and what they give on each recording.
Swept = Sequence[tuple[dict[str, Value], dict[str, Measured]]]


@dataclass(frozen=True)
class Tuned:
    """The result of a search."""

    plan: Plan
    start: dict[str, Measured]  # of each recording, that for validation too
    best: Trial
    after: dict[str, Measured]  # the same with the best parameters
    trials: list[Trial]
    failed: int  # trials whose parameters contradict each other, or gave nothing to measure
    importance: dict[str, float]  # of each parameter, share; empty if too few trials tell
    slices: list[Figure]  # the score over each parameter
    left_out: dict[str, str]  # recordings that cannot be used, and why

    @property
    def improved(self) -> bool:
        """Return True if something better was found."""
        return self.best.feasible and self._value(self.best) < 1.0 - MIN_GAIN

    def _value(self, trial: Trial) -> float:
        begun = self.trials[0]
        return trial.score if self.plan.goal == "accuracy" else trial.latency_ms / begun.latency_ms

    @property
    def overfitted(self) -> bool:
        """Return True if the recording that was kept for validation became worse."""
        if self.plan.validation is None:
            return False
        name = self.plan.validation[0]
        allowed = 1.0 + MAX_LOSS if self.plan.goal == "accuracy" else MAX_SCORE + MAX_LOSS
        return self.after[name].error > allowed * self.start[name].error

    @property
    def changes(self) -> dict[str, Value]:
        """Return the parameters that are to be set: those of the best trial, none if nothing better was found."""
        return self.best.values if self.improved else {}


def preset(goal: Goal) -> tuple[Parameter, ...]:
    """Return the parameters that are worth tuning for a goal."""
    return tuple(one for one in declarations() if one.tune is not None and goal in one.tune.presets)


def chosen(names: Sequence[str]) -> tuple[Parameter, ...]:
    """Return parameters by name.

    Raises:
        ConfigError: there is no such parameter.
        TuneError: it has no range to be tuned in.
    """
    found = tuple(dict.fromkeys(find(name) for name in names))
    for one in found:
        if one.tune is None and not one.allowed and one.kind is not bool:
            tunable = ", ".join(other.name for other in declarations() if other.tune is not None)
            raise TuneError(f"parameter {one.name} has no range in which it is worth tuning; these have: {tunable}")
    return found


def tune(
    plan: Plan,
    base: Config,
    fleet: Fleet,
    storage: Path,
    better: Callable[[Trial], None],
    progress: Callable[[int, int], None],
) -> Tuned:
    """Search; what was found is kept in a file as it comes, and the same call goes on from there.

    ``better`` is called with each trial that is the best so far, ``progress`` with the number of trials.

    Raises:
        TuneError: Optuna is missing, or the file is of another search.
        MeasureError, BagError, FleetError: a recording cannot be used.
    """
    start, left_out = usable(plan, base, fleet)
    plan = replace(plan, recordings=tuple(place for place in plan.recordings if place[0] in start))
    if plan.validation is not None and plan.validation[0] not in start:
        plan = replace(plan, validation=None)
    study = Study(plan, base, storage, {name: one.error for name, one in start.items()})
    study.begin(start)
    better(study.best())
    _search(plan, base, fleet, study, better, progress)
    best = _validated(plan, base, fleet, study)
    after, useless = usable(plan, base.with_values(best.values), fleet)
    if useless:
        raise TuneError(f"with the best parameters: {next(iter(useless.values()))}")
    return Tuned(plan, start, best, after, study.trials(), study.failed(), study.importance(), study.slices(), left_out)


def _validated(plan: Plan, base: Config, fleet: Fleet, study: Study) -> Trial:
    """Return the best trial; of several that are nearly as good, that which is best on the recording for validation."""
    finalists = study.finalists()
    if plan.validation is None or len(finalists) < 2:
        return study.best()
    questions = [
        Question(plan.validation, base.with_values(one.values), plan.topics, plan.objective) for one in finalists
    ]
    futures = [fleet.submit(measure, question) for question in questions]
    errors = [np.inf if isinstance(found, Exception) else found.error for found in map(_result_or_error, futures)]
    return finalists[int(np.argmin(errors))]


def _search(
    plan: Plan,
    base: Config,
    fleet: Fleet,
    study: Study,
    better: Callable[[Trial], None],
    progress: Callable[[int, int], None],
) -> None:
    waiting: dict[Future[Measured], Any] = {}
    found: dict[int, list[Measured]] = {}
    best = study.best()
    while True:
        progress(min(study.count(), plan.trials), plan.trials)
        while len(waiting) < fleet.size and study.count() + len(set(waiting.values())) < plan.trials:
            trial, values = study.ask()
            try:
                config = base.with_values(values)
            except ConfigError:
                study.refuse(trial)
                continue
            found[trial.number] = []
            for place in plan.recordings:
                question = Question(place, config, plan.topics, plan.objective)
                waiting[fleet.submit(measure, question)] = trial
        if not waiting:
            return
        for future in wait(waiting, return_when=FIRST_COMPLETED).done:
            trial = waiting.pop(future)
            if trial.number not in found:  # refused by another recording
                continue
            try:
                found[trial.number].append(result_of(future))
            except MeasureError:
                del found[trial.number]
                study.refuse(trial)
                continue
            if len(found[trial.number]) == len(plan.recordings):
                study.tell(trial, found.pop(trial.number))
                if study.best() != best:
                    best = study.best()
                    better(best)


def usable(plan: Plan, base: Config, fleet: Fleet) -> tuple[dict[str, Measured], dict[str, str]]:
    """Return how good parameters are on each recording of a plan, and why those that cannot be used cannot.

    Raises:
        MeasureError, BagError, FleetError, OSError: none can be used to choose parameters by.
    """
    places = (*plan.recordings, *([plan.validation] if plan.validation else []))
    questions = [Question(place, base, plan.topics, plan.objective) for place in places]
    futures = [fleet.submit(measure, question) for question in questions]
    found: dict[str, Measured] = {}
    errors: dict[str, Exception] = {}
    for place, future in zip(places, futures, strict=True):
        result = _result_or_error(future)
        if isinstance(result, Measured):
            found[place[0]] = result
        else:
            errors[place[0]] = result
    if not any(place[0] in found for place in plan.recordings):
        raise next(iter(errors.values()))
    return found, {name: words_of(error) for name, error in errors.items()}


def _result_or_error(future: Future[Measured]) -> Measured | Exception:
    try:
        return result_of(future)
    except (ValueError, OSError) as error:
        return error


def grid(values: Mapping[str, Sequence[Value]]) -> Iterator[dict[str, Value]]:
    """Yield every combination of values, the last parameter changing fastest."""
    for combination in itertools.product(*values.values()):
        yield dict(zip(values, combination, strict=True))


def sweep(
    plan: Plan,
    base: Config,
    fleet: Fleet,
    combinations: Sequence[dict[str, Value]],
    keep: Callable[[int, int, Swept], None],
) -> tuple[Swept, dict[str, str]]:
    """Measure every combination of parameters on every recording.

    ``keep`` is called with the number of replays done, that of all, and the combinations that are through.

    Returns:
        The combinations in their order, and what cannot be used, recordings and combinations, and why.

    Raises:
        ConfigError: parameters contradict each other.
        TuneError: no combination can be used.
        MeasureError, BagError, FleetError: no recording can be used.
    """
    start, left_out = usable(plan, base, fleet)
    places = tuple(place for place in plan.recordings if place[0] in start)
    configs = [base.with_values(values) for values in combinations]
    questions = [Question(place, config, plan.topics, plan.objective) for config in configs for place in places]
    rows: list[dict[str, Measured]] = [{} for _ in configs]
    for done, (number, result) in enumerate(fleet.each(_measured_or_words, questions, lambda _, words: words), 1):
        row, column = divmod(number, len(places))
        if isinstance(result, Measured):
            rows[row][places[column][0]] = result
        else:
            values = ", ".join(f"{name}={value}" for name, value in combinations[row].items())
            left_out[f"{values}, {places[column][0]}"] = result
        keep(done, len(questions), _through(combinations, rows, places))
    found = _through(combinations, rows, places)
    if not found:
        raise TuneError(next(f"{name}: {words}" for name, words in left_out.items()))
    return found, left_out


def _through(
    combinations: Sequence[dict[str, Value]], rows: Sequence[dict[str, Measured]], places: Sequence[tuple[str, ...]]
) -> Swept:
    """Return the combinations that have been measured on all recordings."""
    return [
        (values, {place[0]: row[place[0]] for place in places})
        for values, row in zip(combinations, rows, strict=True)
        if len(row) == len(places)
    ]


def _measured_or_words(question: Question) -> Measured | str:
    try:
        return measure(question)
    except MeasureError as error:
        return words_of(error)
