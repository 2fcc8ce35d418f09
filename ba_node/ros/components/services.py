# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Offer ~/reset, ~/pause, ~/save_map and ~/load_map; they exist from configure on, active or not.

The map belongs to the solver's thread: what changes or copies it is posted there, and is done between two solves.
Files are written and read by a thread of their own, one at a time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ba_node.backend import Backend, MapContent
from ba_node.estimate import Estimate
from ba_node.io.map_file import MapFileError, load_map, write_map
from ba_node.io.map_folder import MapPathError, path_in_folder
from ba_node.messages.topics import SERVICES
from ba_node.ros.components.base import Component, Host
from ba_node.ros.message_factory import message_class
from ba_node.ros.rclpy_compat.deferred import Answer, DeferredService

_PAUSED = "paused"
_THREAD = "map file"


class Services(Component):
    """The services of the node."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._busy: Answer | None = None
        begin = {"reset": self._reset, "pause": self._pause, "save_map": self._save, "load_map": self._load}
        for name, command in SERVICES.items():
            service = DeferredService(host.deferred, message_class(command.type_name), f"~/{name}", begin[name])
            # Who is answered at cleanup must still hear it.
            host.after_cleanup.callback(service.destroy)

    def _reset(self, _request: Any, answer: Answer) -> None:
        def reset(backend: Backend) -> Estimate:
            keyframes = backend.map.keyframe_count
            backend.reset()
            text = f"forgot {keyframes} keyframes; the next keyframe begins a new map"
            answer.send_later(success=True, message=text)
            return backend.estimate()

        self.host.inbox.post(answer.working(reset))

    def _pause(self, request: Any, answer: Answer) -> None:
        """Ignore data, or take it again. What a solver has begun with goes on."""
        ignoring = self.host.ignoring
        was = _PAUSED in ignoring
        (ignoring.add if request.data else ignoring.discard)(_PAUSED)
        text = "paused: keyframes and tracks are ignored and counted" if request.data else "running"
        answer.send(success=True, message=f"{text}{' (as before)' if was == request.data else ''}")

    def _save(self, request: Any, answer: Answer) -> None:
        path = self._begin_file(request.path, answer, to_write=True)
        if path is None:
            return

        def copy(backend: Backend) -> None:
            content = backend.snapshot()
            # A file is written to the end when the node ends.
            answer.in_thread(lambda: self._write(path, content, answer), _THREAD)

        self.host.inbox.post(answer.working(copy))

    def _write(self, path: Path, content: MapContent, answer: Answer) -> None:
        try:
            write_map(path, content)
        except OSError as error:
            text = f"cannot write {path}: {error.strerror or error}; nothing was saved"
            answer.send_later(success=False, message=text)
            return
        counts = content.sizes()
        answer.send_later(success=True, message=f"{path}: {_listed(counts)}", **counts)

    def _load(self, request: Any, answer: Answer) -> None:
        path = self._begin_file(request.path, answer, to_write=False)
        if path is not None:
            # Nothing is lost with a read that does not come to its end.
            answer.in_thread(lambda: self._read(path, answer), _THREAD, daemon=True)

    def _read(self, path: Path, answer: Answer) -> None:
        try:
            known = load_map(path, self.host.config.scene)
        except MapFileError as error:
            answer.send_later(success=False, message=f"{error}; the map is as before")
            return

        def take_over(backend: Backend) -> Estimate:
            backend.take_over(known)
            counts = known.sizes()
            text = f"{path}: {_listed(counts)} of session {backend.map.session_id}"
            answer.send_later(success=True, message=text, **counts, session_id=backend.map.session_id)
            return backend.estimate()

        self.host.inbox.post(answer.working(take_over))

    def _begin_file(self, name: str, answer: Answer, *, to_write: bool) -> Path | None:
        """Return the path to work on, or None after saying why not."""
        if self._busy is not None and not self._busy.sent:
            text = "another map is being saved or loaded: try again when that is done"
            answer.send(success=False, message=text)
            return None
        try:
            path = path_in_folder(name, self.host.config.node.map_folder, to_write=to_write)
        except MapPathError as error:
            answer.send(success=False, message=str(error))
            return None
        self._busy = answer
        return path


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
