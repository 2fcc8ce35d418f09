# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Offer ~/reset, ~/pause, ~/save_map and ~/load_map; they exist from configure on, active or not.

The map belongs to the solver's thread: what changes or copies it is posted there, and is done between two solves.
Files are written and read by a thread of their own, one at a time.
"""

from __future__ import annotations

import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ba_node.io.map_file import MapFileError, load_map, write_map
from ba_node.messages.commands import SERVICE_TYPES
from ba_node.ros.component import Component, Host
from ba_node.ros.convert import message_class
from ba_node.ros.relay import Answer, LateService, Relay

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ba_node import archive
    from ba_node.backend import Backend
    from ba_node.estimate import Estimate
    from ba_node.scene.map_content import MapContent

_PAUSED = "paused"


class Services(Component):
    """The services of the node."""

    def __init__(self, host: Host) -> None:
        """Advertise."""
        super().__init__(host)
        self._relay = Relay(self)
        self._busy: Answer | None = None
        begin = {"reset": self._reset, "pause": self._pause, "save_map": self._save, "load_map": self._load}
        for name, kind in SERVICE_TYPES.items():
            LateService(self, message_class(kind), f"~/{name}", begin[name])

    def _reset(self, _request: Any, answer: Answer) -> None:
        def reset(backend: Backend) -> Estimate:
            keyframes = len(backend.scene.keyframes)
            backend.reset()
            self._give(answer, True, f"forgot {keyframes} keyframes; the next keyframe begins a new map")
            return backend.estimate()

        self._post(answer, reset)

    def _pause(self, request: Any, answer: Answer) -> None:
        """Ignore data, or take it again. What a solver has begun with goes on."""
        ignoring = self.host.ignoring
        was = _PAUSED in ignoring
        (ignoring.add if request.data else ignoring.discard)(_PAUSED)
        text = "paused: keyframes and tracks are ignored and counted" if request.data else "running"
        answer.give(success=True, message=f"{text}{' (as before)' if was == request.data else ''}")

    def _save(self, request: Any, answer: Answer) -> None:
        path = self._begin_file(request.path, answer)
        if path is None:
            return

        def copy(backend: Backend) -> None:
            content = backend.snapshot()
            self._in_thread(answer, lambda: self._write(path, content, answer))

        self._post(answer, copy)

    def _write(self, path: Path, content: MapContent, answer: Answer) -> None:
        try:
            write_map(path, content)
        except OSError as error:
            self._give(answer, False, f"cannot write {path}: {error.strerror or error}; nothing was saved")
            return
        counts = _counts(content)
        self._give(answer, True, f"{path}: {_told(counts)}", **counts)

    def _load(self, request: Any, answer: Answer) -> None:
        path = self._begin_file(request.path, answer)
        if path is not None:
            self._in_thread(answer, lambda: self._read(path, answer))

    def _read(self, path: Path, answer: Answer) -> None:
        try:
            known = load_map(path, self.host.config.scene)
        except MapFileError as error:
            self._give(answer, False, f"{error}; the map is as before")
            return

        def take_over(backend: Backend) -> Estimate:
            backend.take_over(known)
            counts = _known(known)
            text = f"{path}: {_told(counts)} of session {known.scene.session_id or 0}"
            self._give(answer, True, text, **counts, session_id=known.scene.session_id or 0)
            return backend.estimate()

        self._post(answer, take_over)

    def _begin_file(self, name: str, answer: Answer) -> Path | None:
        """Return the path to work on, or None after saying why not."""
        if self._busy:
            answer.give(success=False, message="another map is being saved or loaded: try again when that is done")
        elif not name or "\0" in name:
            answer.give(success=False, message=f"path = {name!r}: expected the name of a file")
        else:
            self._busy = answer
            return Path(name).expanduser()
        return None

    def _post(self, answer: Answer, command: Callable[[Backend], Estimate | None]) -> None:
        """Have the solver's thread do something; the caller hears of it if that fails."""

        def guarded(backend: Backend) -> Estimate | None:
            with self._telling(answer):
                return command(backend)

        self.host.inbox.post(guarded)

    def _in_thread(self, answer: Answer, action: Callable[[], None]) -> None:
        def guarded() -> None:
            with self._telling(answer):
                action()

        # Not a daemon, as the solver's thread is that starts it: a file is written to the end when the node ends.
        threading.Thread(target=guarded, name="map file", daemon=False).start()

    @contextmanager
    def _telling(self, answer: Answer) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self._give(answer, False, f"internal error: {type(error).__name__}: {error}")
            raise

    def _give(self, answer: Answer, success: bool, message: str, **fields: int) -> None:
        """Answer, from any thread."""

        def give() -> None:
            self._busy = None if self._busy is answer else self._busy
            answer.give(success=success, message=message, **fields)
            (self.host.node.get_logger().info if success else self.host.node.get_logger().warning)(message)

        self._relay.call(give)


def _counts(content: MapContent) -> dict[str, int]:
    return {
        "keyframes": len(content.arrays["keyframes/keyframe_id"]),
        "landmarks": len(content.arrays["landmarks/track_id"]),
        "observations": len(content.arrays["sightings/keyframe"]),
    }


def _known(known: archive.Known) -> dict[str, int]:
    scene = known.scene
    return {
        "keyframes": len(scene.keyframes),
        "landmarks": len(scene.landmarks),
        "observations": len(scene.sightings),
    }


def _told(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
