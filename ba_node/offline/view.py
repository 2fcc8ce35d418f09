# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Show recordings in Foxglove: serve their messages over a WebSocket with their own definitions, at their own pace."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_source import BagChannel

_NS = 1e9
# What `ba replay` leaves in its folder.
REFINED = "refined.mcap"
# Cameras and clouds come once in a recording: repeated so often for those who connect later, s.
_REPEAT_S = 2.0
_LAST_PORT = 65535


class ViewError(ValueError):
    """What is needed to show a recording is not there."""


@dataclass(frozen=True)
class ViewOptions:
    """How to show."""

    host: str = "127.0.0.1"
    port: int = 8765  # 0 for any that is free
    rate: float = 1.0  # times real time; 0 for as fast as it goes
    rounds: int = 0  # how often; 0 until interrupted


@contextmanager
def serve(options: ViewOptions) -> Iterator[tuple[Any, str]]:
    """Start a server; yield what makes its channels, and its address.

    Raises:
        ViewError: foxglove-sdk is not installed, or the port is taken.
    """
    if not 0 <= options.port <= _LAST_PORT:
        raise ViewError(f"--port {options.port}: expected 0 to {_LAST_PORT}")
    try:
        foxglove = importlib.import_module("foxglove")
    except ModuleNotFoundError:
        raise ViewError("Foxglove needs foxglove-sdk: pip install ba_node[view]") from None
    context = foxglove.Context()
    try:
        server = foxglove.start_server(name="ba_node", host=options.host, port=options.port, context=context)
    except Exception as error:  # the library raises RuntimeError for what the system refuses
        raise ViewError(f"port {options.port}: {error}: give another one with --port") from None

    def channel(of: BagChannel) -> Any:
        schema = foxglove.Schema(name=of.type_name, encoding=of.encoding[1], data=of.definition.encode())
        return foxglove.Channel(of.topic, message_encoding=of.encoding[0], schema=schema, context=context)

    try:
        yield channel, f"ws://{options.host}:{server.port}"
    finally:
        server.stop()


def view(paths: Sequence[Path], options: ViewOptions, told: Callable[[str], None]) -> int:
    """Serve recordings side by side, by the time of their messages; return how many messages were sent.

    A folder of results stands for what is in its refined.mcap. ``told`` gets the address once the server is there.

    Raises:
        BagError: one cannot be read. ViewError: as :func:`serve`.
    """
    with ExitStack() as stack:
        readers = [stack.enter_context(BagReader(_recording(path))) for path in paths]
        channel, address = stack.enter_context(serve(options))
        show = _Show(readers, channel, options.rate)
        told(address)
        done = 0
        while options.rounds == 0 or done < options.rounds:
            show.play()
            done += 1
        return show.count


class _Show:
    """Sends the messages of recordings, again and again."""

    def __init__(self, readers: Sequence[BagReader], channel: Callable[[BagChannel], Any], rate: float) -> None:
        self._readers, self._make, self._rate = readers, channel, rate
        self._channels: dict[tuple[str, str], Any] = {}
        self._latched: dict[tuple[str, str], bytes] = {}
        self._repeated = time.monotonic()
        self.count = 0

    def play(self) -> None:
        """Send all messages once."""
        began, first = time.monotonic(), None
        parts = (reader.raw() for reader in self._readers)
        for channel, time_ns, data in merge(*parts, key=lambda message: message[1]):
            first = time_ns if first is None else first
            self._wait(began + (time_ns - first) / _NS / self._rate if self._rate else began, time_ns)
            key = (channel.topic, channel.type_name)
            if key not in self._channels:
                self._channels[key] = self._make(channel)
            if channel.is_latched:
                self._latched[key] = data
            self._channels[key].log(data, log_time=time_ns)
            self.count += 1

    def _wait(self, due: float, time_ns: int) -> None:
        """Sleep until it is time, and repeat what is latched."""
        while True:
            now = time.monotonic()
            if now - self._repeated > _REPEAT_S:
                self._repeated = now
                for key, data in self._latched.items():
                    self._channels[key].log(data, log_time=time_ns)
            if now >= due:
                return
            time.sleep(min(due - now, _REPEAT_S))


def _recording(path: Path) -> Path:
    refined = path / REFINED
    return refined if refined.is_file() else path
