# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write files that are either whole or not there, each by one process at a time, and read none but regular ones.

While it is written a file is ``.NAME.<random>.partial`` beside its place: made anew, so that no link that someone has
planted is written through, and locked, so that what a killed process has left is not taken for one that is written.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import fcntl
import io
import json
import math
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

_MODE = 0o666
_TRIES = 100
# Of this process, for :func:`discard_partials`.
_partials: set[Path] = set()


class FileKindError(ValueError):
    """Something that is no regular file, or a larger one than makes sense."""


class FolderInUseError(ValueError):
    """A folder into which another process writes its results."""


@contextmanager
def whole_file(path: Path | str, *, durable: bool = False) -> Iterator[IO[bytes]]:
    """Open a file to write that takes its name only when the block ends without an error.

    On an error what was written is removed, and an older file of the name stays.

    ``durable`` waits until file and name are on the disk, so that they outlive a power failure.

    Raises:
        OSError: it cannot be written, or something else than a file has the name; names the file.
    """
    path = Path(path)
    _require_replaceable(path)
    _sweep(path)
    partial, descriptor, lock = _create(path)
    try:
        with io.BufferedWriter(_Raw(descriptor, path)) as stream:
            yield stream
            if durable:
                stream.flush()
                with _naming(path):
                    os.fsync(descriptor)
        with _naming(path):
            partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    finally:
        _partials.discard(partial)
        os.close(lock)
    if durable:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def discard_partials() -> None:
    """Remove what this process has begun to write: it is about to end in the middle of it."""
    for partial in list(_partials):
        with contextlib.suppress(OSError):
            partial.unlink()


@contextmanager
def locked_folder(path: Path) -> Iterator[None]:
    """Make a folder, and have it for this process alone while the block runs.

    On an error the folders that were made for it go again if nothing is in them.

    Raises:
        FolderInUseError: another process has it.
        NotADirectoryError: something else has the name of it or of one above it.
    """
    new = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        other = next(folder for folder in (path, *path.parents) if folder.exists() and not folder.is_dir())
        raise NotADirectoryError(errno.ENOTDIR, "is no folder: results need one, of another name", str(other)) from None
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            _lock(folder)
        except BlockingIOError:
            raise FolderInUseError(
                f"{path}: another process writes its results there: wait for its end, or name another folder"
            ) from None
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for made in new:
                made.rmdir()
        raise
    finally:
        os.close(folder)


def open_regular(path: Path | str, max_bytes: int) -> IO[bytes]:
    """Open a file to read, without ever waiting for a device or a pipe.

    Raises:
        FileKindError: it is no regular file, or has more bytes.
        OSError: it cannot be opened.
    """
    _require_regular(path, Path(path).stat(), max_bytes)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        # What was looked at and what was opened need not be the same.
        _require_regular(path, os.fstat(descriptor), max_bytes)
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


@contextmanager
def opened(path: Path | str, max_bytes: int, raised: type[ValueError]) -> Iterator[IO[bytes]]:
    """Open a file to read as :func:`open_regular` does, and raise ``raised``, naming it, where that cannot be."""
    try:
        with open_regular(path, max_bytes) as stream:
            yield stream
    except FileKindError as error:
        raise raised(str(error)) from None
    except OSError as error:
        raise raised(f"{path}: cannot be opened: {error.strerror or error}") from error


def write_json(path: Path | str, content: Mapping[str, Any]) -> None:
    """Write JSON that every reader takes: null for infinity and NaN, which JSON does not have."""
    with whole_file(path) as stream:
        stream.write(json_text(content).encode())


def write_csv(path: Path | str, rows: Sequence[Sequence[object]]) -> None:
    """Write a table; None is an empty cell."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    with whole_file(path) as stream:
        stream.write(text.getvalue().encode())


def json_text(content: Mapping[str, Any]) -> str:
    """Return what :func:`write_json` writes."""
    return json.dumps(_plain(content), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _require_regular(path: Path | str, found: os.stat_result, max_bytes: int) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(found.st_mode):
        raise FileKindError(f"{path}: cannot be read: it is no regular file")
    if found.st_size > max_bytes:
        raise FileKindError(f"{path}: cannot be read: {found.st_size} bytes are more than the limit of {max_bytes}")


class _Raw(io.FileIO):
    """A file whose errors name the file that it is to become, as those of a full disk do not."""

    def __init__(self, descriptor: int, path: Path) -> None:
        super().__init__(descriptor, "wb")
        self._path = path

    def write(self, data: Any, /) -> int:
        with _naming(self._path):
            return super().write(data)

    def close(self) -> None:
        with _naming(self._path):
            super().close()


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Have errors of the system name a file."""
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise


def _require_replaceable(path: Path) -> None:
    """Raise OSError if something has the name that a file must not replace: a device, a pipe, a link to one."""
    with contextlib.suppress(FileNotFoundError):
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "is there and no regular file: it is not replaced", str(path))


def _create(path: Path) -> tuple[Path, int, int]:
    """Return a new file beside a path: its name, its descriptor, and a second one that holds the lock."""
    for _ in range(_TRIES):
        partial = path.with_name(f".{path.name}.{os.urandom(8).hex()}.partial")
        _partials.add(partial)  # before it is there: a signal may come between
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            with _naming(path):
                descriptor = os.open(partial, flags, _MODE)
        except BaseException:
            _partials.discard(partial)
            raise
        with contextlib.suppress(BlockingIOError):
            _lock(descriptor)
            # Another process may have taken it for one that was left, before it was locked.
            if os.fstat(descriptor).st_nlink:
                return partial, descriptor, os.dup(descriptor)
        os.close(descriptor)
        _partials.discard(partial)
    raise OSError(errno.EAGAIN, "another process removes what is written", str(path))


def _sweep(path: Path) -> None:
    """Remove what killed processes have left of earlier files of the name."""
    try:
        left = [file for file in path.parent.iterdir() if _is_partial(file.name, path.name)]
    except OSError:
        return
    for partial in left:
        with contextlib.suppress(OSError):
            _remove_if_left(partial)


def _is_partial(name: str, of: str) -> bool:
    return name.startswith(f".{of}.") and name.endswith(".partial")


def _remove_if_left(partial: Path) -> None:
    """Remove a file of this user that no process writes."""
    descriptor = os.open(partial, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        found = os.fstat(descriptor)
        if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid():
            _lock(descriptor)
            partial.unlink()
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock a file or folder until it is closed.

    Raises:
        BlockingIOError: another process has it.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:  # a file system without locks is used without
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
