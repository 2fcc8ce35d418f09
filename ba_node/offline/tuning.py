# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Search for better parameters on recordings, and see on another one that they are better.

The score of parameters is how their errors on the recordings compare with those of the start::

    score = exp(mean_r log(error_r / error_r of the start))

so that recordings count alike, whatever their errors are measured in. For accuracy the score is lowered, under a limit
of latency if there is one; for latency the p95 of the time of a solve is, with a score of no more than 1.05.
Parameters are drawn by Optuna's TPE (Bergstra et al., NIPS 2011) from the ranges that ``config/`` declares.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ba_node.config import Config, ConfigError, Parameter, Value, declarations, find
from ba_node.io.mcap import TopicChoice
from ba_node.offline.fleet import Fleet, result_of
from ba_node.offline.measure import Measured, MeasureError, Objective, Question, measure

Goal = Literal["accuracy", "latency"]
STUDY = "ba_node"
# How much worse the score may become where latency is lowered.
_MAX_SCORE = 1.05
# What says that the search is worth it, and that it fits the recordings alone.
MIN_GAIN, MAX_LOSS = 0.01, 0.02
_RANDOM_FIRST = 10


class TuneError(ValueError):
    """A search that cannot be made, or that was begun with other settings."""


@dataclass(frozen=True)
class Plan:
    """What is to be searched."""

    recordings: tuple[tuple[str, ...], ...]  # by whose errors parameters are chosen
    validation: tuple[str, ...] | None  # the one that is kept to see that they are better; None for none
    parameters: tuple[Parameter, ...]
    goal: Goal = "accuracy"
    objective: Objective = "auto"
    max_latency_ms: float | None = None  # limit on p95 of the time of a solve
    trials: int = 50
    seed: int = 1
    topics: TopicChoice = field(default_factory=TopicChoice)


@dataclass(frozen=True)
class Trial:
    """Parameters that were tried, and what came of it."""

    number: int
    values: dict[str, Value]
    score: float  # error beside that of the start, 1 for as much
    latency_ms: float  # p95 of the time of a solve, on the recording where it is largest
    feasible: bool  # within the limits


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
        allowed = 1.0 + MAX_LOSS if self.plan.goal == "accuracy" else _MAX_SCORE + MAX_LOSS
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
    optuna = _optuna()
    everything = (*plan.recordings, *([plan.validation] if plan.validation else []))
    start = _measured(fleet, plan, base, everything)
    study = _Study(optuna, plan, base, storage, {name: one.error for name, one in start.items()})
    study.begin(start)
    better(study.best())
    _search(plan, base, fleet, study, better, progress)
    best = study.best()
    after = _measured(fleet, plan, base.with_values(best.values), everything)
    return Tuned(plan, start, best, after, study.trials(), study.failed(), study.importance())


