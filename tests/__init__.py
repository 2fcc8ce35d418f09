# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Test what is installed, where a build was: Python started here would find the sources first, without C++ kernels."""

import os
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent


def _is_root(entry: str) -> bool:
    return Path(entry or ".").resolve() == _ROOT


# An editable installation, as in .venv, has no such folder, and means the sources.
if any((Path(entry) / "ba_node" / "__init__.py").is_file() for entry in sys.path if not _is_root(entry)):
    sys.path[:] = [*(entry for entry in sys.path if not _is_root(entry)), str(_ROOT)]
    # For the programs that tests start.
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(_ROOT)]))
