# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write point clouds as binary PLY with the fields of the topic ``~/points``; read any PLY of points.

Positions are doubles here: at the coordinates of a country, as UTM has them, a float32 has steps of 0.5 m.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.estimate import Cloud
from ba_node.io.files import open_regular, whole_file

# One point in a file, little endian.
_FIELDS = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("rms_px", "<f4"), ("views", "<u4")]
_MAX_BYTES = 2**34
_KINDS = {"<f8": "double", "<f4": "float", "<u4": "uint"}
# What other programs write: byte order by format, type by each of its names.
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_READ = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


class PlyError(ValueError):
    """A file that holds no point cloud, or a damaged one."""


def write_ply(path: Path | str, cloud: Cloud, frame_id: str) -> None:
    """Write x, y, z (m, in ``frame_id``), rms_px and views of every point, little endian."""
    points = np.empty(len(cloud), _FIELDS)
    for column, axis in enumerate("xyz"):
        points[axis] = cloud.position[:, column]
    points["rms_px"], points["views"] = cloud.rms_px, cloud.views
    with whole_file(path) as stream:
        stream.write(_header(len(cloud), frame_id).encode("ascii"))
        stream.write(points.tobytes())


def read_ply(path: Path | str) -> tuple[FloatArray, IntArray]:
    """Return points (n, 3), m, and colours (n, 3), white where there are none, of any PLY, text or binary.

    Raises:
        PlyError: it is none, or damaged.
        OSError: it cannot be opened.
    """
    with open_regular(path, _MAX_BYTES) as stream:
        head, found, body = stream.read().partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    form = next((line[1] for line in lines if len(line) > 1 and line[0] == "format"), "")
    if not found or lines[0] != ["ply"] or form not in _ORDERS:
        raise PlyError(f"{path}: no point cloud: expected a PLY header with a format of {', '.join(_ORDERS)}")
    body = body.partition(b"\n")[2]
    kinds, count = _vertex(path, lines)
    try:
        if form == "ascii":
            rows = np.array(body.split()[: count * len(kinds)], float).reshape(count, len(kinds))
            columns = dict(zip(kinds, rows.T, strict=True))
        else:
            row = np.dtype([(name, _ORDERS[form] + kind) for name, kind in kinds.items()])
            vertices = np.frombuffer(body, row, count)
            columns = {name: vertices[name] for name in kinds}
    except ValueError:
        raise PlyError(f"{path}: cut off or damaged: {count} points are not in it") from None
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(points).all():
        raise PlyError(f"{path}: point {int(np.argmin(np.isfinite(points).all(axis=1)))} is not finite")
    colours = [columns.get(name, np.full(count, 255)) for name in ("red", "green", "blue")]
    return points, np.stack(colours, axis=1).astype(np.intp)


def _vertex(path: Path | str, lines: list[list[str]]) -> tuple[dict[str, str], int]:
    """Return the kind of each property of a vertex by name, and how many vertices there are; they come first."""
    kinds: dict[str, str] = {}
    count = element = -1
    for line in lines:
        if line[:1] == ["element"] and len(line) == 3:
            element += 1
            count = int(line[2]) if element == 0 and line[1] == "vertex" and line[2].isdigit() else count
        elif line[:1] == ["property"] and element == 0 and len(line) == 3 and line[1] in _READ:
            kinds[line[2]] = _READ[line[1]]
        elif line[:1] == ["property"] and element == 0:
            raise PlyError(f"{path}: {' '.join(line)}: expected a number of a known type for each property of a vertex")
    if count < 0 or not {"x", "y", "z"} <= kinds.keys():
        raise PlyError(f"{path}: no vertices with x, y and z come first in it: what else PLY holds is not read")
    return kinds, count


def _header(count: int, frame_id: str) -> str:
    # A header is ASCII, one statement a line, whatever the frame is called.
    frame = frame_id.encode("unicode_escape").decode("ascii")
    lines = ["ply", "format binary_little_endian 1.0", f"comment frame {frame}", f"element vertex {count}"]
    properties = [f"property {_KINDS[kind]} {name}" for name, kind in _FIELDS]
    return "\n".join([*lines, *properties, "end_header"]) + "\n"
