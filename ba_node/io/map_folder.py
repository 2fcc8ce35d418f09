# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep the maps that clients name in one folder: no way out of it, and nothing overwritten that is no map."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ba_node.io.map_file import is_map, map_name


class MapPathError(ValueError):
    """A name of a map that is not taken."""


def path_in_folder(name: str, folder: str, *, to_write: bool) -> Path:
    """Return the file that a client means: relative to the folder or below it; ``.npz`` is added where it is missing.

    ``~`` is the home. To write into, the folder is made if missing, and what stands there is to be replaced if it is a
    map.

    Raises:
        MapPathError: no name, no folder, a way out of it, something that is no regular file, or to write, a file that
            is no map.
    """
    if not folder:
        raise MapPathError("node.map_folder is empty: maps are neither saved nor loaded")
    if not Path(name).name or "\0" in name or name.endswith("/"):
        raise MapPathError(f"path = {name!r}: expected the name of a file")
    root = Path(os.path.expanduser(folder))  # noqa: PTH111  # Path's raises where there is no such user
    path = root / map_name(os.path.expanduser(name))  # noqa: PTH111
    elsewhere = f"path = {name!r} leads elsewhere: expected a file below node.map_folder = {root}"
    if ".." in path.parts:
        raise MapPathError(elsewhere)
    try:
        parent = path.parent.resolve()
        if not parent.is_relative_to(root.resolve()):
            raise MapPathError(elsewhere)
        if to_write and parent == root.resolve():
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
        _look_at(parent / path.name, to_write=to_write)
    except (OSError, RuntimeError) as error:  # the second for links in a circle
        raise MapPathError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    return path


def _look_at(path: Path, *, to_write: bool) -> None:
    """Refuse what no map can be, without opening a device."""
    try:
        mode = os.lstat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return  # reading or writing says so
    if stat.S_ISLNK(mode):
        raise MapPathError(f"{path} is a link: maps are plain files")
    if not stat.S_ISREG(mode):
        raise MapPathError(f"{path} is no regular file: maps are plain files")
    if to_write and not is_map(path):
        raise MapPathError(f"{path} is there and no map of ba_node: it is not overwritten; choose another name")
