# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write, and read again, point clouds as binary PLY with the fields of the topic ``~/points``.

Positions are doubles here: at the coordinates of a country, as UTM has them, a float32 has steps of 0.5 m.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.estimate import Cloud
from ba_node.io.files import open_regular, whole_file

# One point in a file, little endian.
_FIELDS = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("rms_px", "<f4"), ("views", "<u4")]
_MAX_BYTES = 2**34
_KINDS = {"<f8": "double", "<f4": "float", "<u4": "uint"}


def write_ply(path: Path | str, cloud: Cloud, frame_id: str) -> None:
    """Write x, y, z (m, in ``frame_id``), rms_px and views of every point, little endian."""
    points = np.empty(len(cloud), _FIELDS)
    for column, axis in enumerate("xyz"):
        points[axis] = cloud.position[:, column]
    points["rms_px"], points["views"] = cloud.rms_px, cloud.views
    with whole_file(path) as stream:
        stream.write(_header(len(cloud), frame_id).encode("ascii"))
        stream.write(points.tobytes())


def read_ply_points(path: Path | str) -> FloatArray:
    """Return the points (n, 3), m, of a file that :func:`write_ply` has written.

    Raises:
        ValueError: it is none.
        OSError: it cannot be opened.
    """
    with open_regular(path, _MAX_BYTES) as stream:
        _, found, body = stream.read().partition(b"end_header\n")
    row = np.dtype(_FIELDS)
    if not found or len(body) % row.itemsize:
        raise ValueError(f"{path}: no point cloud of ba_node")
    points = np.frombuffer(body, row)
    return np.stack([points[axis] for axis in "xyz"], axis=1)


def _header(count: int, frame_id: str) -> str:
    # A header is ASCII, one statement a line, whatever the frame is called.
    frame = frame_id.encode("unicode_escape").decode("ascii")
    lines = ["ply", "format binary_little_endian 1.0", f"comment frame {frame}", f"element vertex {count}"]
    properties = [f"property {_KINDS[kind]} {name}" for name, kind in _FIELDS]
    return "\n".join([*lines, *properties, "end_header"]) + "\n"
