# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep what the solves before are worth to the next: doubt, and odd steps that wait for others to agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ba_node.arrays import BoolArray
from ba_node.config import Config
from ba_node.window import steps

# Doubt that a held solve adds; the most there may be; up to which one that passes is taken; from which on what was
# taken of a young map is given up, and that is once it was given up before.
_HELD, _MAX_DOUBT, _ENOUGH, _LOST, _LOST_AGAIN = 2, 12, 1, 6, 2
# By how much bounds narrow while there is doubt.
_NARROW = 0.8


@dataclass(frozen=True)
class Odd:
    """Steps far off the front-end's that tracks bear out: solves that find them are held until others agree."""

    keys: tuple[tuple[int, int], ...]  # rows in the scene of the two keyframes of each
    steps: steps.Steps  # as the solution has them


def agree(found: Odd, earlier: Odd, config: Config, keys: list[tuple[int, int]]) -> BoolArray:
    """Return which of the steps ``keys`` are odd in both, and the same."""
    known = {key: k for k, key in enumerate(earlier.keys)}
    out = np.zeros(len(keys), bool)
    place = {key: k for k, key in enumerate(keys)}
    for i, key in enumerate(found.keys):
        if key in known:
            j = known[key]
            mine = steps.Steps(found.steps.turn[i : i + 1], found.steps.move[i : i + 1])
            its = steps.Steps(earlier.steps.turn[j : j + 1], earlier.steps.move[j : j + 1])
            out[place[key]] = steps.compare(mine, its, config.guard).sigmas[0] <= config.guard.max_sigmas
    return out


class Trust:
    """What the solves before are worth to the next: doubt grows with each that is held and falls with each that passes.

    After several held ones as many that pass are held too, until they have proved that the data are good again.
    """

    def __init__(self) -> None:
        self.doubt = 0  # 0: the next solution that passes is taken
        self.odd: Odd | None = None  # steps that the last solve found odd, and that tracks bear out
        self.agreeing = 0  # solves in a row that found them
        self.blamed: set[int] = set()  # rows of keyframes that the last solve was made without
        self.cause = ""  # why the last one was held, or made without them
        self.given_up = False  # what was taken of the map was given up before

    @property
    def lost(self) -> bool:
        """Return True if what was taken of a young map is to be given up."""
        return self.doubt >= (_LOST_AGAIN if self.given_up else _LOST)

    def bounds(self, config: Config) -> Config:
        """Return parameters with narrower bounds as long as there is doubt: who was just out does not slip back in."""
        if self.doubt <= _ENOUGH:
            return config
        guard = replace(
            config.guard,
            max_typical_sigmas=_NARROW * config.guard.max_typical_sigmas,
            max_scale_error=_NARROW * config.guard.max_scale_error,
            max_worse_share=_NARROW * config.guard.max_worse_share,
            min_inlier_share=min(config.guard.min_inlier_share / _NARROW, 1.0),
        )
        return replace(config, guard=guard)

    def confirmed(self, needed: int) -> Odd | None:
        """Return odd steps that as many solves agreed on as are needed."""
        return self.odd if self.agreeing >= needed else None

    def hear(self, reason: str, odd: Odd | None, without: tuple[int, ...], config: Config) -> str:
        """Return why a solution, held for ``reason`` or not, is held after all; empty if it is taken.

        ``odd`` are its odd steps, ``without`` the keyframes that it was made without, as they alone were wrong. One may
        be; if there are always others, it is not they that are wrong.
        """
        if odd is not None:
            same = self.odd is not None and agree(odd, self.odd, config, list(odd.keys)).all()
            self.odd, self.agreeing = odd, self.agreeing + 1 if same else 1
            return reason
        self.odd, self.agreeing = None, 0
        if reason:
            self.doubt, self.cause = min(self.doubt + _HELD, _MAX_DOUBT), reason
            return reason
        new, self.blamed = set(without) - self.blamed, set(without)
        self.doubt = min(self.doubt + _HELD * len(new), _MAX_DOUBT) if new else max(self.doubt - 1, 0)
        if self.doubt > _ENOUGH:
            return f"{self.cause} (this was found before; {self.doubt - _ENOUGH} more solves have to pass)"
        return ""
