# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What an experiment asks for: a solve with its trace, or something measured beside the solver's loop.

Each has a key made of the problem and of everything that was chosen, the same on every machine: a record found under
it need not be made again, and a choice that changes makes a new one.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, replace

from ba_node.config import SolverOptions, Value
from ba_node.core.scaling import INC_STEPS
from ba_node.offline.solver_settings import solver_options
from experiments.thesis.problems import Library

# Rises when records hold something else than before.
_FORMAT = 1
_QUICK = 3
# Options that change no digit of a result.
_WITHOUT_EFFECT = ("threads",)
# Names of options when the records in docs/thesis_results.json were made: their keys stay.
# Options that came later: they are left out of keys while they change nothing.
_LATER: dict[str, Value] = {"loss_per": "observation"}
_NAMES_IN_KEYS = {"loss_scale_px": "loss_scale", "kernels": "backend", "inner_iterations": "polish_steps"}


@dataclass(frozen=True)
class Run:
    """A solve."""

    problem: str  # name in problems.py
    method: str  # name in core/methods.py
    settings: tuple[str, ...] = ()  # changes to it, as of ``--set``
    iterations: int = 50  # steps that are taken, as the thesis counts; rejected ones come on top, up to as many again
    images: tuple[int, ...] = ()  # of these the reprojections before and after are kept
    kernels: str = ""  # name in variants.VARIANTS, empty for the solver's own
    seed: int = 0  # of what moves the start by 1e-13 of it; 0: not moved

    def options(self) -> SolverOptions:
        """Return the method with its changes."""
        return solver_options(self.method, [*self.settings, f"max_iterations={2 * self.iterations}"])

    def content(self) -> dict[str, object]:
        """Return all that was chosen."""
        options: dict[str, Value] = {
            _NAMES_IN_KEYS.get(k, k): v
            for k, v in dataclasses.asdict(self.options()).items()
            if k not in _WITHOUT_EFFECT and _LATER.get(k) != v
        }
        content: dict[str, object] = {"run": options, "inc": INC_STEPS}
        content |= {"iterations": self.iterations, "images": self.images}
        content |= {"kernels": self.kernels} if self.kernels else {}
        content |= _led_up(self.options())
        return content | {"seed": self.seed} if self.seed else content

    @property
    def weight(self) -> int:
        """Return how much of a progress bar it is."""
        return self.iterations

    def quick(self) -> Run:
        """Return the same with a few iterations."""
        return replace(self, iterations=min(self.iterations, _QUICK))


@dataclass(frozen=True)
class Measure:
    """Something that is measured beside the loop."""

    problem: str  # name in problems.py
    what: str  # name in measures.MEASURES
    settings: tuple[str, ...] = ()  # for it

    def content(self) -> dict[str, object]:
        """Return all that was chosen."""
        content: dict[str, object] = {"measure": self.what, "settings": self.settings}
        if self.what == "conditions":
            method, _, _, *assignments = self.settings
            content |= _led_up(solver_options(method, assignments))
        return content

    @property
    def weight(self) -> int:
        """Return how much of a progress bar it is."""
        return 5

    def quick(self) -> Measure:
        """Return the same."""
        return self


Task = Run | Measure


def _led_up(options: SolverOptions) -> dict[str, object]:
    """Return how a loss with a plateau is led up to: Huber's loss comes first since this number."""
    return {"annealing": 2} if options.annealing != "none" else {}


def key(task: Task, library: Library) -> str:
    """Return the name of the record of a task.

    Raises:
        DataError: the data set is not there.
    """
    made_of = {"format": _FORMAT, "problem": library.identity(task.problem), **task.content()}
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:20]
