# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Pass measurements and commands from the executor's thread to the worker's, without ever blocking the first."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, get_args

from ba_node.backend import Backend
from ba_node.estimate import Estimate
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement, OfSession, OfTime

# What it returns is published.
Command = Callable[[Backend], Estimate | None]

# What is given up first when the inbox is full. A keyframe without some of its tracks still moves;
# tracks without their keyframe, or anything without cameras, are worth nothing.
_FIRST, _LAST = (FeatureTracks, LandmarkGuesses), (Keyframe, CameraRig)
_DROP_ORDER = (*_FIRST, *(kind for kind in get_args(OfTime | OfSession) if kind not in _FIRST), *_LAST)


@dataclass(frozen=True)
class Arrival:
    """A measurement, or a command to run between measurements, with the time it came in (s, steady clock)."""

    time_s: float
    content: Measurement | Command


class KeyframeCounts(NamedTuple):
    """Keyframes that came in, of these dropped, and of these still in the inbox."""

    received: int
    dropped: int
    waiting: int


class Inbox:
    """A bounded queue with one lane for each kind of measurement. All methods may be called from any thread.

    Args:
        size: measurements that may wait. Commands are few, count for nothing and are never dropped.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._changed = threading.Condition()
        self._lanes: dict[type, deque[tuple[int, Arrival]]] = {kind: deque() for kind in _DROP_ORDER}
        self._commands: deque[tuple[int, Arrival]] = deque()
        self._sequence = 0
        self._dropped = 0
        self._keyframes_received = 0
        self._keyframes_dropped = 0
        self.closed = False

    @property
    def dropped(self) -> int:
        """Return how many measurements have been dropped so far."""
        with self._changed:
            return self._dropped

    def __len__(self) -> int:
        with self._changed:
            return sum(len(lane) for lane in self._lanes.values())

    @property
    def keyframes(self) -> KeyframeCounts:
        """Return what became of the keyframes so far."""
        with self._changed:
            return KeyframeCounts(self._keyframes_received, self._keyframes_dropped, len(self._lanes[Keyframe]))

    def put(self, measurement: Measurement, time_s: float) -> None:
        """Add a measurement; if that is one too many, drop the oldest of the kind that can best be spared."""
        with self._changed:
            self._lanes[type(measurement)].append(self._numbered(Arrival(time_s, measurement)))
            self._keyframes_received += isinstance(measurement, Keyframe)
            if sum(len(lane) for lane in self._lanes.values()) > self._size:
                kind = next(kind for kind, lane in self._lanes.items() if lane)
                self._lanes[kind].popleft()
                self._dropped += 1
                self._keyframes_dropped += kind is Keyframe
            self._changed.notify()

    def post(self, command: Command) -> None:
        """Add something for the worker to do after what has arrived before it."""
        with self._changed:
            self._commands.append(self._numbered(Arrival(0.0, command)))
            self._changed.notify()

    def close(self) -> None:
        """Wake the reader and let it know that nothing more will be asked of it."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def drain(self, timeout_s: float | None) -> list[Arrival]:
        """Return everything in order of arrival, after waiting for something; empty on timeout or when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._occupied(), timeout_s)
            lanes = [*self._lanes.values(), self._commands]
            waiting = sorted((item for lane in lanes for item in lane), key=lambda item: item[0])
            for lane in lanes:
                lane.clear()
        return [arrival for _, arrival in waiting]

    def _occupied(self) -> bool:
        return bool(self._commands) or any(self._lanes.values())

    def _numbered(self, arrival: Arrival) -> tuple[int, Arrival]:
        self._sequence += 1
        return self._sequence, arrival
