# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""End ``ba`` with one line and a code of its own on SIGINT and SIGTERM, at any moment of its life.

Python's own way is to raise KeyboardInterrupt wherever it stands: in an import, in a callback of a C library that
swallows it, or while the interpreter ends. So here the handler itself ends the process: it has those who asked for it
tidy up (files that are half written, processes that were started), says so, and leaves without another line of Python.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

# As a shell has it: 128 and the number of the signal.
CODES = {signal.SIGINT: 128 + signal.SIGINT, signal.SIGTERM: 128 + signal.SIGTERM}
_PROGRAM = "ba_node.cli.main"
_tidy: list[Callable[[], None]] = []
_begun = False


def is_program() -> bool:
    """Return True while this process begins to run ``ba``, as a script or with ``python -m``."""
    return os.path.basename(sys.argv[0]) == "ba" or (sys.argv[0] == "-m" and _PROGRAM in sys.orig_argv)  # noqa: PTH119


def is_worker() -> bool:
    """Return True in a process that ``ba`` has started for a part of its work, in which it is imported again."""
    return "--multiprocessing-fork" in sys.orig_argv


def leave_to_parent() -> None:
    """Have Ctrl-C in a terminal, which reaches all processes, end that which began them, and they with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def begin() -> None:
    """Take the signals over, until the process ends, and the standard streams where they are closed."""
    global _begun  # noqa: PLW0603  # signals are those of the whole process, too
    _begun = True
    _open_closed_streams()
    for number in CODES:
        signal.signal(number, _end)
    # Whoever started this process may have held them back until now.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, CODES)


def begun() -> bool:
    """Return True if this process runs ``ba`` and nothing else."""
    return _begun


def at_interrupt(tidy: Callable[[], None]) -> None:
    """Have something done before the process ends on a signal; what came last is done first."""
    _tidy.append(tidy)


def leave(code: int) -> NoReturn:
    """End the process as Python does, but for what it does last, when it takes no signals any more."""
    import atexit  # noqa: PLC0415

    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        _quietly(stream.flush)
    os._exit(code)


def _open_closed_streams() -> None:
    """Open what of the standard streams is closed (``ba ... >&-``): else the next file takes its place."""
    number = os.open(os.devnull, os.O_RDWR)
    while number <= 2:
        os.set_inheritable(number, True)
        number = os.open(os.devnull, os.O_RDWR)
    os.close(number)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115


def _end(number: int, _frame: FrameType | None) -> None:
    for other in CODES:
        signal.signal(other, signal.SIG_IGN)
    for tidy in reversed(_tidy):
        _quietly(tidy)
    # To the descriptor: whatever was being written when the signal came holds the stream.
    line = "interrupted" if number == signal.SIGINT else "terminated"
    _quietly(lambda: os.write(2, ("\n" * os.isatty(2) + f"ba: {line}\n").encode()))
    os._exit(CODES[signal.Signals(number)])


def _quietly(action: Callable[[], object]) -> None:
    with contextlib.suppress(BaseException):  # nothing may keep the process from its end
        action()
