# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Load the libraries of the front-end when they are needed, and say what to install where they are missing."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

from ba_node.front_end.records import FrontEndError


@cache
def cv2() -> Any:
    """Return OpenCV, on one thread: the same images give the same tracks.

    Raises:
        FrontEndError: it is not installed.
    """
    module = _library("cv2", "OpenCV")
    module.setNumThreads(1)
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
