# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels, if they were built; src/ holds the C++.

``setup.py`` builds them where it finds a C++17 compiler. Without them everything works, some ten times slower.

On x86-64 they are there three times: for any processor (``baseline``), with AVX2 and FMA (``avx2``), and with AVX-512
(``avx512``). The widest that the processor runs is taken, or the one that the environment variable BA_NODE_SIMD names.
They differ by rounding.
"""

from __future__ import annotations

import importlib
import os
import re
import warnings
from pathlib import Path
from typing import Any


def usable(module: Any) -> Any:
    """Return the compiled kernels if they have all that ``_kernels.pyi`` declares; else None, with a warning."""
    stub = Path(__file__).with_name("_kernels.pyi").read_text(encoding="utf-8")
    declared = re.findall(r"^(?:class|def) (\w+)(?=:|\((?!Protocol))", stub, re.MULTILINE)
    if all(hasattr(module, name) for name in declared):
        return module
    text = f"{module.__file__} was built from another version of ba_node: install ba_node again (here: make setup)"
    warnings.warn(f"{text}; numpy does its work, some ten times slower", RuntimeWarning, stacklevel=3)
    return None


try:
    kernels: Any = usable(importlib.import_module("ba_node.native._kernels"))
except ImportError:
    kernels = None

VARIABLE = "BA_NODE_SIMD"
_TARGETS = ("baseline", "avx2", "avx512")
# That the kernels have; as in src/bindings/arrays.hpp.
LOSSES = ("squared", "huber", "cauchy")


def choose_target(wanted: str) -> str:
    """Have the kernels for a kind of processor do the work, the widest if none is wanted; return its name.

    Warns and takes the widest if what is wanted does not exist, or this processor or this build does not have it.
    """
    supported: tuple[str, ...] = kernels.targets()
    chosen = wanted or supported[0]
    if chosen not in supported:
        reason = "this processor or this build lacks it" if wanted in _TARGETS else f"known are {', '.join(_TARGETS)}"
        text = f"{VARIABLE} = {wanted!r}: {reason}; taking {supported[0]} (here run {', '.join(supported)})"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
        chosen = supported[0]
    kernels.use_target(chosen)
    return chosen


def description(backend: str = "auto") -> str:
    """Return which kernels work: numpy, or C++ and what they are compiled for."""
    return "numpy" if kernels is None or backend == "numpy" else f"C++, {kernels.target()}"


def missing(parameterisation: str, loss: str) -> str:
    """Return why the kernels cannot be used under these rules, or an empty string if they can."""
    if kernels is None:
        return "the C++ kernels are not built: install a C++17 compiler and install ba_node again"
    if parameterisation != "local":
        return f"the C++ kernels have no {parameterisation} parameterisation"
    if loss not in LOSSES:
        return f"the C++ kernels have no {loss} loss"
    return ""


if kernels is not None:
    choose_target(os.environ.get(VARIABLE, ""))
