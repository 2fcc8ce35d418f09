# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read what C++ libraries print, for those that tell of their iterations in no other way."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def captured(descriptor: int) -> Iterator[list[bytes]]:
    """Keep what is written to a file descriptor (1 or 2); the list holds its lines afterwards."""
    lines: list[bytes] = []
    sys.stdout.flush()
    saved = os.dup(descriptor)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), descriptor)
        try:
            yield lines
        finally:
            os.dup2(saved, descriptor)
            os.close(saved)
            file.seek(0)
            lines.extend(file)
