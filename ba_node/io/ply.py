# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write point clouds as binary PLY with the fields of the topic ``~/points``, and read them back.

Positions are doubles here: at the coordinates of a country, as UTM has them, a float32 has steps of 0.5 m.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ba_node.io.files import whole_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ba_node.estimate import Cloud

# One point in a file, little endian.
PLY_DTYPE = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("rms_px", "<f4"), ("views", "<u4")])
_KINDS = {"<f8": "double", "<f4": "float", "<u4": "uint"}


class PlyError(ValueError):
    """A PLY file that is not one of those written here."""


def write_ply(path: Path | str, cloud: Cloud, frame_id: str) -> None:
    """Write x, y, z (m, in ``frame_id``), rms_px and views of every point, little endian."""
    with whole_file(path) as stream:
        stream.write(_header(len(cloud), frame_id).encode("ascii"))
        stream.write(_records(cloud).tobytes())


def read_ply(path: Path | str) -> tuple[NDArray[np.void], str]:
    """Return the points as ``PLY_DTYPE`` records, and their frame.

    Raises:
        PlyError: the file has another layout, or is truncated.
    """
    data = Path(path).read_bytes()
    head, found, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").splitlines()
    try:
        count = int(next(line for line in lines if line.startswith("element vertex ")).split()[2])
        frame = next(line for line in lines if line.startswith("comment frame ")).removeprefix("comment frame ")
        frame_id = frame.encode().decode("unicode_escape")
    except (StopIteration, IndexError, ValueError):
        raise PlyError(f"{path}: not a point cloud written by this package: no vertices or no frame") from None
    if not found or head.decode("ascii", errors="replace") + "end_header\n" != _header(count, frame_id):
        raise PlyError(f"{path}: not a point cloud written by this package: its header has other fields")
    if len(body) != count * PLY_DTYPE.itemsize:
        raise PlyError(f"{path}: {len(body)} bytes of points: {count} points need {count * PLY_DTYPE.itemsize}")
    return np.frombuffer(body, dtype=PLY_DTYPE), frame_id


def _records(cloud: Cloud) -> NDArray[np.void]:
    records = np.empty(len(cloud), PLY_DTYPE)
    for column, axis in enumerate("xyz"):
        records[axis] = cloud.position[:, column]
    records["rms_px"], records["views"] = cloud.rms_px, cloud.views
    return records


def _header(count: int, frame_id: str) -> str:
    assert PLY_DTYPE.fields is not None
    properties = [f"property {_KINDS[kind.str]} {name}" for name, (kind, *_) in PLY_DTYPE.fields.items()]
    # A header is ASCII, one statement a line, whatever the frame is called.
    frame = frame_id.encode("unicode_escape").decode("ascii")
    lines = ["ply", "format binary_little_endian 1.0", f"comment frame {frame}", f"element vertex {count}"]
    return "\n".join([*lines, *properties, "end_header"]) + "\n"
