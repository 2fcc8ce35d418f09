# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Load the libraries of the front-end when they are needed, and say what to install where they are missing."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
from functools import cache
from typing import Any

from ba_node.front_end.records import FrontEndError

# Of malloc.h: freed memory at the end of the heap that is not given back, and what is no part of the heap, bytes.
_M_TRIM_THRESHOLD, _KEPT = -1, 64 << 20
_M_MMAP_THRESHOLD, _LARGEST = -3, 32 << 20


@cache
def cv2() -> Any:
    """Return OpenCV, on one thread: the same images give the same tracks.

    Freed memory of images is kept for those to come: to touch pages anew takes a tenth of the front-end's time.

    Raises:
        FrontEndError: it is not installed.
    """
    module = _library("cv2", "OpenCV")
    module.setNumThreads(1)
    with contextlib.suppress(AttributeError):  # another C library than glibc
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_TRIM_THRESHOLD, _KEPT)
        mallopt(_M_MMAP_THRESHOLD, _LARGEST)
    return module


@cache
def poselib() -> Any:
    """Return PoseLib (Larsson, 2020), minimal solvers in RANSAC.

    Raises:
        FrontEndError: it is not installed.
    """
    return _library("poselib", "PoseLib")


def _library(name: str, title: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise FrontEndError(f"{title} is missing, which the front-end needs: pip install ba_node[front_end]") from None
