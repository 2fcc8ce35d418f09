# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every target of the fuzzers by name: a function of bytes that raises if there is a fault."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz import files, streams

STREAMS: dict[str, Callable[[bytes], int]] = {"stream": streams.stream, "drive": streams.drive, "cdr": streams.cdr}
NAMES = (*STREAMS, *files.READERS)


def run(name: str, data: bytes) -> int:
    """Run a target on bytes; return the number of messages or files that it took.

    Raises:
        Exception: a fault: anything but an error of this package that speaks of its input.
    """
    if name in STREAMS:
        with warnings.catch_warnings():
            # Numbers that overflow on their way are no fault; what comes out is looked at.
            warnings.simplefilter("ignore", RuntimeWarning)
            return STREAMS[name](data)
    with TemporaryDirectory(prefix="fuzz_") as folder:
        path = Path(folder) / "input"
        path.write_bytes(data)
        try:
            files.READERS[name](path)
        except ValueError as error:
            # The command line prints these in one line; see cli/main.py.
            if not type(error).__module__.startswith("ba_node."):
                raise
    return 1


@functools.cache
def seeds() -> dict[str, list[bytes]]:
    """Return good inputs for every target."""
    return {**streams.seeds(), **files.seeds()}
