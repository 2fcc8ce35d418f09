# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys

# Imports what the node works with; says what BLAS was told, and which threads there are then.
_SCRIPT = """
import os
import ba_node.ros, numpy, scipy.linalg
print(os.environ["OPENBLAS_NUM_THREADS"], *os.listdir("/proc/self/task"))
"""


def told(given: dict[str, str]) -> tuple[str, int]:
    """Return how many threads BLAS is told to have in a program of the node's, and how many this has."""
    plain = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    run = subprocess.run([sys.executable, "-c", _SCRIPT], env=plain | given, capture_output=True, text=True, check=True)
    number, *threads = run.stdout.split()
    return number, len(threads)


def test_blas_has_one_thread_in_the_node() -> None:
    """Several wait for each other, however short a product is: on busy cores for half a second."""
    assert told({}) == ("1", 1)


def test_who_asks_for_more_threads_is_obeyed() -> None:
    assert told({"OPENBLAS_NUM_THREADS": "2"})[0] == "2"