def _search(
    plan: Plan,
    base: Config,
    fleet: Fleet,
    study: _Study,
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


def _measured(fleet: Fleet, plan: Plan, config: Config, places: Sequence[tuple[str, ...]]) -> dict[str, Measured]:
    questions = [Question(place, config, plan.topics, plan.objective) for place in places]
    futures = [fleet.submit(measure, question) for question in questions]
    return {place[0]: result_of(future) for place, future in zip(places, futures, strict=True)}


def _optuna() -> Any:
    try:
        import optuna  # noqa: PLC0415
    except ImportError:
        raise TuneError("tuning needs Optuna: pip install ba_node[tune]") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


class _Study:
    """The trials of a search, in a file."""

    def __init__(self, optuna: Any, plan: Plan, base: Config, storage: Path, errors: Mapping[str, float]) -> None:
        self._optuna, self._plan = optuna, plan
        self._errors = [errors[place[0]] for place in plan.recordings]
        self._start = {one.name: base.values()[one.name] for one in plan.parameters}
        self._ranges = {one.name: _range(optuna, one, self._start[one.name]) for one in plan.parameters}
        backend = optuna.storages.journal.JournalFileBackend(str(storage))
        self._study = optuna.create_study(
            study_name=STUDY,
            storage=optuna.storages.JournalStorage(backend),
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(seed=plan.seed, multivariate=True, n_startup_trials=_RANDOM_FIRST),
        )
        about = {
            "recordings": [list(place) for place in plan.recordings],
            "start": {name: value for name, value in base.values().items() if value != Config().values()[name]},
            "ranges": {name: repr(one) for name, one in self._ranges.items()},
            "goal": [plan.goal, plan.objective, plan.max_latency_ms],
        }
        earlier = self._study.user_attrs.get("about")
        if earlier is not None and earlier != about:
            wrong = ", ".join(key for key in about if earlier.get(key) != about[key])
            raise TuneError(
                f"{storage}: holds a search with other {wrong}: name another file with --storage, or remove it"
            )
        self._study.set_user_attr("about", about)

    def begin(self, start: Mapping[str, Measured]) -> None:
        """Take in the start as the first trial, unless it is there from an earlier call."""
        if self.count() == 0:
            self._study.enqueue_trial(self._start)
            trial, _ = self.ask()
            self.tell(trial, [start[place[0]] for place in self._plan.recordings])

    def count(self) -> int:
        """Return how many trials are done."""
        return sum(trial.state.is_finished() for trial in self._study.get_trials(deepcopy=False))

    def failed(self) -> int:
        """Return how many trials were refused."""
        return self.count() - len(self.trials())

    def ask(self) -> tuple[Any, dict[str, Value]]:
        """Return a trial and its parameters."""
        trial = self._study.ask(self._ranges)
        return trial, _rounded(trial.params)

    def refuse(self, trial: Any) -> None:
        """Say that the parameters of a trial contradict each other, or gave nothing to measure."""
        self._study.tell(trial, state=self._optuna.trial.TrialState.FAIL)

    def tell(self, trial: Any, found: Sequence[Measured]) -> None:
        """Take in what a trial gave on the recordings, in any order: the score is the same."""
        score = score_of([one.error for one in found], self._errors)
        latency = max(one.latency_ms for one in found)
        trial.set_user_attr("score", score)
        trial.set_user_attr("latency_ms", latency)
        excess = [latency / self._plan.max_latency_ms - 1.0] if self._plan.max_latency_ms else []
        excess += [score / _MAX_SCORE - 1.0] if self._plan.goal == "latency" else []
        for number, value in enumerate(excess):
            trial.set_constraint(str(number), value)
        trial.set_user_attr("feasible", all(value <= 0.0 for value in excess))
        self._study.tell(trial, float(np.log(score)) if self._plan.goal == "accuracy" else latency)

    def trials(self) -> list[Trial]:
        """Return the trials that came to an end, in order."""
        done = self._study.get_trials(deepcopy=False, states=[self._optuna.trial.TrialState.COMPLETE])
        return [Trial(one.number, _rounded(one.params), **one.user_attrs) for one in done]

    def best(self) -> Trial:
        """Return the best trial within the limits; if none is, that which is nearest to them."""
        by_score = self._plan.goal == "accuracy"

        def key(one: Trial) -> tuple[bool, float]:
            if not one.feasible:
                return True, one.latency_ms if by_score else one.score
            return False, one.score if by_score else one.latency_ms

        return min(self.trials(), key=key)

    def importance(self) -> dict[str, float]:
        """Return how much each parameter decides (PED-ANOVA, Watanabe et al., IJCAI 2023), largest first."""
        if len(self.trials()) < 2 * _RANDOM_FIRST:
            return {}
        importance = self._optuna.importance
        try:
            found = importance.get_param_importances(
                self._study, evaluator=importance.PedAnovaImportanceEvaluator(), params=list(self._ranges)
            )
        except (ValueError, RuntimeError):
            return {}
        return {name: float(value) for name, value in found.items()}


def _rounded(values: Mapping[str, Value]) -> dict[str, Value]:
    """Return parameters with as many digits as people read."""
    return {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in values.items()}


def score_of(errors: Sequence[float], begun: Sequence[float]) -> float:
    """Return the geometric mean of the ratios of errors."""
    tiny = 1e-12
    return float(np.exp(np.mean(np.log(np.maximum(errors, tiny)) - np.log(np.maximum(begun, tiny)))))


def _range(optuna: Any, parameter: Parameter, start: Value) -> Any:
    """Return the range of a parameter as Optuna has it, wide enough for the value that the search begins with."""
    distributions = optuna.distributions
    if parameter.tune is None:
        return distributions.CategoricalDistribution(parameter.choices or (False, True))
    assert not isinstance(start, (str, bool))
    low, high = min(parameter.tune.low, start), max(parameter.tune.high, start)
    log = parameter.tune.log and low > 0
    if parameter.kind is int:
        return distributions.IntDistribution(int(low), int(high), log=log)
    return distributions.FloatDistribution(float(low), float(high), log=log)


def grid(values: Mapping[str, Sequence[Value]]) -> Iterator[dict[str, Value]]:
    """Yield every combination of values, the last parameter changing fastest."""
    for combination in itertools.product(*values.values()):
        yield dict(zip(values, combination, strict=True))


def sweep(
    plan: Plan,
    base: Config,
    fleet: Fleet,
    combinations: Sequence[dict[str, Value]],
    progress: Callable[[int, int], None],
) -> list[tuple[dict[str, Value], dict[str, Measured]]]:
    """Measure every combination of parameters on every recording; return them in their order.

    Raises:
        ConfigError: parameters contradict each other.
        MeasureError, BagError, FleetError: a recording cannot be used.
    """
    configs = [base.with_values(values) for values in combinations]
    questions = [
        Question(place, config, plan.topics, plan.objective) for config in configs for place in plan.recordings
    ]
    found: dict[int, Measured] = {}
    for number, measured in fleet.each(measure, questions, _lost):
        found[number] = measured
        progress(len(found), len(questions))
    n = len(plan.recordings)
    return [
        (values, {place[0]: found[row * n + column] for column, place in enumerate(plan.recordings)})
        for row, values in enumerate(combinations)
    ]


def _lost(question: Question, words: str) -> Measured:
    raise TuneError(f"{question.recording[0]}: {words}")
