# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Streams of messages to be spoilt, and a back-end that keeps what it gave for each keyframe."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any

import numpy as np

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.measurements import Keyframe, Measurement
from ba_node.scene.candidates import Admitted
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

S = 1_000_000_000
HOUR = 3600 * S
YEAR = 365 * 24 * HOUR
N = 16


@functools.cache
def data() -> SyntheticData:
    options = SyntheticOptions(
        keyframes=N, landmarks=700, tracks=50, length_m=16.0, path="line", ids="random64", seed=3, guesses=True
    )
    return generate(options)


def messages() -> list[Measurement]:
    return [measurement for _, _, measurement in data().timeline()]


def groups() -> list[list[Measurement]]:
    """Return the messages of each keyframe, the keyframe first; without the rig."""
    out: list[list[Measurement]] = []
    for keyframe, tracks, guess in zip(data().keyframes, data().tracks, data().guesses, strict=True):
        out.append([keyframe, *([guess] if guess else []), *tracks])
    return out


def stamped(group: Iterable[Measurement], shift_ns: int = 0, at_ns: int | None = None) -> list[Measurement]:
    """Return messages with the stamp of their keyframe moved or set."""

    def moved(m: Measurement) -> Measurement:
        if not isinstance(m, Keyframe):
            return m
        return dataclasses.replace(m, stamp_ns=m.stamp_ns + shift_ns if at_ns is None else at_ns)

    return [moved(m) for m in group]


def changed(group: Iterable[Measurement], **changes: Any) -> list[Measurement]:
    """Return messages with fields changed in all that have them."""

    def other(m: Any) -> Measurement:
        names = {f.name for f in dataclasses.fields(m)}
        mine: Measurement = dataclasses.replace(m, **{k: v for k, v in changes.items() if k in names})
        return mine

    return [other(m) for m in group]


class Remembering(Backend):
    """A back-end of which the maps that ended are kept."""

    def __init__(self, settings: dict[str, Any] | None = None) -> None:
        super().__init__(Config().with_values(settings or {}))
        self.finished: list[tuple[int | None, Estimate]] = []  # session and last estimate of the maps before

    def take(self, admitted: Admitted) -> None:
        before = self.map
        super().take(admitted)
        begins = admitted.begins
        if self.map is not before and before.keyframe_count and not (begins is not None and begins.replaces):
            self.finished.append((before.session_id, before.estimate()))


class Played(Remembering):
    """A back-end and what it gave for each keyframe of a stream."""

    def __init__(
        self, stream: Iterable[Measurement], final: bool = True, settings: dict[str, Any] | None = None
    ) -> None:
        super().__init__(settings)
        self.estimates: list[Estimate | None] = []
        self.play(stream, final)

    def play(self, stream: Iterable[Measurement], final: bool = True) -> None:
        for measurement in stream:
            self._take(self.admit(measurement))
        if final:
            self._take(self.admit_rest())
            self.flush(final=True)
            while self.ready:
                self.estimates.append(self.solve())

    def _take(self, several: Iterable[Any]) -> None:
        for admitted in several:
            if self.completes(admitted):
                self.estimates.append(self.solve())
            self.take(admitted)

    @property
    def ids(self) -> list[int]:
        """Return the ids of the current map by time."""
        return [int(key) for key in self.scene.keyframes.keyframe_id[self.scene.order]]

    @property
    def errors_m(self) -> tuple[float, float]:
        """Return the error of the current map before and after, both moved onto the truth at their first keyframe."""
        rows = [data().truth.keyframe_id.tolist().index(key) for key in self.ids]
        truth = data().truth.position[rows]
        last = self.estimates[-1]
        assert last is not None
        before = np.array([data().keyframes[row].position for row in rows])
        return _rmse(before, truth), _rmse(last.trajectory.position, truth)


def _rmse(found: Any, truth: Any) -> float:
    return float(np.sqrt(np.mean(np.sum((found - found[0] - truth + truth[0]) ** 2, axis=1))))


def joined(parts: Iterable[Iterable[Measurement]]) -> list[Measurement]:
    return [data().rig, *(m for part in parts for m in part)]


def all_ids() -> list[int]:
    return [keyframe.keyframe_id for keyframe in data().keyframes]


@functools.cache
def undisturbed() -> Played:
    return Played(messages())
