# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The tests in C++, as they are; `make sanitize` and `make cross` run them otherwise."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATH = os.pathsep.join([str(ROOT / ".venv" / "bin"), os.environ.get("PATH", os.defpath)])
MISSING = [name for name in ("cmake", "ninja", "c++") if shutil.which(name, path=PATH) is None]


@pytest.mark.skipif(bool(MISSING), reason=f"no {', '.join(MISSING)}")
def test_the_kernels_pass_their_tests_in_cpp() -> None:
    command = ["sh", str(ROOT / "tools" / "native_tests.sh"), "plain"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    # Any processor has this one; a program without a test fails.
    assert re.search(r"Test +#1: baseline \.+ +Passed", done.stdout), done.stdout
