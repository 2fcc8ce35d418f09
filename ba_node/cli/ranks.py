# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Start a command once more on several ranks, and end them all together."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from ba_node.cli import interrupts

T = TypeVar("T")
# More ranks than this, and than four a core, only take turns: whoever asks for a million has mistyped.
_MOST_RANKS = 64
# For ranks that are told to end; they do within a fraction of it.
_END_S = 5.0
# What tells mpiexec to end, and its ranks with it, where this process is killed and says nothing more.
_WITH_US = ("setpriv", "--pdeathsig", "TERM")

if TYPE_CHECKING:
    import argparse

    from ba_node.offline.ranks import Ranks


def start_ranks(args: argparse.Namespace, codes: tuple[int, ...], hint: Callable[[], str] = str) -> int:
    """Run this command once more, on ``args.ranks`` ranks; return its exit code.

    ``codes`` are those with which it ends by itself, ``hint`` what helps after a rank has died.
    """
    from ba_node.offline.ranks import RanksError, launch_command  # noqa: PLC0415

    if args.ranks < 1:
        raise RanksError(f"--ranks {args.ranks}: expected 1 or more")
    cores = len(os.sched_getaffinity(0))
    if args.ranks > max(_MOST_RANKS, 4 * cores):
        raise RanksError(
            f"--ranks {args.ranks}: this machine has {cores} cores: at most {max(_MOST_RANKS, 4 * cores)};"
            " mpiexec starts them on several machines"
        )
    command, environ = launch_command(args.ranks, sys.argv[1:])
    if shutil.which(_WITH_US[0]):
        command = [*_WITH_US, *command]
    with subprocess.Popen(command, env=environ, stderr=subprocess.PIPE, text=True) as ranks:
        assert ranks.stderr is not None
        interrupts.at_interrupt(lambda: _end(ranks))
        framed = False
        for line in ranks.stderr:
            # Open MPI frames what it has to say itself; of a rank that died the line below tells in fewer words.
            framed ^= line.startswith("-----")
            if not framed and not line.startswith("-----"):
                print(line, end="", file=sys.stderr)
    code = ranks.returncode
    args.json = args.json if args.json is not None and not args.json.is_file() else None  # rank 0 has written it
    if code not in codes:
        print(f"ba: error: a rank ended with code {code}, and all with it{hint()}", file=sys.stderr)
    return code if code >= 0 else codes[-1]


def _end(ranks: subprocess.Popen[str]) -> None:
    """End the ranks, where a signal has come to this process alone; else they would go on without it."""
    ranks.terminate()
    try:
        ranks.wait(_END_S)
    except subprocess.TimeoutExpired:
        ranks.kill()


def together(communicator: Ranks, work: Callable[[], T | None]) -> T | None:
    """Return what the work of this rank gives, once all have come to its end; whatever ends one ends all.

    Bad input, to which all ranks come, is raised on rank 0 alone, and gives None on others.
    """
    found = None
    try:
        found = work()
    except (ValueError, OSError):
        communicator.finish()
        if communicator.rank == 0:
            raise
        return None
    except BaseException as error:
        print(f"ba: error: rank {communicator.rank}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        communicator.abort(1)
        raise
    communicator.finish()
    return found
