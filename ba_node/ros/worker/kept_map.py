# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Load a map before the worker begins, and save one once it has ended (``node.load_map``, ``node.save_map``)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.io.map_file import MapFileError, load_map, write_map
from ba_node.io.map_folder import MapPathError, path_in_folder
from ba_node.ros.worker.worker import Notice, Worker


class KeptMapError(ValueError):
    """A parameter names a map that cannot be loaded, or a file that cannot be saved to; the text is one line."""


class KeptMap:
    """The files of one configuration.

    Raises:
        KeptMapError: a file cannot be what the parameters say.
    """

    def __init__(self, config: Config, log: Callable[[Notice], None]) -> None:
        self._config, self._log = config, log
        self.unseen = False  # a map was loaded that nobody has seen yet
        self._load, self._save = self._path("load_map"), self._path("save_map")

    def _path(self, name: str) -> Path | None:
        named = getattr(self._config.node, name)
        if not named:
            return None
        try:
            return path_in_folder(named, self._config.node.map_folder, to_write=name == "save_map")
        except MapPathError as error:
            raise KeptMapError(f"node.{name}: {error}") from error

    def load(self, backend: Backend) -> None:
        """Put a map in the place of the empty one. No file is no fault: it may be saved at the end of this run.

        Raises:
            KeptMapError: the file is no whole map.
        """
        path = self._load
        if path is None:
            return
        if not path.exists():
            self._log(Notice("load_map", f"node.load_map: no file {path}, beginning with an empty map"))
            return
        try:
            backend.take_over(load_map(path, self._config.scene))
            self.unseen = True
        except MapFileError as error:
            raise KeptMapError(f"node.load_map: {error}; give another file, or none") from error

    def save(self, backend: Backend, worker: Worker) -> threading.Thread | None:
        """Save the map once the worker has ended, on a thread of its own; None if there is nothing to do."""
        path = self._save
        if path is None:
            return None

        def write() -> None:
            while not worker.stop():
                pass
            try:
                if backend.map.keyframe_count:
                    write_map(path, backend.snapshot())
                else:
                    self._log(Notice("save_map", f"node.save_map: the map is empty, {path} is left as it was"))
            except OSError as error:
                text = f"node.save_map: cannot write {path}: {error.strerror or error}; the map is lost"
                self._log(Notice("save_map", text, is_error=True))

        # Not a daemon: the map is on the disk when the process ends.
        thread = threading.Thread(target=write, name="map file", daemon=False)
        thread.start()
        return thread
