# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels, if they were built; src/ holds the C++.

``setup.py`` builds them where it finds a C++17 compiler. Without them everything works, some ten times slower.
"""

from __future__ import annotations

import importlib
from typing import Any

try:
    kernels: Any = importlib.import_module("ba_node.native._kernels")
except ImportError:
    kernels = None

_LOSSES = ("squared", "huber", "cauchy")


def missing(parameterisation: str, loss: str) -> str:
    """Return why the kernels cannot be used under these rules, or an empty string if they can."""
    if kernels is None:
        return "the C++ kernels are not built: install a C++17 compiler and install ba_node again"
    if parameterisation != "local":
        return f"the C++ kernels have no {parameterisation} parameterisation"
    if loss not in _LOSSES:
        return f"the C++ kernels have no {loss} loss"
    return ""
