# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Lead a starting Python of .venv to the ROS of .venv, also from a terminal where another ROS is sourced.

tools/setup_env.py installs this file as module `ba_node_venv`, which runs before the hook of the ROS wheels. That one
starts Python once more with LD_LIBRARY_PATH on their libraries, unless a variable says that it already has.

A Python that is interrupted while it looks for such hooks ends with a traceback; where it is to run `ba`, it ends as
ba_node/cli/interrupts.py has it. A signal that comes while Python is started once more waits until that one is here.
"""

# What Python has imported by itself, or has built in: the others take their time.
import _signal as signal  # type: ignore[import-not-found]  # typed as signal
import os
import sys
from _collections_abc import MutableMapping

WHEELS_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def without(paths: str, prefixes: list[str]) -> str:
    """Remove from a list of paths those below one of the prefixes."""
    below = tuple(f"{prefix}/" for prefix in prefixes)
    return os.pathsep.join(path for path in paths.split(os.pathsep) if path and not f"{path}/".startswith(below))


def enter(environ: MutableMapping[str, str], prefix: str) -> None:
    """Name prefix as the ROS to use, in place of another one; keep what is laid over prefix."""
    packages = [path for path in environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if path]
    if prefix not in packages:
        for name in ("PYTHONPATH", "LD_LIBRARY_PATH"):
            if name in environ:
                environ[name] = without(environ[name], packages)
        environ["AMENT_PREFIX_PATH"] = prefix
    if f"{prefix}/lib" not in environ.get("LD_LIBRARY_PATH", "").split(os.pathsep):
        # The variable stems from another environment of ROS wheels: its libraries are not ours.
        environ.pop(WHEELS_GUARD, None)


def end_quietly(words: list[str]) -> None:
    """Take the signals over where a command line, the interpreter first, is that of `ba`."""
    if any(os.path.basename(word) == "ba" or word == "ba_node.cli.main" for word in words[1:3]):  # noqa: PTH119
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, _end)
        # What is blocked stays so in the Python that this one turns into, and is kept.
        how = signal.SIG_UNBLOCK if WHEELS_GUARD in os.environ else signal.SIG_BLOCK
        signal.pthread_sigmask(how, (signal.SIGINT, signal.SIGTERM))


def _end(number: int, _frame: object) -> None:
    os.write(2, b"ba: interrupted\n" if number == signal.SIGINT else b"ba: terminated\n")
    os._exit(128 + number)


if __name__ == "ba_node_venv":
    end_quietly(sys.orig_argv)
    enter(os.environ, sys.prefix)
