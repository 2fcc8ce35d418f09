# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write files that are either whole or not there."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def whole_file(path: Path | str, *, durable: bool = False) -> Iterator[IO[bytes]]:
    """Open a file to write that takes its name only when the block ends without an error.

    Until then it is ``.NAME.partial`` beside it; on an error that is removed, and an older file of the name stays.

    Args:
        path: the file.
        durable: wait until file and name are on the disk, so that they outlive a power failure.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as stream:
            yield stream
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    if durable:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
