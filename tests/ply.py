# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read binary PLY by its own header, so that what is written is compared with the format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

KINDS = {"double": "<f8", "float": "<f4", "uint": "<u4"}


def read_ply(path: Path) -> tuple[NDArray[Any], str]:
    """Return the points as records, and the frame that the comment names."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    frame = next(line.removeprefix("comment frame ") for line in lines if line.startswith("comment frame "))
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    fields = [line.split()[1:] for line in lines if line.startswith("property ")]
    points = np.frombuffer(body, np.dtype([(name, KINDS[kind]) for kind, name in fields]))
    assert len(points) == count
    return points, frame.encode().decode("unicode_escape")
