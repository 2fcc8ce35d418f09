# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep the trials of a search in a file, and have Optuna's TPE choose the next one (Bergstra et al., NIPS 2011)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ba_node.config import Config, Parameter, Value
from ba_node.io.bag_topics import TopicChoice
from ba_node.offline.measure import Measured, Objective
from ba_node.offline.page import Figure

Goal = Literal["accuracy", "latency"]
STUDY = "ba_node"
# How much worse the score may become where latency is lowered.
MAX_SCORE = 1.05
# What says that the search is worth it, and that it fits the recordings alone.
MIN_GAIN, MAX_LOSS = 0.01, 0.02
_RANDOM_FIRST = 10
# Parameters that are drawn one by one, of those that decide most.
_DRAWN = 6
# Trials of which the recording for validation chooses one, none of them worse than the best by more than this.
_FINALISTS, _NEARLY = 10, 1.1


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


def _optuna() -> Any:
    try:
        import optuna  # noqa: PLC0415
    except ImportError:
        raise TuneError("tuning needs Optuna: pip install ba_node[tune]") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


class Study:
    """The trials of a search, in a file."""

    def __init__(self, plan: Plan, base: Config, storage: Path, errors: Mapping[str, float]) -> None:
        self._optuna, self._plan = _optuna(), plan
        optuna = self._optuna
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
        excess += [score / MAX_SCORE - 1.0] if self._plan.goal == "latency" else []
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
        return min(self.trials(), key=self._rank)

    def finalists(self) -> list[Trial]:
        """Return the best trials, none of them much worse than the first."""
        ranked = sorted((one for one in self.trials() if one.feasible), key=self._rank)[:_FINALISTS]
        return [one for one in ranked if self._rank(one)[1] <= _NEARLY * self._rank(ranked[0])[1]]

    def _rank(self, one: Trial) -> tuple[bool, float]:
        by_score = (self._plan.goal == "accuracy") == one.feasible
        return not one.feasible, one.score if by_score else one.latency_ms

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

    def slices(self) -> list[Figure]:
        """Return the score over each of the parameters that decide most; nothing where plotly is not installed."""
        draw = self._optuna.visualization
        if not draw.is_available():
            return []
        names = [*self.importance(), *self._ranges]
        drawn = draw.plot_slice(
            self._study,
            params=list(dict.fromkeys(names))[:_DRAWN],
            target=lambda trial: trial.user_attrs["score"],
            target_name="error beside the start's",
        ).to_plotly_json()
        layout = {
            name: axis | {"title": axis.get("title", {}).get("text", "")}
            for name, axis in drawn["layout"].items()
            if name.startswith(("xaxis", "yaxis"))
        }
        return [
            Figure("slices", "Each parameter by itself", "Later trials are darker.", drawn["data"], layout, wide=True)
        ]


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
