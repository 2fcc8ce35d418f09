# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Lead a starting Python of .venv to the ROS of .venv, also from a terminal where another ROS is sourced.

tools/setup_env.py installs this file as module `ba_node_venv`, which runs before the hook of the ROS wheels. That one
starts Python once more with LD_LIBRARY_PATH on their libraries, unless a variable says that it already has.
"""

import os
import sys
from collections.abc import MutableMapping

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


if __name__ == "ba_node_venv":
    enter(os.environ, sys.prefix)
