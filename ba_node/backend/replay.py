# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve once for every keyframe of a stream, however its messages are spaced."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ba_node.backend.summary import MapSummary
from ba_node.estimate import Estimate
from ba_node.measurements import Keyframe, Measurement

if TYPE_CHECKING:
    from ba_node.backend.backend import Admitted, Backend


@dataclass(frozen=True)
class MapEnded:
    """Another map has taken the place of the one before.

    Attributes:
        summary: of the map before.
        replaced: True if it held nothing but a keyframe with a wrong stamp, and counts as never begun.
    """

    summary: MapSummary
    replaced: bool


def replay(backend: Backend, stream: Iterable[Measurement]) -> Iterator[Estimate | Keyframe | MapEnded]:
    """Take in a stream to its end; see ``Backend.replay``."""
    for measurement in stream:
        for admitted in backend.admit(measurement):
            yield from _taken(backend, admitted)
    for admitted in backend.admit_rest():
        yield from _taken(backend, admitted)
    backend.flush(final=True)
    while backend.ready:
        yield from _solved(backend)


def _taken(backend: Backend, admitted: Admitted) -> Iterator[Estimate | Keyframe | MapEnded]:
    if backend.completes(admitted):
        yield from _solved(backend)
    before = backend.map
    backend.take(admitted)
    if backend.map is not before:
        replaced = admitted.begins is not None and admitted.begins.replaces
        yield MapEnded(before.summary(), replaced)
    one = admitted.measurement
    if isinstance(one, Keyframe) and backend.scene.find_keyframe(one.keyframe_id) is not None:
        yield one


def _solved(backend: Backend) -> Iterator[Estimate]:
    estimate = backend.solve()
    if estimate is not None:
        yield estimate
